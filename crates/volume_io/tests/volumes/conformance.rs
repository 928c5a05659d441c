//! Tests the readers on files of other projects (shared data), and against the `nifti` crate.
//!
//! Expected figures come from the files' own projects (pynrrd, nifti-rs, nibabel, pydicom, mdai-utils,
//! TotalSegmentator) as opened with SimpleITK, nibabel and pydicom. Skipped, loudly, where the shared data
//! are absent.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used)]

use crate::common::near;
use crate::common::shared_data::shared;
use nifti::{NiftiObject, NiftiVolume, RandomAccessNiftiVolume, ReaderOptions};
use volume_io::{VolumeError, read, read_with_info};
use voxel_grid::Volume;

/// Axis-aligned with the world.
const WORLD: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

fn sum(volume: &Volume) -> i64 {
    volume.hu.iter().map(|v| i64::from(*v)).sum()
}

#[test]
fn nrrd_ball_in_every_encoding() {
    let Some(folder) = shared("conformance/nrrd") else { return };
    for name in [
        "BallBinary30x30x30.nhdr",
        "BallBinary30x30x30.nrrd",
        "BallBinary30x30x30_bz2.nrrd",
        "BallBinary30x30x30_byteskip_minus_one.nhdr",
        "BallBinary30x30x30_byteskip_minus_one_nifti.nhdr",
        "BallBinary30x30x30_gz.nrrd",
        "BallBinary30x30x30_gz_byteskip_minus_one.nrrd",
        "BallBinary30x30x30_gz_lineskip.nrrd",
    ] {
        let (volume, info) = read_with_info(folder.join(name)).unwrap();
        println!("{name}: sum {} as {}", sum(&volume), info.format);
        assert_eq!(volume.grid.dims(), [30; 3], "{name}");
        assert_eq!(sum(&volume), 3_682_296, "{name}");
        near(&volume.grid.spacing_m(), &[1e-3; 3], 1e-18);
        assert_eq!(volume.grid.direction(), WORLD);
        assert_eq!(volume.hu.len(), 27_000);
    }
}

#[test]
fn nrrd_refusals() {
    let Some(folder) = shared("conformance/nrrd") else { return };
    let error = |name: &str| read(folder.join(name)).unwrap_err();
    // −5 is not a valid byte skip; −1 is the only negative one.
    let skip = error("BallBinary30x30x30_byteskip_minus_five.nhdr");
    assert!(matches!(&skip, VolumeError::Header { field, .. } if field.name == "byte skip"), "{skip}");
    // The data file is a NIfTI file, and the header does not skip its header: every voxel would be shifted.
    let shifted = error("BallBinary30x30x30_nifti.nhdr");
    assert!(matches!(&shifted, VolumeError::Header { .. }), "{shifted}");
    for name in ["test1d_ascii.nrrd", "test2d_ascii.nrrd", "test_customFields.nrrd"] {
        let flat = error(name);
        assert!(matches!(&flat, VolumeError::NotThreeDimensional { .. }), "{name}: {flat}");
        println!("{flat}");
    }
}

#[test]
fn nifti_voxel_types() {
    let Some(folder) = shared("conformance/nifti") else { return };
    for kind in ["int8", "int16", "int32", "uint8", "uint16", "uint32", "uint64", "float32", "float64"] {
        let volume = read(folder.join(format!("27_{kind}.nii"))).unwrap();
        assert_eq!(volume.grid.dims(), [3; 3]);
        // sform 1 mm RAS: LPS directions (−1, −1, 1).
        near(&volume.grid.direction().concat(), &[-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], 0.0);
        // The voxels count from 0 in C order.
        let expected: Vec<i16> = (0..27).map(|n| 9 * (n % 3) + n / 3 % 3 * 3 + n / 9).collect();
        assert_eq!(volume.hu, expected, "{kind}");
    }
}

#[test]
fn nifti_pairs_headers_and_byte_orders() {
    let Some(folder) = shared("conformance/nifti") else { return };
    let plain = read(folder.join("minimal.nii")).unwrap();
    assert_eq!(plain.grid.dims(), [64, 64, 10]);
    near(&plain.grid.spacing_m(), &[3e-3; 3], 1e-9);
    for name in
        ["minimal.nii.gz", "minimal.hdr", "minimal.hdr.gz", "minimal.img", "minimal2.hdr", "minimal2.img.gz"]
    {
        assert_eq!(read(folder.join(name)).unwrap(), plain, "{name}");
    }
    // Big-endian, both codes set; nibabel: affine diag(−2, 2, 2), offset (32, −40, −16) mm RAS.
    let anatomical = read(folder.join("anatomical.nii")).unwrap();
    assert_eq!(anatomical.grid.dims(), [33, 41, 25]);
    near(&anatomical.grid.spacing_m(), &[2e-3; 3], 1e-9);
    near(&anatomical.grid.direction().concat(), &[1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], 1e-6);
    near(&anatomical.grid.origin_m(), &[-0.032, 0.040, -0.016], 1e-9);
    let standard = read(folder.join("standard.nii.gz")).unwrap();
    assert_eq!(standard.grid.dims(), [4, 5, 7]);
    near(&standard.grid.spacing_m(), &[1e-3, 3e-3, 2e-3], 1e-9);
    assert_eq!(read(folder.join("f32.nii.gz")).unwrap().grid.dims(), [11; 3]);
}

#[test]
fn nifti_refusals_and_crashers() {
    let Some(folder) = shared("conformance/nifti") else { return };
    let error = |name: &str| read(folder.join(name)).unwrap_err();
    assert!(matches!(error("complex_complex32.nii"), VolumeError::NotScalar { .. }));
    assert!(matches!(error("functional.nii"), VolumeError::NotThreeDimensional { .. }));
    assert!(matches!(error("minimal_extended_hdr.nii"), VolumeError::NotThreeDimensional { .. }));
    // Headers of both versions whose image file is absent.
    for name in ["nifti1.hdr", "nifti2.hdr"] {
        assert!(matches!(error(name), VolumeError::Header { field, .. } if field.name == "magic"), "{name}");
    }
    let mut crashers = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        if path.file_name().unwrap().to_string_lossy().contains("crash") {
            println!("{}", read(&path).unwrap_err());
            crashers += 1;
        }
    }
    assert_eq!(crashers, 4);
}

/// Voxels and affine compared with the `nifti` crate, on every file that both can read.
#[test]
fn nifti_against_the_nifti_crate() {
    let names = [
        "conformance/nifti/27_int16.nii",
        "conformance/nifti/27_float64.nii",
        "conformance/nifti/anatomical.nii",
        "conformance/nifti/standard.nii.gz",
        "conformance/nifti/f32.nii.gz",
        "conformance/nrrd/BallBinary30x30x30.nii.gz",
        "totalsegmentator_example/example_ct.nii.gz",
        "totalsegmentator_example/seg_femur_right.nii.gz",
        "seed_rfemur_mask/rfemur_mask_1mm_cropped.nii.gz",
    ];
    for name in names {
        let Some(path) = shared(name) else { continue };
        let ours = read(&path).unwrap();
        let object = ReaderOptions::new().read_file(&path).unwrap();
        let header = object.header().clone();
        let theirs = object.into_volume();
        assert_eq!(theirs.dim().iter().map(|n| usize::from(*n)).collect::<Vec<_>>(), ours.grid.dims());
        let step = (ours.hu.len() / 20_000).max(1);
        for index in (0..ours.hu.len()).step_by(step) {
            let [ni, nj, _] = ours.grid.dims();
            let voxel = [index % ni, index / ni % nj, index / (ni * nj)].map(|n| n as u16);
            let value = theirs.get_f64(&voxel).unwrap();
            assert_eq!(value.round().clamp(-32768.0, 32767.0) as i16, ours.hu[index], "{name} {voxel:?}");
        }
        if header.sform_code > 0 {
            let rows = [header.srow_x, header.srow_y, header.srow_z];
            let sign = [-1.0, -1.0, 1.0];
            for (row, values) in rows.iter().enumerate() {
                let lps = values.map(|v| sign[row] * f64::from(v));
                let mine = [0, 1, 2]
                    .map(|axis| ours.grid.direction()[row][axis] * ours.grid.spacing_m()[axis] * 1e3);
                // f32 affine: 1e-6 relative.
                near(&mine, &lps[..3], 1e-5);
                near(&[ours.grid.origin_m()[row] * 1e3], &lps[3..], 1e-4);
            }
        }
    }
}

#[test]
fn totalsegmentator_ct() {
    let Some(path) = shared("totalsegmentator_example/example_ct.nii.gz") else { return };
    let (volume, info) = read_with_info(&path).unwrap();
    println!("{info}");
    assert_eq!(volume.grid.dims(), [122, 101, 112]);
    near(&volume.grid.spacing_m(), &[3e-3; 3], 1e-8);
    near(&volume.grid.direction().concat(), &[-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0], 1e-6);
    assert_eq!((info.hu.min_hu, info.hu.max_hu), (-1207, 3382));
    // The masks have the same grid and are binary.
    let mask = read(path.with_file_name("seg_femur_right.nii.gz")).unwrap();
    assert_eq!(mask.grid.dims(), volume.grid.dims());
    near(&mask.grid.origin_m(), &volume.grid.origin_m(), 1e-6);
    let bone: Vec<f64> =
        mask.hu.iter().zip(&volume.hu).filter(|(m, _)| **m == 1).map(|(_, hu)| f64::from(*hu)).collect();
    let volume_cm3 = bone.len() as f64 * 0.027;
    let mean = bone.iter().sum::<f64>() / bone.len() as f64;
    println!("right femur {volume_cm3:.1} cm3, mean {mean:.1} HU");
    // Measured with SimpleITK: 102 cm3 and a mean of 170 HU.
    assert!((volume_cm3 - 102.0).abs() < 1.0 && (mean - 170.0).abs() < 1.0);
}

#[test]
fn dicom_series_of_five_slices() {
    let Some(folder) = shared("vhf_pelvis_dicom_5slices") else { return };
    let (volume, info) = read_with_info(&folder).unwrap();
    println!("{info}");
    assert_eq!(volume.grid.dims(), [512, 512, 5]);
    near(&volume.grid.spacing_m(), &[1e-3; 3], 1e-12);
    assert_eq!(volume.grid.direction(), WORLD);
    near(&[volume.grid.origin_m()[2]], &[0.999], 1e-12);
    // Largest stored value over the five files is 2499, smallest 0 (read from the bytes), intercept −1024.
    assert_eq!((info.hu.min_hu, info.hu.max_hu), (-1024, 1475));
    // Any single file selects the series.
    assert_eq!(read(folder.join("vhf.1002.dcm")).unwrap(), volume);
}

#[test]
fn dicom_series_without_its_third_slice() {
    let Some(folder) = shared("vhf_pelvis_dicom_5slices") else { return };
    let copy = tempfile::tempdir().unwrap();
    for number in [1000, 1001, 1003, 1004] {
        let name = format!("vhf.{number}.dcm");
        std::fs::copy(folder.join(&name), copy.path().join(&name)).unwrap();
    }
    let error = read(copy.path()).unwrap_err();
    println!("{error}");
    assert!(matches!(error, VolumeError::MissingSlices { .. }));
    // The same slice twice, under another name, counts once.
    std::fs::copy(folder.join("vhf.1001.dcm"), copy.path().join("copy.dcm")).unwrap();
    let error = read(copy.path()).unwrap_err();
    println!("{error}");
    assert!(matches!(error, VolumeError::MissingSlices { .. }));
    // Another patient's slice in the folder: two series to choose from.
    if let Some(other) = shared("conformance/dicom_pydicom/CT_small.dcm") {
        std::fs::copy(other, copy.path().join("other.dcm")).unwrap();
        let error = read(copy.path()).unwrap_err();
        println!("{error}");
        assert!(matches!(error, VolumeError::SeveralSeries { .. }));
    }
}

#[test]
fn dicom_encodings() {
    let Some(folder) = shared("conformance/dicom_pydicom") else { return };
    let (small, info) = read_with_info(folder.join("CT_small.dcm")).unwrap();
    println!("{info}");
    assert_eq!(small.grid.dims(), [128, 128, 1]);
    near(&small.grid.spacing_m(), &[0.661468e-3, 0.661468e-3, 5e-3], 1e-12);
    // pydicom: pixel_array[0, 0] = 175, [64, 64] = 1108, intercept −1024.
    assert_eq!(small.at([0, 0, 0]), Some(175 - 1024));
    // The MR slice in three encodings: pydicom gives the same pixels for all.
    let folder_copy = |name: &str| {
        let copy = tempfile::tempdir().unwrap();
        std::fs::copy(folder.join(name), copy.path().join(name)).unwrap();
        copy
    };
    let explicit = read(folder_copy("MR_small.dcm").path()).unwrap();
    assert_eq!(explicit.grid.dims(), [64, 64, 1]);
    for name in ["MR_small_bigendian.dcm", "MR_small_implicit.dcm"] {
        assert_eq!(read(folder_copy(name).path()).unwrap().hu, explicit.hu, "{name}");
    }
    for name in ["MR_small_jpeg_ls_lossless.dcm", "MR_small_jp2klossless.dcm"] {
        assert_eq!(read(folder_copy(name).path()).unwrap().hu, explicit.hu, "{name}");
    }
    let truncated = read(folder.join("MR_truncated.dcm")).unwrap_err();
    println!("{truncated}");
    assert!(matches!(truncated, VolumeError::Truncated { .. }));
    assert!(matches!(read(folder.join("ExplVR_LitEndNoMeta.dcm")), Err(VolumeError::NotAVolume { .. })));
}
