//! DICOM as the world writes it: elements that are not used decide nothing.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use crate::common::dicom_bytes::{DicomSlice, LOSSLESS_JPEG, jpeg_2000};
use crate::common::{read_bytes, series};
use std::path::Path;
use volume_io::{ReadOptions, VolumeError, read_as};
use voxel_grid::Volume;

const PATIENT_POSITION: &[u8] = b"\x18\0\x50\0DS";

/// The bytes of the usual slice with an element before the one that starts with `next`.
fn with(next: &[u8], element: &[u8]) -> Vec<u8> {
    let bytes = DicomSlice::default().bytes();
    let at = bytes.windows(next.len()).position(|window| window == next).unwrap();
    [&bytes[..at], element, &bytes[at..]].concat()
}

fn same_as_usual(name: &str, bytes: &[u8]) {
    let usual = read_bytes("v.dcm", &DicomSlice::default().bytes()).unwrap();
    let given = read_bytes("v.dcm", bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert_eq!(given, usual, "{name}");
}

/// Regression: the content of UN was read as explicit VR: its bytes became lengths, up to 3.7 GB.
#[test]
fn un_of_undefined_length_is_implicit_vr_inside() {
    const ITEM: &[u8] = b"\xfe\xff\0\xe0\xff\xff\xff\xff";
    const ITEM_END: &[u8] = b"\xfe\xff\x0d\xe0\0\0\0\0";
    const END: &[u8] = b"\xfe\xff\xdd\xe0\0\0\0\0";
    // (0009,1001) of 4 bytes, which as explicit VR would be one of another length.
    const LEAF: &[u8] = b"\x09\0\x01\x10\x04\0\0\0\xff\xff\xff\xdf";
    let nested = [b"\x09\0\x02\x10\xff\xff\xff\xff", ITEM, LEAF, ITEM_END, END].concat();
    let defined = [b"\xfe\xff\0\xe0\x0c\0\0\0", LEAF].concat();
    for inner in [[ITEM, LEAF, ITEM_END].concat(), [ITEM, &nested, ITEM_END].concat(), defined] {
        let element = [b"\x09\0\x10\x10UN\0\0\xff\xff\xff\xff", inner.as_slice(), END].concat();
        same_as_usual("UN", &with(PATIENT_POSITION, &element));
    }
}

/// Regression: a used element with VR UN was its bytes in text: "49\\32".
#[test]
fn used_elements_with_vr_un_have_their_own_vr() {
    let mut bytes = DicomSlice::default().bytes();
    // A short VR has a 2-byte length; UN has a 4-byte one.
    for start in
        [b"\x28\0\x10\0US", b"\x28\0\x11\0US", b"\x20\0\x32\0DS", b"\x28\0\x53\x10DS", b"\x18\0\x50\0DS"]
    {
        let at = bytes.windows(6).position(|window| window == start).unwrap();
        let length = [bytes[at + 6], bytes[at + 7], 0, 0];
        bytes.splice(at + 4..at + 8, [b"UN\0\0".as_slice(), &length].concat());
    }
    same_as_usual("UN", &bytes);
}

/// Regression: what is not used decided whether a file is read.
#[test]
fn bytes_that_are_not_used_decide_nothing() {
    same_as_usual("3 bytes of US", &with(PATIENT_POSITION, b"\x09\0\x01\x10US\x03\0abc"));
    same_as_usual("4 bytes of FD", &with(PATIENT_POSITION, b"\x09\0\x01\x10FD\x04\0abcd"));
    same_as_usual("SQ of no items", &with(PATIENT_POSITION, b"\x09\0\x01\x10SQ\0\0\x05\0\0\0abcde"));
    for rest in [b"\0\0\0".as_slice(), b"trailing bytes", &[0xff; 40]] {
        same_as_usual("behind the pixels", &[&DicomSlice::default().bytes(), rest].concat());
    }
    let whole = DicomSlice::default().bytes();
    let length = u32::from_le_bytes(whole[140..144].try_into().unwrap());
    for wrong in [0, length - 4, length + 10, u32::MAX] {
        let mut file = whole.clone();
        file[140..144].copy_from_slice(&wrong.to_le_bytes());
        same_as_usual("group length", &file);
    }
}

/// Regression: integer pixels of 64 bits ended the process: a panic.
#[test]
fn integer_pixels_of_64_bits_are_refused() {
    let mut bytes = DicomSlice { columns: 20, ..DicomSlice::default() }.bytes();
    let at = bytes.windows(6).position(|window| window == b"\x28\0\0\x01US").unwrap();
    bytes[at + 8] = 64;
    let columns = bytes.windows(6).position(|window| window == b"\x28\0\x11\0US").unwrap();
    bytes[columns + 8] = 5;
    let said = read_bytes("v.dcm", &bytes).unwrap_err().to_string();
    assert!(said.contains("BitsAllocated") && said.contains("8, 16 or 32"), "{said}");
}

#[test]
fn float_pixels_of_both_widths_are_read() {
    let usual = DicomSlice::default().bytes();
    let at = usual.windows(6).position(|window| window == b"\xe0\x7f\x10\0OW").unwrap();
    let values: Vec<i16> = (0..20).map(|n| n * 100 - 900).collect();
    let stored = values.iter().map(|value| value + 1024);
    let floats: Vec<u8> = stored.clone().flat_map(|value| f32::from(value).to_le_bytes()).collect();
    let doubles: Vec<u8> = stored.flat_map(|value| f64::from(value).to_le_bytes()).collect();
    for (head, pixels) in [(b"\xe0\x7f\x08\0OF\0\0", floats), (b"\xe0\x7f\x09\0OD\0\0", doubles)] {
        let length = (pixels.len() as u32).to_le_bytes();
        let file = |pixels: &[u8]| [&usual[..at], head, &length, pixels].concat();
        assert_eq!(read_bytes("v.dcm", &file(&pixels)).unwrap().hu, values);
        let cut = read_bytes("v.dcm", &file(&pixels[1..]));
        assert!(matches!(cut, Err(VolumeError::Truncated { .. })), "{cut:?}");
    }
}

/// Regression: 16 bytes of an item with an element took about 400 bytes of memory, without a limit.
#[test]
fn endless_items_of_a_used_sequence_are_refused() {
    let head = b"\0\x52\x30\x92SQ\0\0\xff\xff\xff\xff";
    let items = b"\xfe\xff\0\xe0\0\0\0\0".repeat((1 << 21) + 1);
    let file = with(b"\xe0\x7f\x10\0OW", &[head, items.as_slice(), b"\xfe\xff\xdd\xe0\0\0\0\0"].concat());
    let said = read_bytes("v.dcm", &file).unwrap_err().to_string();
    assert!(said.contains("more than 2097152 elements and items"), "{said}");
}

/// Regression: frames were refused that programs pad with something else than zeros, or before their end
/// mark.
#[test]
fn padded_frames_are_read() {
    let packed = |transfer_syntax, fragment: &[u8]| DicomSlice {
        transfer_syntax,
        fragment: Some(fragment.to_vec()),
        ..DicomSlice::default()
    };
    let frame = &LOSSLESS_JPEG[..52];
    for padding in [b"\xff\xff".as_slice(), b"  ", b"\0 ", b"\xff\xd9", b"\0\0\xff\xd9\0"] {
        let slice = packed("1.2.840.10008.1.2.4.70", &[frame, padding].concat());
        assert_eq!(read_bytes("v.dcm", &slice.bytes()).unwrap().hu, vec![0; 20], "{padding:?}");
    }
    let cut = packed("1.2.840.10008.1.2.4.70", &[&frame[..50], b"  "].concat());
    assert!(matches!(read_bytes("v.dcm", &cut.bytes()), Err(VolumeError::Corrupt { .. })));
}

/// Regression: a JP2 file as a frame was refused.
#[test]
fn a_jp2_container_is_read_as_its_codestream() {
    let slice = |fragment: Vec<u8>| DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.4.90",
        fragment: Some(fragment),
        ..DicomSlice::default()
    };
    let bare = jpeg_2000(4, 5);
    let signature = b"\0\0\0\x0cjP  \r\n\x87\n\0\0\0\x14ftypjp2 \0\0\0\0jp2 ";
    let expected = read_bytes("v.dcm", &slice(bare.clone()).bytes()).unwrap();
    let length = (bare.len() as u32 + 8).to_be_bytes();
    for head in [length, [0; 4]] {
        let boxed = [signature, head.as_slice(), b"jp2c", &bare].concat();
        assert_eq!(read_bytes("v.dcm", &slice(boxed).bytes()).unwrap(), expected);
    }
    let huge = [signature, b"\xff\xff\xff\xffjp2c".as_slice(), &bare].concat();
    assert!(matches!(read_bytes("v.dcm", &slice(huge).bytes()), Err(VolumeError::Corrupt { .. })));
}

fn choose(path: &Path, series: Option<&str>) -> Result<(Volume, String), VolumeError> {
    let options = ReadOptions { series: series.map(str::to_owned), ..ReadOptions::default() };
    read_as(path, &options).map(|(volume, info)| (volume, info.notes.join("; ")))
}

/// A slice with elements that the usual one lacks, before its pixels' description.
fn slice_with(slice: &DicomSlice, elements: &[(&[u8; 6], &str)]) -> Vec<u8> {
    let mut bytes = slice.bytes();
    for (start, value) in elements {
        let at = bytes.windows(6).position(|window| window == b"\x28\0\x02\0US").unwrap();
        let head = [start.as_slice(), &(value.len() as u16).to_le_bytes()].concat();
        bytes.splice(at..at, [head.as_slice(), value.as_bytes()].concat());
    }
    bytes
}

/// Regression: 8 bytes in a file could be a slice of some 500 bytes in memory, without a limit.
#[test]
fn slices_without_end_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let frames = b"\xfe\xff\0\xe0\0\0\0\0".repeat(1 << 16);
    let head = [b"\0\x52\x30\x92SQ\0\0".as_slice(), &(frames.len() as u32).to_le_bytes()].concat();
    let bytes = slice_with(&DicomSlice::default(), &[(b"\x28\0\x08\0IS", "65536 ")]);
    let at = bytes.windows(6).position(|window| window == b"\xe0\x7f\x10\0OW").unwrap();
    let file = [&bytes[..at], &head, &frames, &bytes[at..]].concat();
    for number in 0..4 {
        std::fs::write(folder.path().join(format!("{number}.dcm")), &file).unwrap();
    }
    for path in [folder.path(), &folder.path().join("0.dcm")] {
        let said = choose(path, None).unwrap_err().to_string();
        assert!(said.contains("more than 200000 slices"), "{said}");
    }
}

/// Regression: a copy of a slice under another name was refused as a duplicate.
#[test]
fn identical_copies_count_once() {
    let folder = tempfile::tempdir().unwrap();
    let uid = |number: usize| format!("1.2.3.{number}");
    for number in 0..2 {
        let slice = DicomSlice { position_mm: [0.0, 0.0, number as f64], ..DicomSlice::default() };
        let bytes = slice_with(&slice, &[(b"\x08\0\x18\0UI", &uid(number))]);
        std::fs::write(folder.path().join(format!("{number}.dcm")), bytes).unwrap();
    }
    std::fs::copy(folder.path().join("1.dcm"), folder.path().join("copy.dcm")).unwrap();
    let (volume, notes) = choose(folder.path(), None).unwrap();
    assert_eq!((volume.grid.dims()[2], notes.as_str()), (2, "identical copies of slices ignored: 1"));
    // The same instance with other pixels is no copy.
    let other = DicomSlice { position_mm: [0.0, 0.0, 1.0], stored: 7, ..DicomSlice::default() };
    let bytes = slice_with(&other, &[(b"\x08\0\x18\0UI", &uid(1))]);
    std::fs::write(folder.path().join("copy.dcm"), bytes).unwrap();
    assert!(matches!(choose(folder.path(), None), Err(VolumeError::DuplicateSlices { .. })));
}

/// Regression: the phases of a series were refused as duplicates, with the advice to remove them.
#[test]
fn phases_of_a_series_are_listed_and_chosen() {
    let folder = tempfile::tempdir().unwrap();
    for (number, (phase, z)) in [("10", 0.0), ("9 ", 0.0), ("10", 2.0), ("9 ", 2.0)].into_iter().enumerate() {
        let stored = if phase == "10" { 1034 } else { 1033 };
        let slice = DicomSlice { position_mm: [0.0, 0.0, z], stored, ..DicomSlice::default() };
        let bytes = slice_with(&slice, &[(b"\x20\0\x00\x01IS", phase)]);
        std::fs::write(folder.path().join(format!("{number}.dcm")), bytes).unwrap();
    }
    for path in [folder.path(), &folder.path().join("0.dcm")] {
        let said = choose(path, None).unwrap_err().to_string();
        assert!(said.contains("2 phases") && said.contains("#1 (2 slices), #2 (2 slices)"), "{said}");
        for (chosen, hu) in [("1.2.3#1", 9), ("1.2.3#2", 10)] {
            let (volume, notes) = choose(path, Some(chosen)).unwrap();
            assert_eq!((volume.grid.dims()[2], volume.hu[0]), (2, hu));
            assert!(notes.contains("other phases of the series ignored: 1"), "{notes}");
        }
        for wrong in ["1.2.3#0", "1.2.3#3", "1.2.3#"] {
            assert!(matches!(choose(path, Some(wrong)), Err(VolumeError::SeveralPhases { .. })), "{wrong}");
        }
    }
}

/// Regression: NaN was in no order with numbers, which separated the slices of another phase.
#[test]
fn a_phase_that_is_not_a_number_leaves_the_others_whole() {
    let folder = tempfile::tempdir().unwrap();
    for (number, (phase, z)) in [("+5", 0.0), ("+nan", 0.0), ("-5", 0.0), ("+5", 2.0)].into_iter().enumerate()
    {
        let slice = DicomSlice { position_mm: [0.0, 0.0, z], ..DicomSlice::default() };
        let bytes = slice_with(&slice, &[(b"\x20\0\x00\x01IS", phase)]);
        std::fs::write(folder.path().join(format!("{number}.dcm")), bytes).unwrap();
    }
    let said = choose(folder.path(), None).unwrap_err().to_string();
    assert!(said.contains("3 phases") && said.contains("#3 (2 slices)"), "{said}");
}

/// Some exporters give every slice a series of its own.
#[test]
fn series_of_one_slice_each_are_joined_on_request() {
    let slice =
        |series_uid, z| DicomSlice { series_uid, position_mm: [0.0, 0.0, z], ..DicomSlice::default() };
    let folder = series(&[slice("1.2.3", 0.0), slice("1.2.4", 1.0), slice("1.2.5", 2.0)]);
    let said = choose(folder.path(), None).unwrap_err().to_string();
    assert!(said.contains("`--series all`"), "{said}");
    let (volume, notes) = choose(folder.path(), Some("all")).unwrap();
    assert_eq!((volume.grid.dims()[2], notes.as_str()), (3, "3 series joined, as asked for by `all`"));
}

/// Regression: `--series` beside one file of another series was ignored.
#[test]
fn another_series_than_that_of_the_file_is_refused() {
    let folder = series(&[DicomSlice::default()]);
    let path = folder.path().join("000.dcm");
    assert!(choose(&path, Some("1.2.3")).is_ok());
    let said = choose(&path, Some("1.2.9")).unwrap_err().to_string();
    assert!(said.contains("series 1.2.9 not found") && said.contains("1.2.3"), "{said}");
}

/// Regression: frames without functional groups were refused, though the file says how they lie.
#[test]
fn frames_of_a_classic_image_are_stacked_by_their_spacing() {
    let usual = read_bytes("v.dcm", &DicomSlice::default().bytes()).unwrap();
    let mut bytes = DicomSlice::default().bytes();
    let mut insert = |next: &[u8], element: &[u8]| {
        let at = bytes.windows(next.len()).position(|window| window == next).unwrap();
        bytes.splice(at..at, element.iter().copied());
    };
    insert(b"\x28\0\x10\0US", b"\x28\0\x08\0IS\x02\x003 ");
    let refused = {
        let at = bytes.windows(6).position(|window| window == b"\xe0\x7f\x10\0OW").unwrap();
        let length = u32::from_le_bytes(bytes[at + 8..at + 12].try_into().unwrap());
        bytes[at + 8..at + 12].copy_from_slice(&(3 * length).to_le_bytes());
        let pixels = bytes[at + 12..].to_vec();
        bytes.extend([pixels.clone(), pixels].concat());
        read_bytes("v.dcm", &bytes).unwrap_err().to_string()
    };
    assert!(refused.contains("SpacingBetweenSlices (0018,0088)"), "{refused}");
    let at = bytes.windows(PATIENT_POSITION.len()).position(|window| window == PATIENT_POSITION).unwrap();
    // Behind the slice thickness, of 10 bytes.
    bytes.splice(at + 10..at + 10, b"\x18\0\x88\0DS\x04\x002.50".iter().copied());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.dcm");
    std::fs::write(&path, &bytes).unwrap();
    let (volume, info) = read_as(&path, &ReadOptions::default()).unwrap();
    assert_eq!(volume.hu, usual.hu.repeat(3));
    assert_eq!((volume.grid.dims()[2], volume.grid.spacing_m()[2]), (3, 2.5e-3));
    assert_eq!(volume.grid.origin_m(), usual.grid.origin_m());
    assert!(info.notes.iter().any(|note| note.contains("only the first frame has a position")), "{info}");
}
