//! Grey values of a micro-CT become Hounsfield units: HU = slope × grey + intercept.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::dicom_bytes::{DicomSlice, write_series};
use crate::common::nifti_bytes::NiftiBytes;
use crate::common::store;
use std::path::Path;
use volume_io::{GreyScale, ReadOptions, VolumeError, read_as};

const AFFINE: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Voxels and notes of a file whose grey values mean this.
fn converted(path: &Path, slope: f64, intercept: f64) -> Result<(Vec<i16>, String), VolumeError> {
    let grey = Some(GreyScale { slope, intercept });
    let (volume, info) = read_as(path, &ReadOptions { grey, ..ReadOptions::default() })?;
    Ok((volume.hu, info.notes.join("; ")))
}

fn nrrd(kind: &str, voxels: &[u8], count: usize) -> Vec<u8> {
    let header = format!(
        "NRRD0005\ntype: {kind}\ndimension: 3\nsizes: {count} 1 1\nspace: LPS\nspace directions: (1,0,0) \
         (0,1,0) (0,0,1)\nencoding: raw\nendian: little\n\n"
    );
    [header.as_bytes(), voxels].concat()
}

#[test]
fn grey_values_of_every_format_become_hounsfield_units() {
    let grey: [u16; 5] = [0, 1, 20_000, 40_001, 65_535];
    let (_folder, path) = store("v.nrrd", &nrrd("ushort", &grey.map(u16::to_le_bytes).concat(), 5));
    let (hu, notes) = converted(&path, 0.05, -1000.0).unwrap();
    assert_eq!(hu, [-1000, -1000, 0, 1000, 2277], "{notes}");
    assert!(notes.contains("Hounsfield units are 0.05 x the file's values + -1000"), "{notes}");
    assert!(notes.contains("3 of 5 voxels were rounded") && !notes.contains("clamped"), "{notes}");
    let (hu, _) = converted(&path, -0.05, 2000.0).unwrap();
    assert_eq!(hu, [2000, 2000, 1000, 0, -1277]);
    let (hu, notes) = converted(&path, 1.0, 100.0).unwrap();
    assert_eq!(hu, [100, 101, 20_100, 32_767, 32_767]);
    assert!(notes.contains("2 of 5 voxels were outside -32768..32767 and were clamped"), "{notes}");
    let (hu, _) = converted(&path, -1.0, 0.0).unwrap();
    assert_eq!(hu, [0, -1, -20_000, -32_768, -32_768]);

    // Attenuation, 1/cm, and air without a number.
    let attenuation = [0.0_f32, 1.25, 2.5, f32::NAN].map(f32::to_le_bytes).concat();
    let (_folder, path) = store("v.nrrd", &nrrd("float", &attenuation, 4));
    assert_eq!(converted(&path, 2000.0, -1000.0).unwrap().0, [-1000, 1500, 4000, -1000]);
    let (_folder, path) = store("v.nrrd", &nrrd("short", &[0, 1, 0, 255], 2));
    assert_eq!(converted(&path, 2.0, 1.0).unwrap().0, [513, -511], "int16 without a rescale of its own");

    let fields = "ObjectType = Image\nNDims = 3\nDimSize = 3 1 1\nElementSpacing = 1 1 1\nElementType = \
                  MET_UCHAR\nElementDataFile = LOCAL\n";
    let (_folder, path) = store("v.mha", &[fields.as_bytes(), &[0, 100, 255]].concat());
    assert_eq!(converted(&path, 10.0, -1000.0).unwrap().0, [-1000, 0, 1550]);
}

#[test]
fn the_files_own_rescale_comes_first() {
    let mut file = NiftiBytes::new([3, 1, 1], AFFINE, &[0, 100, -100]);
    file.put(112, &2.0_f32.to_le_bytes());
    file.put(116, &5.0_f32.to_le_bytes());
    let (_folder, path) = store("v.nii", &file.0);
    // 5, 205 and -195 as nibabel shows them.
    assert_eq!(converted(&path, 3.0, -15.0).unwrap().0, [0, 600, -600]);

    let folder = tempfile::tempdir().unwrap();
    let slice = |z| DicomSlice { slope: "2", stored: 1024, position_mm: [0.0, 0.0, z], ..Default::default() };
    write_series(folder.path(), &[slice(0.0), slice(1.0)]);
    let (hu, notes) = converted(folder.path(), 0.5, 7.0).unwrap();
    assert!(hu.iter().all(|hu| *hu == 519), "0.5 (2 x 1024 - 1024) + 7: {hu:?}");
    assert!(!notes.contains("read as Hounsfield units"), "{notes}");
    let bare = |z| DicomSlice { intercept: None, slope: "1", modality: "OT", ..slice(z) };
    write_series(folder.path(), &[bare(0.0), bare(1.0)]);
    let (hu, notes) = converted(folder.path(), 0.5, 7.0).unwrap();
    assert!(hu.iter().all(|hu| *hu == 519), "{hu:?}");
    assert!(!notes.contains("not Hounsfield units") && !notes.contains("read as"), "{notes}");
}

#[test]
fn a_slope_of_one_changes_no_bit_and_one_of_zero_is_refused() {
    let voxels = [-32_768_i16, -1000, 0, 1, 32_767].map(i16::to_le_bytes).concat();
    let (_folder, path) = store("v.nrrd", &nrrd("short", &voxels, 5));
    let (usual, info) = read_as(&path, &ReadOptions::default()).unwrap();
    assert_eq!(converted(&path, 1.0, 0.0).unwrap(), (usual.hu, info.notes.join("; ")));
    for (slope, intercept) in [(0.0, 1.0), (f64::NAN, 0.0), (f64::INFINITY, 0.0), (1.0, f64::NAN)] {
        let error = converted(&path, slope, intercept).unwrap_err().to_string();
        assert!(error.contains("v.nrrd") && error.contains("a slope that is not zero"), "{error}");
    }
}
