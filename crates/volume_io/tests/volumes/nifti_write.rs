//! Tests written NIfTI files. Other readers of them: `tests/processes/plans.rs` (nibabel).
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use volume_io::{VolumeError, read, write_nifti};
use voxel_grid::{Volume, VoxelGrid};

/// Axes rotated by 30 degrees about z, with i and j exchanged: left-handed, as for some scanners.
fn tilted(dims: [usize; 3]) -> Volume {
    let (sin, cos) = (0.5, 0.75_f64.sqrt());
    let axes = [[-sin, cos, 0.0], [cos, sin, 0.0], [0.0, 0.0, 1.0]];
    let grid = VoxelGrid::new(dims, [0.7e-3, 0.8e-3, 1.25e-3], [-0.1234, 0.2345, 1.5], axes).unwrap();
    Volume { grid, hu: (0..grid.voxel_count()).map(|n| (n * 37 % 65_536) as u16 as i16).collect() }
}

/// nifti1.h holds positions in single precision: 24 bits, 6e-8 of the largest number, which is 1500 mm here.
const WITHIN_M: f64 = 1.5 * 1.2e-7;

#[test]
fn a_volume_reads_as_it_was_written_packed_or_not() {
    let folder = tempfile::tempdir().unwrap();
    let volume = tilted([5, 7, 3]);
    for name in ["a.nii", "a.nii.gz"] {
        let path = folder.path().join(name);
        write_nifti(&path, &volume).unwrap();
        let again = read(&path).unwrap();
        assert_eq!((again.grid.dims(), &again.hu), (volume.grid.dims(), &volume.hu));
        for corner in [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 6.0, 0.0], [4.0, 6.0, 2.0]] {
            let (there, here) = (again.grid.world_m(corner), volume.grid.world_m(corner));
            let apart = (0..3).map(|axis| (there[axis] - here[axis]).abs()).fold(0.0, f64::max);
            assert!(apart < WITHIN_M, "{name}: {there:?} {here:?}");
        }
        assert!(write_nifti(&path, &volume).is_err(), "what is there stays");
    }
    let [plain, packed] = ["a.nii", "a.nii.gz"].map(|name| std::fs::read(folder.path().join(name)).unwrap());
    assert_eq!((plain.len(), &packed[..2]), (352 + 2 * 105, &[0x1f, 0x8b][..]));
}

/// An axis is counted with 16 bits.
#[test]
fn an_axis_of_more_voxels_than_nifti_1_counts_is_refused_and_nothing_is_left() {
    let path = tempfile::tempdir().unwrap().path().join("a.nii");
    let error = write_nifti(&path, &tilted([40_000, 2, 2])).unwrap_err();
    assert!(matches!(error, VolumeError::Unsupported { .. }), "{error}");
    assert!(error.to_string().contains("at most 32767 voxels") && !path.exists(), "{error}");
}
