//! Tests of JPEG 2000 in DICOM: codestreams with false headers are refused before memory is allocated, and no
//! pixel is invented.
//!
//! Complete files of other programs are compared voxel by voxel in `variants`.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, JPEG_2000_SYNTAXES, jpeg_2000, jpeg_2000_of};
use crate::common::read_bytes;
use volume_io::VolumeError;
use voxel_grid::Volume;

/// Start bytes of segments and fields in [`jpeg_2000`].
const SIZ: usize = 2;
const COD: usize = 45;
const QCD: usize = 59;
const SOT: usize = 65;

fn slice(rows: u16, columns: u16, codestream: Vec<u8>) -> DicomSlice {
    DicomSlice {
        transfer_syntax: JPEG_2000_SYNTAXES[0],
        rows,
        columns,
        fragment: Some(codestream),
        ..DicomSlice::default()
    }
}

fn read_slice(slice: &DicomSlice) -> Result<Volume, VolumeError> {
    read_bytes("v.dcm", &slice.bytes())
}

/// The error of a slice of 5 x 4 pixels with a changed codestream.
fn refusal(change: impl FnOnce(&mut Vec<u8>)) -> String {
    let mut codestream = jpeg_2000(4, 5);
    change(&mut codestream);
    let said = read_slice(&slice(4, 5, codestream)).unwrap_err().to_string();
    println!("{said}");
    said
}

fn put(codestream: &mut [u8], at: usize, bytes: &[u8]) {
    codestream[at..at + bytes.len()].copy_from_slice(bytes);
}

#[test]
fn a_frame_is_what_openjpeg_makes_of_it() {
    let volume = read_slice(&slice(4, 5, jpeg_2000(4, 5))).unwrap();
    println!("{:?}", volume.hu);
    let stored: Vec<i32> = volume.hu.iter().map(|hu| i32::from(*hu) + 1024).collect();
    // Decoded by pydicom 3.0.2 with pylibjpeg-openjpeg 2.6.0.
    assert_eq!(stored, OPENJPEG);
    // The other syntax permits lossy data; and a fragment can be padded.
    let padded = DicomSlice {
        transfer_syntax: JPEG_2000_SYNTAXES[1],
        ..slice(4, 5, [jpeg_2000(4, 5), vec![0; 3]].concat())
    };
    assert_eq!(read_slice(&padded).unwrap().hu, volume.hu);
    // An empty packet is an empty image.
    let empty = read_slice(&slice(4, 5, jpeg_2000_of(4, 5, &[0]))).unwrap();
    assert!(empty.hu.iter().all(|hu| *hu == -1024));
}

const OPENJPEG: [i32; 20] = [
    1020, -2040, 756, -1228, -2042, -1524, -1022, -1436, -1006, 1532, 1908, 1018, 1974, 1012, -1208, -2042,
    968, -1518, -378, 2042,
];

#[test]
fn a_codestream_cut_anywhere_is_refused() {
    let whole = jpeg_2000(4, 5);
    for length in 0..whole.len() {
        let error = read_slice(&slice(4, 5, whole[..length].to_vec())).unwrap_err();
        assert!(matches!(error, VolumeError::Corrupt { codec: "JPEG 2000", .. }), "{length}: {error}");
    }
    // Codestreams with packet bytes removed and lengths adjusted to match are refused, too.
    for packet in 1..22 {
        let bytes = &whole[79..79 + packet];
        let error = read_slice(&slice(4, 5, jpeg_2000_of(4, 5, bytes))).unwrap_err();
        assert!(matches!(error, VolumeError::Corrupt { .. }), "{packet}: {error}");
    }
}

#[test]
fn a_frame_of_another_size_than_its_slice_is_refused() {
    let said = refusal(|data| put(data, SIZ + 6, &65_535_u32.to_be_bytes()));
    assert!(said.contains("4 x 65535 pixels in the frame, 4 x 5 in the header"), "{said}");
    let said = refusal(|data| put(data, SIZ + 14, &1_u32.to_be_bytes()));
    assert!(said.contains("begin at the origin"), "{said}");
}

/// Both headers agree on a false size, in 100 bytes.
#[test]
fn a_frame_that_cannot_hold_its_pixels_is_refused_before_it_takes_memory() {
    let cases = [
        (65_535, 0, "at most 536870912 voxels"),
        (20_000, 3_200_000, "at most 16777216 pixels"),
        (4096, 0, "cannot hold 16777216 pixels"),
    ];
    for (extent, padding, expected) in cases {
        let codestream = [jpeg_2000(extent, extent), vec![0; padding]].concat();
        let said = read_slice(&slice(extent, extent, codestream)).unwrap_err().to_string();
        println!("{said}");
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn other_components_than_one_grey_one_are_refused() {
    let said = refusal(|data| {
        put(data, SIZ + 2, &[0, 41 + 45]);
        put(data, SIZ + 38, &[0, 16]);
        let component = [0x8f, 1, 1].repeat(15);
        data.splice(SIZ + 43..SIZ + 43, component);
    });
    assert!(said.contains("16 components"), "{said}");
    assert!(refusal(|data| data[SIZ + 40] = 0x80 | 37).contains("38 bits per sample"));
    assert!(refusal(|data| data[SIZ + 41] = 2).contains("subsampled component"));
    let said = refusal(|data| data[SIZ + 40] = 12);
    assert!(said.contains("unsigned 13 bits in the codestream, signed 16 bits in the header"), "{said}");
}

#[test]
fn tiles_that_are_not_there_are_refused() {
    let tile = |data: &mut Vec<u8>, columns: u32, rows: u32| {
        put(data, SIZ + 22, &columns.to_be_bytes());
        put(data, SIZ + 26, &rows.to_be_bytes());
    };
    assert!(refusal(|data| tile(data, 1, 1)).contains("20 tiles in"));
    assert!(refusal(|data| tile(data, 0, 4)).contains("tiles of 4 x 0 pixels"));
    assert!(refusal(|data| tile(data, 5, 2)).contains("tile 1 of 2 is missing"));
    assert!(refusal(|data| data[SOT + 5] = 1).contains("tile 1 of 1"));
    assert!(refusal(|data| put(data, SOT + 6, &[0; 4])).contains("a tile-part of unstated length"));
    assert!(refusal(|data| put(data, SOT + 6, &[0xff; 4])).contains("no complete tile-part at byte 65"));
}

/// A quantization with 65532 values would be copied for every tile; layers and small precincts multiply the
/// record kept for each block.
#[test]
fn headers_that_multiply_memory_are_refused() {
    let said = refusal(|data| {
        put(data, QCD + 2, &u16::MAX.to_be_bytes());
        data.splice(QCD + 6..QCD + 6, vec![0; 65_531]);
    });
    assert!(said.contains("a quantization (QCD) out of range"), "{said}");
    let said = refusal(|data| put(data, COD + 6, &u16::MAX.to_be_bytes()));
    assert!(said.contains("a coding style (COD) out of range"), "{said}");
    assert!(refusal(|data| data[COD + 9] = 33).contains("a coding style (COD) out of range"));
    // 32 layers in precincts of one pixel.
    let extent = 1024;
    let mut codestream = jpeg_2000(extent, extent);
    put(&mut codestream, COD + 2, &[0, 13, 1, 0, 0, 32]);
    codestream.insert(COD + 14, 0);
    let said = read_slice(&slice(extent, extent, codestream)).unwrap_err().to_string();
    assert!(said.contains("precincts and layers of code-blocks, expected at most"), "{said}");
}

#[test]
fn what_is_not_read_of_jpeg_2000_is_named() {
    // A region of interest, a change of progression, packed packet headers.
    for marker in [0x5e, 0x5f, 0x60] {
        let said = refusal(|data| {
            data.splice(SOT..SOT, [0xff, marker, 0, 5, 0, 0, 7]);
        });
        assert!(said.contains(&format!("a segment with marker ff{marker:02x}")), "{said}");
    }
    let error =
        read_slice(&DicomSlice { transfer_syntax: "1.2.840.10008.1.2.4.92", ..slice(4, 5, jpeg_2000(4, 5)) });
    let said = error.unwrap_err().to_string();
    assert!(said.contains("JPEG 2000 part 2"), "{said}");
}
