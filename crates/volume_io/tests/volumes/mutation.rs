//! Random truncation and mutation of valid files: the readers return either a volume with as many voxels as
//! its grid, or an error; they never panic.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, JPEG_2000_SYNTAXES, LOSSLESS_JPEG, jpeg_2000};
use crate::common::nifti_bytes::NiftiBytes;
use crate::common::shared_data::shared;
use crate::common::{series, store};
use proptest::prelude::*;
use std::path::Path;
use volume_io::{read, write_nrrd};
use voxel_grid::{Volume, VoxelGrid};

/// Bytes to overwrite as (position as a fraction of the mutated part, value), and the fraction of the file to
/// keep.
type Damage = (Vec<(f64, u8)>, f64);

fn damage() -> impl Strategy<Value = Damage> {
    let values =
        prop_oneof![any::<u8>(), Just(0), Just(0xff), Just(b'0'), Just(b'9'), Just(b'-'), Just(b' ')];
    (prop::collection::vec((0.0..1.0, values), 0..8), prop_oneof![3 => Just(1.0), 1 => 0.0..1.0])
}

/// Writes damaged bytes and reads them; `header` is the number of leading bytes worth mutating.
fn attempt(name: &str, bytes: &[u8], header: usize, (changes, keep): &Damage) {
    let mut bytes = bytes.to_vec();
    for (place, value) in changes {
        let at = (place * header.min(bytes.len()) as f64) as usize;
        bytes[at] = *value;
    }
    bytes.truncate((keep * bytes.len() as f64) as usize);
    let (_folder, path) = store(name, &bytes);
    check(&path);
}

fn check(path: &Path) {
    match read(path) {
        Ok(volume) => assert_eq!(volume.hu.len(), volume.grid.voxel_count()),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

fn small_nifti() -> Vec<u8> {
    let affine = [[1.0, 0.0, 0.0, 5.0], [0.0, 2.0, 0.0, 6.0], [0.0, 0.0, 3.0, 7.0]];
    NiftiBytes::new([2, 3, 4], affine, &[7; 24]).0
}

fn small_nrrd() -> Vec<u8> {
    let grid = VoxelGrid::axis_aligned([2, 3, 4], [1e-3; 3], [0.0; 3]).unwrap();
    let volume = Volume { grid, hu: (0..24).collect() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v.nrrd");
    write_nrrd(&path, &volume).unwrap();
    std::fs::read(path).unwrap()
}

fn small_metaimage() -> Vec<u8> {
    let header = b"ObjectType = Image\nNDims = 3\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\n\
        ElementSpacing = 1 1 1\nDimSize = 2 3 4\nElementType = MET_SHORT\nElementDataFile = LOCAL\n";
    [header.as_slice(), &[1; 48]].concat()
}

fn small_rle() -> Vec<u8> {
    let mut fragment = vec![0_u8; 64];
    (fragment[0], fragment[4], fragment[8]) = (2, 64, 66);
    fragment.extend([(257_u16 - 20) as u8, 4, 19]);
    fragment.extend(0..=20_u8);
    let slice = DicomSlice {
        transfer_syntax: "1.2.840.10008.1.2.5",
        fragment: Some(fragment),
        ..DicomSlice::default()
    };
    slice.bytes()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn nifti(damage in damage()) {
        attempt("v.nii", &small_nifti(), 352, &damage);
    }

    #[test]
    fn nrrd(damage in damage()) {
        attempt("v.nrrd", &small_nrrd(), usize::MAX, &damage);
    }

    #[test]
    fn metaimage(damage in damage()) {
        attempt("v.mha", &small_metaimage(), 200, &damage);
    }

    #[test]
    fn dicom(damage in damage()) {
        attempt("v.dcm", &DicomSlice::default().bytes(), usize::MAX, &damage);
    }

    #[test]
    fn dicom_rle(damage in damage()) {
        attempt("v.dcm", &small_rle(), usize::MAX, &damage);
    }

    #[test]
    fn dicom_jpeg(damage in damage()) {
        let slice = DicomSlice {
            transfer_syntax: "1.2.840.10008.1.2.4.70",
            fragment: Some(LOSSLESS_JPEG.to_vec()),
            ..DicomSlice::default()
        };
        attempt("v.dcm", &slice.bytes(), usize::MAX, &damage);
        // Damages only the JPEG, so that every case reaches its decoder.
        let mut fragment = LOSSLESS_JPEG.to_vec();
        for (place, value) in &damage.0 {
            fragment[(place * 54.0) as usize] = *value;
        }
        attempt("v.dcm", &DicomSlice { fragment: Some(fragment), ..slice }.bytes(), 0, &(vec![], 1.0));
    }

    /// Damages only the codestream, and not its tile-part's length, so that most cases reach the decoder.
    #[test]
    fn dicom_jpeg_2000(damage in damage()) {
        let mut fragment = jpeg_2000(64, 80);
        for (place, value) in &damage.0 {
            let at = (place * fragment.len() as f64) as usize;
            if !(65..79).contains(&at) {
                fragment[at] = *value;
            }
        }
        let slice = DicomSlice {
            transfer_syntax: JPEG_2000_SYNTAXES[0],
            rows: 64,
            columns: 80,
            fragment: Some(fragment),
            ..DicomSlice::default()
        };
        attempt("v.dcm", &slice.bytes(), 0, &(vec![], 1.0));
    }

    #[test]
    fn arbitrary_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600), kind in 0..6_usize) {
        let (name, magic): (&str, &[u8]) = [
            ("v.nii", b"\x5c\x01\0\0".as_slice()),
            ("v.nii.gz", b"\x1f\x8b\x08\0"),
            ("v.nrrd", b"NRRD0005\n"),
            ("v.mha", b"ObjectType = Image\n"),
            ("v.img", b""),
            ("v.bin", b""),
        ][kind];
        attempt(name, &[magic, &bytes].concat(), 0, &(vec![], 1.0));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 120, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn dicom_folders(damage in damage(), z_mm in prop::collection::vec(-5.0..5.0_f64, 1..5)) {
        let slices: Vec<DicomSlice> = z_mm
            .iter()
            .map(|z| DicomSlice { position_mm: [0.0, 0.0, *z], ..DicomSlice::default() })
            .collect();
        let folder = series(&slices);
        let path = folder.path().join("000.dcm");
        let mut bytes = std::fs::read(&path).unwrap();
        for (place, value) in &damage.0 {
            let at = 132 + (place * (bytes.len() - 132) as f64) as usize;
            bytes[at] = *value;
        }
        std::fs::write(&path, bytes).unwrap();
        check(folder.path());
    }

    /// Real files: encodings and structures that the small ones lack.
    #[test]
    fn conformance_files(damage in damage(), pick in 0..9_usize) {
        let name = [
            "conformance/dicom_pydicom/MR_small.dcm",
            "conformance/dicom_pydicom/MR_small_bigendian.dcm",
            "conformance/dicom_pydicom/MR_small_implicit.dcm",
            "conformance/dicom_pydicom/CT_small.dcm",
            "conformance/dicom_pydicom/MR_small_jp2klossless.dcm",
            "conformance/nrrd/BallBinary30x30x30_gz.nrrd",
            "conformance/nrrd/BallBinary30x30x30_bz2.nrrd",
            "conformance/nrrd/BallBinary30x30x30_gz_lineskip.nrrd",
            "conformance/nifti/f32.nii.gz",
        ][pick];
        if let Some(path) = shared(name) {
            let file_name = path.file_name().unwrap().to_string_lossy().into_owned();
            attempt(&file_name, &std::fs::read(&path).unwrap(), 4000, &damage);
        }
    }
}
