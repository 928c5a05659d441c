//! Tests round trips and the geometry rules of each format, on small generated files.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, LOSSLESS_JPEG};
use crate::common::nifti_bytes::NiftiBytes;
use crate::common::{gzip, near, read_bytes, series, store};
use proptest::prelude::*;
use std::io::Write;
use std::path::Path;
use volume_io::{VolumeError, read, read_with_info, volume_hash, write_nrrd};
use voxel_grid::{Volume, VoxelGrid};

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// Voxels 0, 1, 2, … of a 2 x 3 x 4 volume.
fn counting() -> Vec<i16> {
    (0..24).collect()
}

fn little(voxels: &[i16]) -> Vec<u8> {
    voxels.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// A rotation from any four numbers that are not all zero, read as a quaternion.
fn rotation(q: [f64; 4]) -> [[f64; 3]; 3] {
    let n = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    let [x, y, z, w] = q.map(|c| c / n);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn nrrd_round_trip(
        dims in prop::array::uniform3(1_usize..9),
        q in prop::array::uniform4(-1.0..1.0_f64),
        spacing_mm in prop::array::uniform3(0.05..8.0_f64),
        origin_m in prop::array::uniform3(-2.0..2.0_f64),
        flip in any::<bool>(),
        seed in any::<u32>(),
    ) {
        prop_assume!(q.iter().map(|c| c * c).sum::<f64>() > 1e-2);
        let mut axes = rotation(q);
        if flip {
            axes[2] = axes[2].map(|x| -x);
        }
        let count = dims.iter().product::<usize>() as u32;
        let hu = (0..count)
            .map(|i| (i.wrapping_mul(2_654_435_761).wrapping_add(seed) >> 16) as u16 as i16)
            .collect();
        let grid = VoxelGrid::new(dims, spacing_mm.map(|s| s * 1e-3), origin_m, axes).unwrap();
        let volume = Volume { grid, hu };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("v.nrrd");
        write_nrrd(&path, &volume).unwrap();
        let (back, info) = read_with_info(&path).unwrap();
        prop_assert_eq!(&back.hu, &volume.hu);
        prop_assert_eq!(back.grid.dims(), volume.grid.dims());
        // A few rounding errors of numbers of order 1.
        near(&back.grid.spacing_m(), &volume.grid.spacing_m(), 1e-16);
        near(&back.grid.origin_m(), &volume.grid.origin_m(), 1e-15);
        near(&back.grid.direction().concat(), &volume.grid.direction().concat(), 1e-14);
        prop_assert!(info.notes.is_empty(), "{:?}", info.notes);
        // Writing the volume that was read gives the same volume again.
        prop_assert!(write_nrrd(&path, &back).is_err(), "no file is written over");
        std::fs::remove_file(&path).unwrap();
        write_nrrd(&path, &back).unwrap();
        prop_assert_eq!(read(&path).unwrap().hu, volume.hu);
        let p = back.grid.world_m([0.25, 1.5, -2.0]);
        near(&back.grid.voxel_at(p), &[0.25, 1.5, -2.0], 1e-9);
    }
}

#[test]
fn nifti_axes_become_lps() {
    let affine = [[-0.5, 0.0, 0.0, 10.0], [0.0, 0.0, 2.0, -20.0], [0.0, 1.5, 0.0, 30.0]];
    let file = NiftiBytes::new([2, 3, 4], affine, &counting());
    let volume = read_bytes("v.nii", &file.0).unwrap();
    near(&volume.grid.spacing_m(), &[0.5e-3, 1.5e-3, 2e-3], 1e-12);
    // i already pointed left; j points up; k pointed anterior, which is −y in LPS.
    assert_eq!(volume.grid.direction(), [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]);
    near(&volume.grid.origin_m(), &[-0.010, 0.020, 0.030], 1e-12);
    assert_eq!(volume.hu, counting());
    assert_eq!(volume.at([1, 2, 3]), Some(23));
    assert_eq!(read_bytes("v.nii.gz", &gzip(&file.0)).unwrap(), volume);
    // The content decides, not the name.
    assert_eq!(read_bytes("scan.bin", &file.0).unwrap(), volume);
}

#[test]
fn nifti_quaternion_and_units() {
    let mut file = NiftiBytes::new([2, 3, 4], [[0.0; 4]; 3], &counting());
    file.put(254, &0_i16.to_le_bytes());
    file.put(252, &1_i16.to_le_bytes());
    // A quarter turn about z: (b, c, d) = (0, 0, √½); qfac −1; voxels of 0.001, 0.002, 0.003 m.
    file.put(264, &std::f32::consts::FRAC_1_SQRT_2.to_le_bytes());
    for (i, value) in [-1.0_f32, 1e-3, 2e-3, 3e-3].into_iter().enumerate() {
        file.put(76 + 4 * i, &value.to_le_bytes());
    }
    file.put(268, &0.5_f32.to_le_bytes());
    file.put(123, &[1]);
    let (_folder, path) = store("v.nii", &file.0);
    let (volume, info) = read_with_info(&path).unwrap();
    near(&volume.grid.spacing_m(), &[1e-3, 2e-3, 3e-3], 1e-9);
    // RAS columns (0,1,0), (−1,0,0), (0,0,−1); x and y flip.
    near(&volume.grid.direction().concat(), &[0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0], 1e-6);
    near(&volume.grid.origin_m(), &[-0.5, 0.0, 0.0], 1e-9);
    assert_eq!(info.units, "m");
    file.put(76 + 4, &500.0_f32.to_le_bytes());
    file.put(76 + 8, &600.0_f32.to_le_bytes());
    file.put(76 + 12, &700.0_f32.to_le_bytes());
    file.put(123, &[3]);
    near(&read_bytes("v.nii", &file.0).unwrap().grid.spacing_m(), &[5e-4, 6e-4, 7e-4], 1e-10);
}

#[test]
fn nifti2_is_read() {
    let mut bytes = vec![0_u8; 544];
    let mut put = |at: usize, value: &[u8]| bytes[at..at + value.len()].copy_from_slice(value);
    put(0, &540_i32.to_be_bytes());
    put(4, b"n+2\0\r\n\x1a\n");
    put(12, &16_i16.to_be_bytes());
    put(14, &32_i16.to_be_bytes());
    for (i, n) in [3_i64, 2, 3, 4, 1, 1, 1, 1].into_iter().enumerate() {
        put(16 + 8 * i, &n.to_be_bytes());
    }
    put(168, &544_i64.to_be_bytes());
    put(176, &2.0_f64.to_be_bytes());
    put(184, &(-1.0_f64).to_be_bytes());
    put(348, &1_i32.to_be_bytes());
    for row in 0..3 {
        put(400 + 32 * row + 8 * row, &1.0_f64.to_be_bytes());
    }
    bytes.extend(counting().iter().flat_map(|v| f32::from(*v).to_be_bytes()));
    let (_folder, path) = store("v.nii", &bytes);
    let (volume, info) = read_with_info(&path).unwrap();
    assert_eq!(volume.hu, counting().iter().map(|v| 2 * v - 1).collect::<Vec<_>>());
    assert_eq!(info.format, "NIfTI-2 (raw)");
}

#[test]
fn floats_are_rounded_and_clamped_with_a_note() {
    let mut file =
        NiftiBytes::new([2, 2, 1], [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], &[]);
    file.put(70, &16_i16.to_le_bytes());
    file.put(72, &32_i16.to_le_bytes());
    for value in [1.5_f32, -2.5, 1e6, f32::NAN] {
        file.0.extend(value.to_le_bytes());
    }
    let (_folder, path) = store("v.nii", &file.0);
    let (volume, info) = read_with_info(&path).unwrap();
    assert_eq!(volume.hu, [2, -3, i16::MAX, -1000]);
    let text = info.to_string();
    for part in
        ["1 of 4 voxels were outside", "2 of 4 voxels were rounded", "1 of 4 voxels were not a number"]
    {
        assert!(text.contains(part), "{text}");
    }
}

fn nrrd(fields: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes =
        format!("NRRD0004\ntype: short\ndimension: 3\nsizes: 2 3 4\nendian: little\n{fields}\n\n")
            .into_bytes();
    bytes.extend(data);
    bytes
}

#[test]
fn nrrd_spaces_units_and_encodings() {
    let data = little(&counting());
    let directions = "space directions: (1,0,0) (0,2,0) (0,0,3)\nspace origin: (10,20,30)\nencoding: raw";
    for (space, sign) in [
        ("left-posterior-superior", [1.0, 1.0, 1.0]),
        ("RAS", [-1.0, -1.0, 1.0]),
        ("left-anterior-superior", [1.0, -1.0, 1.0]),
        ("right-posterior-inferior", [-1.0, 1.0, -1.0]),
    ] {
        let volume = read_bytes("v.nrrd", &nrrd(&format!("space: {space}\n{directions}"), &data)).unwrap();
        near(&volume.grid.spacing_m(), &[1e-3, 2e-3, 3e-3], 1e-15);
        for (axis, sign) in sign.into_iter().enumerate() {
            assert_eq!(volume.grid.direction()[axis][axis], sign, "{space}");
            near(&[volume.grid.origin_m()[axis]], &[sign * 0.01 * (axis + 1) as f64], 1e-15);
        }
        assert_eq!(volume.hu, counting());
    }
    let lps = "space: left-posterior-superior\nspace directions: (1,0,0) (0,2,0) (0,0,3)\n";
    let microns =
        read_bytes("v.nrrd", &nrrd(&format!("{lps}space units: \"um\" \"um\" \"um\"\nencoding: raw"), &data));
    near(&microns.unwrap().grid.spacing_m(), &[1e-6, 2e-6, 3e-6], 1e-18);
    let text = counting().iter().map(i16::to_string).collect::<Vec<_>>().join(" ");
    assert_eq!(
        read_bytes("v.nrrd", &nrrd(&format!("{lps}encoding: ascii"), text.as_bytes())).unwrap().hu,
        counting()
    );
    let big: Vec<u8> = counting().iter().flat_map(|v| v.to_be_bytes()).collect();
    let big_endian =
        nrrd(&format!("{lps}encoding: gzip\nbyte skip: 3"), &gzip(&[b"abc", big.as_slice()].concat()));
    let big_endian = String::from_utf8_lossy(&big_endian[..80]).replace("little", "big   ").into_bytes()
        [..80]
        .iter()
        .chain(&big_endian[80..])
        .copied()
        .collect::<Vec<u8>>();
    assert_eq!(read_bytes("v.nrrd", &big_endian).unwrap().hu, counting());
}

#[test]
fn metaimage_local_and_detached() {
    let header = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
        TransformMatrix = 0 1 0 -1 0 0 0 0 1\nOffset = 10 20 30\nElementSpacing = 1 2 3\nDimSize = 2 3 4\n\
        AnatomicalOrientation = RAI\nElementType = MET_SHORT\n";
    let data = little(&counting());
    let file = |fields: &str, data: &[u8]| [header.as_bytes(), fields.as_bytes(), data].concat();
    let plain = read_bytes("v.mha", &file("ElementDataFile = LOCAL\n", &data)).unwrap();
    assert_eq!(plain.hu, counting());
    near(&plain.grid.spacing_m(), &[1e-3, 2e-3, 3e-3], 1e-15);
    near(&plain.grid.origin_m(), &[0.01, 0.02, 0.03], 1e-15);
    // Row 0 of the matrix is the direction of i: posterior.
    assert_eq!(plain.grid.direction(), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
    let compressed = zlib(&data);
    let fields = format!(
        "CompressedData = True\nCompressedDataSize = {}\nElementDataFile = LOCAL\n",
        compressed.len()
    );
    assert_eq!(read_bytes("v.mha", &file(&fields, &compressed)).unwrap(), plain);
    let (folder, path) = store("v.mhd", &file("HeaderSize = 4\nElementDataFile = v.img\n", b""));
    std::fs::write(folder.path().join("v.img"), [b"junk", data.as_slice(), b"tail"].concat()).unwrap();
    assert_eq!(read(&path).unwrap(), plain);
    let (folder, path) = store("v.mhd", &file("HeaderSize = -1\nElementDataFile = v.raw\n", b""));
    std::fs::write(folder.path().join("v.raw"), [b"junk", data.as_slice()].concat()).unwrap();
    assert_eq!(read(&path).unwrap(), plain);
}

#[test]
fn dicom_series_geometry() {
    // Oblique: rows along −y, columns along −z, so slices stack along −x × … = (−y) × (−z) = +x.
    let slices: Vec<DicomSlice> = [4.0, 0.0, 2.0]
        .map(|x| DicomSlice {
            position_mm: [x, 7.0, 9.0],
            orientation: "0\\-1\\0\\0\\0\\-1",
            stored: 1024 + x as i16,
            ..DicomSlice::default()
        })
        .to_vec();
    let folder = series(&slices);
    let volume = read(folder.path()).unwrap();
    assert_eq!(volume.grid.dims(), [5, 4, 3]);
    // PixelSpacing 2\3: rows 2 mm apart, columns 3 mm apart.
    near(&volume.grid.spacing_m(), &[3e-3, 2e-3, 2e-3], 1e-15);
    assert_eq!(volume.grid.direction(), [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]);
    near(&volume.grid.origin_m(), &[0.0, 0.007, 0.009], 1e-15);
    assert_eq!([0, 1, 2].map(|k| volume.at([0, 0, k]).unwrap()), [0, 2, 4]);
    assert_eq!(read(folder.path().join("001.dcm")).unwrap(), volume);
}

#[test]
fn dicom_rle() {
    // Two planes of 20 pixels: the high byte 4 repeated, the low bytes 1..20 literally; 1024 + 1 … 1024 + 20.
    let mut fragment = vec![0_u8; 64];
    fragment[0] = 2;
    fragment[4] = 64;
    fragment[8] = 66;
    fragment.extend([(257_u16 - 20) as u8, 4, 19]);
    fragment.extend(1..=20_u8);
    fragment.push(0);
    let slice = DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.5",
        fragment: Some(fragment),
        ..DicomSlice::default()
    };
    let volume = read_bytes("v.dcm", &slice.bytes()).unwrap();
    assert_eq!(volume.hu, (1..=20).collect::<Vec<i16>>());
}

#[test]
fn dicom_lossless_jpeg() {
    let slice = DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.4.70",
        fragment: Some(LOSSLESS_JPEG.to_vec()),
        ..DicomSlice::default()
    };
    assert_eq!(read_bytes("v.dcm", &slice.bytes()).unwrap().hu, [0; 20]);
    // The JPEG states 5 × 4, the header 5 × 3.
    let other = DicomSlice { rows: 3, ..slice };
    assert!(matches!(read_bytes("v.dcm", &other.bytes()), Err(VolumeError::Corrupt { .. })));
}

#[test]
fn hash_is_of_geometry_and_voxels() {
    let volume = |z_m, hu| {
        let grid = VoxelGrid::axis_aligned([2, 1, 1], [1e-3; 3], [0.0, 0.0, z_m]).unwrap();
        Volume { grid, hu: vec![hu, -2] }
    };
    let hash = volume_hash(&volume(0.0, 1));
    assert_eq!(volume_hash(&volume(-0.0, 1)), hash);
    let text: String = hash.iter().map(|b| format!("{b:02x}")).collect();
    // Python: hashlib.sha256(b'trabecula volume v1\0' + struct.pack('<3Q15d2h', 2,1,1, *[1e-3]*3, 0,0,0,
    // 1,0,0,0,1,0,0,0,1, 1,-2))
    assert_eq!(text, EXPECTED_HASH);
    assert_ne!(volume_hash(&volume(1e-9, 1)), hash);
    assert_ne!(volume_hash(&volume(0.0, 2)), hash);
}

const EXPECTED_HASH: &str = "26333c5f86dfb565fc7cbe668629284b98b8bed9fcb21596476fee0cb4ebdf03";

#[test]
fn writing_refuses_an_inconsistent_volume() {
    let grid = VoxelGrid::axis_aligned([2; 3], [1e-3; 3], [0.0; 3]).unwrap();
    let volume = Volume { grid, hu: vec![0; 7] };
    assert!(matches!(write_nrrd(Path::new("/nonexistent/v.nrrd"), &volume), Err(VolumeError::Header { .. })));
    let whole = Volume { hu: vec![0; 8], ..volume };
    assert!(matches!(write_nrrd(Path::new("/nonexistent/v.nrrd"), &whole), Err(VolumeError::Output(_))));
}

/// Regression: slices that were resampled upright keep the tag, and positions that ignore the tilt give a
/// sheared volume; neither was reported.
#[test]
fn a_gantry_tilt_in_the_tags_alone_is_noted() {
    let notes = |gantry_tilt| {
        let slice = |z| DicomSlice { position_mm: [0.0, 0.0, z], gantry_tilt, ..DicomSlice::default() };
        read_with_info(series(&[slice(0.0), slice(2.0), slice(4.0)]).path()).unwrap().1.notes.join("; ")
    };
    assert!(
        notes(Some("-15.5"))
            .contains("GantryDetectorTilt (0018,1120) is -15.5 degrees, but the slices are stacked straight")
    );
    assert_eq!(notes(Some("0.0")), "");
    assert_eq!(notes(None), "");
}

/// Regression: axes with four decimals (dcm2niix of some series) passed every check and ended a run after its
/// start; they are made perpendicular, with a note.
#[test]
fn axes_of_four_decimals_are_made_perpendicular_with_a_note() {
    let (row, column) = ([0.9141_f32, 0.393, -0.0998], [-0.3688_f32, 0.9082, 0.1977]);
    let cross = |a: usize, b: usize| row[a] * column[b] - row[b] * column[a];
    let normal = [cross(1, 2), cross(2, 0), cross(0, 1)];
    let affine = [0, 1, 2].map(|i| [row[i], column[i], normal[i], 0.0]);
    let file = NiftiBytes::new([2, 3, 4], affine, &[7; 24]);
    let (_folder, path) = store("v.nii", &file.0);
    let (volume, info) = read_with_info(&path).unwrap();
    let notes = info.notes.join("; ");
    assert!(notes.contains("the axes were made perpendicular (largest cosine "), "{notes}");
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        let axes = volume.grid.axes();
        let cosine: f64 = (0..3).map(|row| axes[a][row] * axes[b][row]).sum();
        assert!(cosine.abs() < 1e-15, "{a} {b}: {cosine:e}");
    }
    let straight = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let (_folder, path) = store("v.nii", &NiftiBytes::new([2, 3, 4], straight, &[7; 24]).0);
    assert!(!read_with_info(&path).unwrap().1.notes.iter().any(|note| note.contains("perpendicular")));
}
