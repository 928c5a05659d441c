//! Headers as other programs write them, which ITK reads.

// Helpers of tests may fail a test.
#![allow(clippy::unwrap_used, clippy::panic)]

use crate::common::nifti_bytes::NiftiBytes;
use crate::common::{gzip, store};
use volume_io::{ReadOptions, SliceHandling, VolumeError, read, read_as, read_with_info};
use voxel_grid::Volume;

/// The volume of a file, and the notes on it.
fn taken(name: &str, bytes: &[u8]) -> (Volume, String) {
    let (_folder, path) = store(name, bytes);
    let (volume, info) = read_with_info(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
    (volume, info.notes.join("; "))
}

/// Regression: Latin-1 in a comment, another case and a repeated field made files unreadable.
#[test]
fn text_headers_of_other_programs_are_read() {
    let nrrd = |before: &[u8], endian: &str, after: &[u8]| {
        let fields = format!(
            "type: short\ndimension: 3\nsizes: 2 3 4\nspace: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n\
             space origin: (1,2,3)\nencoding: raw\nendian: {endian}\n"
        );
        taken("v.nrrd", &[b"NRRD0005\n", before, fields.as_bytes(), after, b"\n", &[7; 48]].concat())
    };
    let usual = nrrd(b"", "little", b"");
    let without_sizes =
        "NRRD0004\ntype: short\ndimension: 3\nsizes: 2 3 4\nencoding: raw\nendian: little\n\n";
    let (volume, notes) = taken("v.nrrd", &[without_sizes.as_bytes(), &[7; 48]].concat());
    assert_eq!((volume.grid.spacing_m(), volume.hu.len()), ([1e-3; 3], 24));
    assert!(notes.contains("no `spacings` given; assuming voxels of 1 mm"), "{notes}");
    assert_eq!(nrrd(b"# Sch\xe4del\n", "Little", b"Patient:=M\xfcller\n"), usual);
    assert_eq!(nrrd(b"", "LITTLE", b"type: short\n"), usual);
    let mha = |more: &[u8]| {
        let fields = b"ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nTransformMatrix = 1 0 0 0 1 0 0 0 1\n\
                       Offset = 1 2 3\n";
        let end = b"ElementType = MET_SHORT\nElementDataFile = LOCAL\n";
        taken("v.mha", &[fields, more, end, &[7; 48]].concat())
    };
    let usual = mha(b"ElementSpacing = 1 1 1\n");
    assert_eq!(mha(b"ElementSpacing = 1 1 1\nComment = Sch\xe4del\nOffset = 1 2 3\n"), usual);
    let (volume, notes) = mha(b"");
    assert_eq!(volume, usual.0);
    assert!(notes.contains("no ElementSpacing given; assuming voxels of 1 mm"), "{notes}");
}

/// Regression: fields that say nothing were contradictions.
#[test]
fn nifti_fields_of_zero_have_their_usual_value() {
    let affine = [[0.0, -2.0, 0.0, 5.0], [3.0, 0.0, 0.0, 6.0], [0.0, 0.0, 4.0, 7.0]];
    let nifti = |change: fn(&mut NiftiBytes)| {
        let mut file = NiftiBytes::new([2, 3, 4], affine, &[7; 24]);
        for (at, size) in [(80, 3.0_f32), (84, 2.0), (88, 4.0)] {
            file.put(at, &size.to_le_bytes());
        }
        // A qform of the same axes: a quarter turn about z.
        file.put(252, &1_i16.to_le_bytes());
        for (at, value) in [(264, std::f32::consts::FRAC_1_SQRT_2), (268, 5.0), (272, 6.0), (276, 7.0)] {
            file.put(at, &value.to_le_bytes());
        }
        change(&mut file);
        taken("v.nii", &file.0)
    };
    let (usual, notes) = nifti(|_| ());
    assert_eq!(notes, "");
    for (said, change) in [
        ("bitpix is 0; assuming 16", (|file| file.put(72, &[0; 2])) as fn(&mut NiftiBytes)),
        ("vox_offset is 0; assuming 352", |file| file.put(108, &[0; 4])),
        ("the sform is all zeros; using the qform", |file| file.put(280, &[0; 48])),
    ] {
        let (volume, notes) = nifti(change);
        assert_eq!(volume.hu, usual.hu);
        assert!(notes.contains(said), "{notes}");
        let apart = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-9);
        for voxel in [[0.0; 3], [1.0, 2.0, 3.0]] {
            assert!(apart(volume.grid.world_m(voxel), usual.grid.world_m(voxel)), "{said}");
        }
    }
}

/// Regression: the message on a sheared NIfTI offered `--rectify`, which had no effect.
#[test]
fn a_nifti_stack_of_a_tilted_gantry_is_rectified_on_request() {
    // Slices of 1 mm, each shifted by 0.5 mm along -y (RAS); the value is 10 HU per mm along z and 3 along y.
    let affine = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, -0.5, 6.0], [0.0, 0.0, 1.0, 7.0]];
    let voxels: Vec<i16> = (0..4 * 9 * 7)
        .map(|n: i16| {
            let [j, k] = [n / 4 % 9, n / 36];
            20 * k + 6 * j - 3 * k
        })
        .collect();
    let (_folder, path) = store("v.nii", &NiftiBytes::new([4, 9, 7], affine, &voxels).0);
    assert!(matches!(read(&path), Err(VolumeError::Sheared { .. })));
    let options = ReadOptions { slices: SliceHandling::Rectify, ..ReadOptions::default() };
    let (volume, info) = read_as(&path, &options).unwrap();
    let notes = info.notes.join("; ");
    assert!(notes.contains("tilted by 26.57 degrees") && !notes.contains("no effect"), "{notes}");
    assert_eq!(volume.grid.dims(), [4, 12, 7]);
    let mut inside = 0;
    for (n, hu) in volume.hu.iter().enumerate().filter(|(_, hu)| **hu != -1000) {
        let place_m = volume.grid.world_m([n % 4, n / 4 % 12, n / 48].map(|i| i as f64));
        let expected = 6.0 * (-place_m[1] * 1e3 - 6.0) + 20.0 * (place_m[2] * 1e3 - 7.0);
        assert!((f64::from(*hu) - expected).abs() < 1.0, "{place_m:?}: {hu}, expected {expected}");
        inside += 1;
    }
    assert!(inside > 4 * 8 * 7, "{inside}");
}

/// Regression: bytes behind a gzip stream made the file unreadable.
#[test]
fn bytes_behind_a_gzip_stream_are_ignored_with_a_note() {
    let file = NiftiBytes::new(
        [2, 3, 4],
        [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        &[7; 24],
    )
    .0;
    let packed = gzip(&file);
    let usual = taken("v.nii.gz", &packed);
    assert_eq!(taken("v.nii.gz", &[&packed, [0; 512].as_slice()].concat()), usual, "padding");
    let (volume, notes) = taken("v.nii.gz", &[&packed, b"trailing".as_slice()].concat());
    assert_eq!(volume, usual.0);
    assert!(
        notes.contains("bytes after the gzip data are ignored") && usual.1.is_empty(),
        "{notes}; {}",
        usual.1
    );
}
