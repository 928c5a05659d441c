//! Resamples to smaller (or larger) cubic voxels.

use crate::error::VolumeError;
use voxel_grid::{MAX_VOXELS, Volume, VoxelGrid};

/// Resamples to cubic voxels of `spacing_m` by trilinear interpolation between voxel centres. Keeps axes and
/// outer extent; values at the rim are those of the outermost centres. Resample a binary mask after
/// [`mask_to_hu`](crate::mask_to_hu).
///
/// # Errors
/// [`VolumeError::Argument`] if the spacing is not a positive length, or the result would have more than
/// [`MAX_VOXELS`].
pub fn resample(volume: &Volume, spacing_m: f64) -> Result<Volume, VolumeError> {
    let (old_dims, old_m) = (volume.grid.dims(), volume.grid.spacing_m());
    let refuse = |given: String, expected: &str| VolumeError::argument("spacing_m", given, expected);
    if !(spacing_m.is_finite() && spacing_m > 0.0) {
        return Err(refuse(spacing_m.to_string(), "a finite length above 0"));
    }
    let extent = |axis: usize| old_dims[axis] as f64 * old_m[axis];
    let counts = [0, 1, 2].map(|axis| libm::floor(extent(axis) / spacing_m + 0.5).max(1.0));
    if counts.iter().product::<f64>() > MAX_VOXELS as f64 {
        let given = format!(
            "{spacing_m} m, which gives {:.0} x {:.0} x {:.0} voxels",
            counts[0], counts[1], counts[2]
        );
        return Err(refuse(given, "at most 2^29 voxels: a larger spacing"));
    }
    let dims = counts.map(|count| count as usize);
    // The outer faces of the first voxels coincide.
    let first = [0, 1, 2].map(|axis| 0.5 * (spacing_m / old_m[axis] - 1.0));
    let axes =
        [0, 1, 2].map(|axis| samples(dims[axis], old_dims[axis], first[axis], spacing_m / old_m[axis]));
    let grid = VoxelGrid::new(dims, [spacing_m; 3], volume.grid.world_m(first), volume.grid.axes());
    let grid =
        grid.map_err(|cause| refuse(format!("{spacing_m} m, which gives {cause}"), "another spacing"))?;
    let mut hu = Vec::with_capacity(dims.iter().product());
    for k in &axes[2] {
        for j in &axes[1] {
            for i in &axes[0] {
                hu.push(interpolate(volume, i, j, k));
            }
        }
    }
    Ok(Volume { grid, hu })
}

/// Two neighbours along an axis and the weight of the second.
struct Sample {
    low: usize,
    high: usize,
    weight: f64,
}

fn samples(count: usize, voxels: usize, first: f64, step: f64) -> Vec<Sample> {
    let last = (voxels - 1) as f64;
    let at = |n: usize| {
        let place = (first + n as f64 * step).clamp(0.0, last);
        let low = libm::floor(place);
        Sample { low: low as usize, high: (low as usize + 1).min(voxels - 1), weight: place - low }
    };
    (0..count).map(at).collect()
}

fn interpolate(volume: &Volume, i: &Sample, j: &Sample, k: &Sample) -> i16 {
    let [nx, ny, _] = volume.grid.dims();
    let row = |j: usize, k: usize| {
        let start = nx * (j + ny * k);
        let (a, b) = (f64::from(volume.hu[start + i.low]), f64::from(volume.hu[start + i.high]));
        a + (b - a) * i.weight
    };
    let plane = |k: usize| {
        let (a, b) = (row(j.low, k), row(j.high, k));
        a + (b - a) * j.weight
    };
    let (a, b) = (plane(k.low), plane(k.high));
    libm::round(a + (b - a) * k.weight) as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    /// HU linear in world coordinates.
    fn linear(dims: [usize; 3], spacing_m: [f64; 3]) -> Volume {
        let axes = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let grid = VoxelGrid::new(dims, spacing_m, [0.01, -0.02, 0.03], axes).unwrap();
        let hu = |index| {
            let p = grid.world_m(grid.voxel(index).unwrap().map(|n| n as f64));
            (p[0] * 2e4 - p[1] * 3e4 + p[2] * 1e4) as i16
        };
        Volume { grid, hu: (0..grid.voxel_count()).map(hu).collect() }
    }

    #[test]
    fn a_linear_field_stays_the_same_field_in_the_world() {
        let coarse = linear([8, 7, 6], [3e-3, 2e-3, 4e-3]);
        let fine = resample(&coarse, 1e-3).unwrap();
        assert_eq!(fine.grid.dims(), [24, 14, 24]);
        // Inside the outermost centres; 1 HU for rounding the coarse values, 1 for the fine ones.
        for (i, j, k) in [(5, 4, 5), (12, 7, 11), (20, 11, 20)] {
            let p = fine.grid.world_m([i as f64, j as f64, k as f64]);
            let exact = p[0] * 2e4 - p[1] * 3e4 + p[2] * 1e4;
            let given = f64::from(fine.at([i, j, k]).unwrap());
            assert!((given - exact).abs() <= 2.0, "{given} against {exact}");
        }
    }

    #[test]
    fn the_same_spacing_changes_nothing_and_a_bad_one_is_refused() {
        let volume = linear([5, 4, 3], [2e-3; 3]);
        assert_eq!(resample(&volume, 2e-3).unwrap(), volume);
        for spacing_m in [0.0, -1.0, f64::NAN, 1e-9] {
            assert!(resample(&volume, spacing_m).is_err());
        }
    }
}
