//! Tests of clinical data: selecting series and labels, and compressed frames with false headers.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, write_series};
use crate::common::{read_bytes, series, store};
use std::path::{Path, PathBuf};
use volume_io::{Label, ReadOptions, SliceHandling, VolumeError, read, read_as};

fn refuse(bytes: &[u8]) -> VolumeError {
    let error = read_bytes("v.dcm", bytes).unwrap_err();
    println!("{error}");
    error
}

fn stack(z_mm: &[f64]) -> Vec<DicomSlice> {
    z_mm.iter().map(|z| DicomSlice { position_mm: [0.0, 0.0, *z], ..DicomSlice::default() }).collect()
}

/// Regression: a study folder was refused without listing its series.
#[test]
fn a_folder_of_several_series_lists_them_and_takes_the_one_named() {
    let folder = tempfile::tempdir().unwrap();
    let below = folder.path().join("below");
    std::fs::create_dir(&below).unwrap();
    let slices = |uid, stored| -> Vec<DicomSlice> {
        stack(&[0.0, 2.0]).into_iter().map(|s| DicomSlice { series_uid: uid, stored, ..s }).collect()
    };
    write_series(folder.path(), &slices("1.2.3", 1024));
    write_series(&below, &slices("1.2.4", 1030));
    let error = read(folder.path()).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, VolumeError::SeveralSeries { .. }));
    assert!(
        said.contains("1.2.3 (2 slices, CT") && said.contains("1.2.4 (2 slices") && said.contains("--series"),
        "{said}"
    );
    let of = |uid: &str| ReadOptions { series: Some(uid.to_owned()), ..ReadOptions::default() };
    let (volume, info) = read_as(folder.path(), &of("1.2.4")).unwrap();
    assert!(volume.hu.iter().all(|hu| *hu == 6), "{:?}", info.notes);
    assert!(info.notes.iter().any(|note| note == "1 other series in the folder ignored"));
    let said = read_as(folder.path(), &of("9.9")).unwrap_err().to_string();
    assert!(said.contains("series 9.9") && said.contains("1.2.3"), "{said}");
}

#[test]
fn a_label_that_is_not_there_is_refused_with_those_that_are() {
    let header = "NRRD0005\ntype: uchar\ndimension: 3\nsizes: 2 2 1\nspace: LPS\nspace directions: (1,0,0) \
                  (0,1,0) (0,0,1)\n\
                  encoding: raw\nSegment0_Name:=femur\nSegment0_LabelValue:=2\nSegment0_Layer:=0\n\n";
    let (_folder, path) = store("v.seg.nrrd", &[header.as_bytes(), &[0, 2, 2, 0]].concat());
    let read = |label| read_as(&path, &ReadOptions { label: Some(label), ..ReadOptions::default() });
    assert_eq!(read(Label::Name("femur".into())).unwrap().0.hu, [0, 1, 1, 0]);
    assert_eq!(read(Label::Value(2)).unwrap().0.hu, [0, 1, 1, 0]);
    let said = read(Label::Name("tibia".into())).unwrap_err().to_string();
    assert!(said.contains("tibia") && said.contains("\"femur\" (2)"), "{said}");
    let said = read(Label::Value(7)).unwrap_err().to_string();
    assert!(said.contains("label 7") && said.contains("[0, 2]"), "{said}");
}

/// Regression: in a segmentation of an older Slicer every segment was taken from the first layer: another
/// bone.
#[test]
fn a_segment_without_a_layer_is_the_layer_of_its_index() {
    let header = "NRRD0004\ntype: uchar\ndimension: 4\nsizes: 2 2 2 1\nspace: LPS\nkinds: list domain \
                  domain domain\nspace directions: none (1,0,0) (0,1,0) (0,0,1)\nencoding: raw\n\
                  Segment0_Name:=femur\nSegment1_Name:=implant\n\n";
    let (_folder, path) = store("old.seg.nrrd", &[header.as_bytes(), &[1, 0, 0, 1, 0, 1, 0, 1]].concat());
    let read = |name: &str| {
        let options = ReadOptions { label: Some(Label::Name(name.into())), ..ReadOptions::default() };
        read_as(&path, &options).unwrap().0.hu
    };
    assert_eq!(read("femur"), [1, 0, 0, 0]);
    assert_eq!(read("implant"), [0, 1, 1, 1]);
}

/// Two voxels of a CT, -1000 and 300 HU.
fn two_voxels(folder: &Path) -> PathBuf {
    let path = folder.join("ct.nrrd");
    let header = "NRRD0005\ntype: short\ndimension: 3\nsizes: 2 1 1\nspace: LPS\nspace directions: (1,0,0) \
                  (0,1,0) (0,0,1)\n\
                  encoding: raw\nendian: little\n\n";
    let voxels = [-1000_i16, 300].map(i16::to_le_bytes).concat();
    std::fs::write(&path, [header.as_bytes(), &voxels].concat()).unwrap();
    path
}

/// Regression: selecting a series or resampling slices was silently ignored for other formats.
#[test]
fn choices_for_dicom_are_said_to_have_no_effect_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let path = two_voxels(folder.path());
    let noted = |options: &ReadOptions| read_as(&path, options).unwrap().1.notes.join("\n");
    let series = noted(&ReadOptions { series: Some("1.2.3".to_owned()), ..ReadOptions::default() });
    assert!(series.contains("`volume.series`") && !series.contains("rectify"), "{series}");
    let slices = noted(&ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() });
    assert!(slices.contains("`volume.resample`") && !slices.contains("series`"), "{slices}");
    let neither = noted(&ReadOptions::default());
    assert!(!neither.contains("no effect"), "{neither}");
    write_series(folder.path(), &stack(&[0.0, 2.0]));
    std::fs::remove_file(path).unwrap();
    let of_dicom = ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() };
    let info = read_as(folder.path(), &of_dicom).unwrap().1.to_string();
    assert!(!info.contains("no effect"), "{info}");
}

/// Regression: a CT opened as a label map had its air turned into bone.
#[test]
fn hounsfield_units_are_no_labels() {
    let folder = tempfile::tempdir().unwrap();
    let path = two_voxels(folder.path());
    for label in [-1000, 300] {
        let options = ReadOptions { label: Some(Label::Value(label)), ..ReadOptions::default() };
        let said = read_as(&path, &options).unwrap_err().to_string();
        assert!(said.contains("which holds -1000") && said.contains("Hounsfield"), "{said}");
    }
}

/// A frame with a header of 20000 x 20000 pixels in a few bytes, whose decoder would invent the missing data.
#[test]
fn packed_frames_that_cannot_hold_their_pixels_are_refused_before_they_take_memory() {
    let jls = [
        0xff, 0xd8, 0xff, 0xf7, 0, 11, 16, 0x4e, 0x20, 0x4e, 0x20, 1, 1, 0x11, 0, 0xff, 0xda, 0, 8, 1, 1, 0,
        0, 0, 0, 0, 0xff, 0xd9,
    ];
    let slice = DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.4.80",
        rows: 20_000,
        columns: 20_000,
        fragment: Some(jls.to_vec()),
        ..DicomSlice::default()
    };
    let error = refuse(&slice.bytes()).to_string();
    assert!(error.contains("cannot hold 400000000 pixels"), "{error}");
}

#[test]
fn a_deflated_data_set_that_grows_without_end_is_refused() {
    use std::io::Write;
    let slice = DicomSlice { transfer_syntax: "1.2.840.10008.1.2.1.99", ..DicomSlice::default() }.bytes();
    // After the meta group, whose length is in its first element.
    let begin = 132 + 12 + u32::from_le_bytes(slice[140..144].try_into().unwrap()) as usize;
    let deflated = |data: &[u8]| {
        let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(data).unwrap();
        [&slice[..begin], &encoder.finish().unwrap()].concat()
    };
    assert!(read_bytes("v.dcm", &deflated(&slice[begin..])).unwrap().hu.iter().all(|hu| *hu == 0));
    // Zeros are no data set; inflating must stop at the largest file size.
    refuse(&deflated(&vec![0; 64 << 20]));
}

/// Regression: MR slices in a CT's series were read as Hounsfield units if the first slice was CT.
#[test]
fn a_series_of_two_modalities_is_refused() {
    let mut slices = stack(&[0.0, 2.0, 4.0]);
    slices[2].modality = "MR";
    let error = read(series(&slices).path()).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, VolumeError::MixedSeries { .. }), "{said}");
    assert!(said.contains("Modality") && said.contains("002.dcm"), "{said}");
}

/// Regression: `volume info` reported only the slope of the first slice.
#[test]
fn slices_of_several_slopes_are_each_scaled_by_their_own_and_it_is_said() {
    let mut slices = stack(&[0.0, 2.0]);
    slices[1].slope = "2";
    let (volume, info) = read_as(series(&slices).path(), &ReadOptions::default()).unwrap();
    assert_eq!((volume.hu[0], volume.hu[20]), (0, 1024));
    assert!(info.to_string().contains("slope and intercept of each slice"), "{info}");
}

/// Regression: stored values of 1024 and more were silently read as bone.
#[test]
fn values_that_need_not_be_hounsfield_units_are_said() {
    let noted = |change: fn(&mut DicomSlice)| {
        let mut slices = stack(&[0.0, 2.0]);
        slices.iter_mut().for_each(change);
        read_as(series(&slices).path(), &ReadOptions::default()).unwrap().1.to_string()
    };
    let without = noted(|slice| slice.intercept = None);
    assert!(without.contains("no RescaleIntercept (0028,1052)"), "{without}");
    let unspecified = noted(|slice| slice.rescale_type = Some("US"));
    assert!(unspecified.contains("RescaleType (0028,1054) is `US`"), "{unspecified}");
    for plain in [noted(|_| ()), noted(|slice| slice.rescale_type = Some("HU"))] {
        assert!(!plain.contains("Rescale"), "{plain}");
    }
}

/// Regression: in slices without rescale the stored values stood beside the Hounsfield units of the others,
/// 1024 HU off, with a note that spoke of the whole series.
#[test]
fn a_rescale_that_only_some_slices_have_is_refused_unless_it_changes_nothing() {
    let with = |intercepts: [Option<&'static str>; 2]| {
        let mut slices = stack(&[0.0, 2.0]);
        (slices[0].intercept, slices[1].intercept) = (intercepts[0], intercepts[1]);
        read_as(series(&slices).path(), &ReadOptions::default()).map(|(_, info)| info.notes.join("; "))
    };
    for intercepts in [[None, Some("-1024")], [Some("-1024"), None]] {
        let error = with(intercepts).unwrap_err();
        assert!(matches!(error, VolumeError::MixedSeries { .. }), "{error}");
    }
    let same = with([Some("0"), None]).unwrap();
    assert!(same.contains("no RescaleIntercept (0028,1052) in 1 slice:"), "{same}");
}

/// Regression: small differences of the slice distance added up: a slice in the middle of 200 lay 0.95 mm
/// from where it was read, without a word.
#[test]
fn slice_distances_that_add_up_are_refused_or_said() {
    let at = |z_mm: &[f64]| {
        read_as(series(&stack(z_mm)).path(), &ReadOptions::default()).map(|(_, info)| info.notes.join("; "))
    };
    let of_two_steps = |count: usize, step: f64| -> Vec<f64> {
        (0..=2 * count).map(|i| i as f64 + (i.saturating_sub(count)) as f64 * (step - 1.0)).collect()
    };
    let error = at(&of_two_steps(50, 1.019)).unwrap_err();
    assert!(matches!(error, VolumeError::VariableSpacing { .. }), "{error}");
    assert!(error.to_string().contains("050.dcm 0.475 mm from its place"), "{error}");
    let noted = at(&of_two_steps(10, 1.019 - 0.001)).unwrap();
    assert!(noted.contains("at worst 010.dcm 0.090 mm from its place"), "{noted}");
    assert_eq!(at(&[0.0, 1.0, 2.0, 3.001]).unwrap(), "");
}

/// Regression: `--rectify` invented tissue in a gap of 67 slice distances and stated an error of 4.5 HU.
#[test]
fn a_wide_gap_is_not_filled_and_the_worst_slice_is_named() {
    let rectified = |z_mm: &[f64]| {
        let mut slices = stack(z_mm);
        slices[2].stored = 1524;
        let options = ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() };
        read_as(series(&slices).path(), &options).map(|(_, info)| info.notes.join("; "))
    };
    let error = rectified(&[0.0, 1.0, 2.0, 3.0, 8.5, 9.5]).unwrap_err();
    assert!(matches!(error, VolumeError::Gap { .. }), "{error}");
    assert!(error.to_string().contains("5.5000 mm between 003.dcm and 004.dcm"), "{error}");
    let noted = rectified(&[0.0, 1.0, 2.0, 3.0, 7.0, 8.0]).unwrap();
    assert!(noted.contains("500.0 HU in the worst slice, at 2.000 mm"), "{noted}");
}

/// Regression: padding outside the reconstructed field became the densest bone.
#[test]
fn pixel_padding_is_air() {
    // A slice of padding below one of 1024, which is 0 HU. The padding value's VR has the other sign at last.
    let paddings: [(i16, [u8; 2], &[u8]); 3] =
        [(32767, [0xff, 0x7f], b"SS"), (-2000, [0x30, 0xf8], b"SS"), (2000, [0xd0, 0x07], b"US")];
    for (stored, value, vr) in paddings {
        let folder = tempfile::tempdir().unwrap();
        for (number, stored) in [stored, 1024].into_iter().enumerate() {
            let slice =
                DicomSlice { stored, position_mm: [0.0, 0.0, number as f64], ..DicomSlice::default() };
            let element = [&[0x28, 0, 0x20, 1], vr, &[2, 0], &value].concat();
            let bytes = inserted(&slice.bytes(), b"\x28\0\x52\x10DS", &element);
            std::fs::write(folder.path().join(format!("{number}.dcm")), bytes).unwrap();
        }
        let (volume, info) = read_as(folder.path(), &ReadOptions::default()).unwrap();
        let notes = info.notes.join("; ");
        assert_eq!(volume.hu[20], 0);
        if stored < 0 {
            // Below air already.
            assert_eq!((volume.hu[0], notes.as_str()), (-3024, ""));
        } else {
            assert_eq!(volume.hu[0], -1000);
            assert!(notes.contains("20 of 40 voxels were padding (PixelPaddingValue)"), "{notes}");
        }
    }
}

/// The bytes with an element before the one that starts with `next`.
fn inserted(bytes: &[u8], next: &[u8], element: &[u8]) -> Vec<u8> {
    let at = bytes.windows(next.len()).position(|window| window == next).unwrap();
    [&bytes[..at], element, &bytes[at..]].concat()
}

/// Regression: neighbours of a named slice that could not be read were dropped without a word; a file of
/// another series spoiled the named one.
#[test]
fn an_unreadable_file_is_refused_in_the_series_and_noted_beside_it() {
    let folder = series(&stack(&[0.0, 2.0]));
    let first = folder.path().join("000.dcm");
    let bad = folder.path().join("bad.dcm");
    let read = |path: &Path, series: Option<&str>| {
        let options = ReadOptions { series: series.map(str::to_owned), ..ReadOptions::default() };
        read_as(path, &options).map(|(volume, info)| (volume.grid.dims()[2], info.notes.join("; ")))
    };
    // The pixels are missing in part.
    let other = DicomSlice { series_uid: "1.2.9", ..DicomSlice::default() }.bytes();
    std::fs::write(&bad, &other[..other.len() - 2]).unwrap();
    for (path, series) in [(first.as_path(), None), (folder.path(), None), (folder.path(), Some("1.2.3"))] {
        let (slices, notes) = read(path, series).unwrap();
        assert_eq!(slices, 2);
        assert!(notes.contains("unreadable DICOM files ignored: 1") && notes.contains("bad.dcm"), "{notes}");
    }
    // The same of the series itself.
    let own = DicomSlice { position_mm: [0.0, 0.0, 4.0], ..DicomSlice::default() }.bytes();
    std::fs::write(&bad, &own[..own.len() - 2]).unwrap();
    for (path, series) in [(first.as_path(), None), (folder.path(), None), (folder.path(), Some("1.2.3"))] {
        assert!(matches!(read(path, series), Err(VolumeError::Truncated { .. })));
    }
    // A file that ends before its series.
    std::fs::write(&bad, &own[..own.len() - 300]).unwrap();
    assert!(read(folder.path(), None).is_err());
    assert!(read(folder.path(), Some("1.2.3")).unwrap().1.contains("bad.dcm"));
    assert!(read(&first, None).unwrap().1.contains("bad.dcm"));
}
