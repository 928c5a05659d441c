//! Resamples to smaller (or larger) cubic voxels.

use std::path::Path;

use crate::error::VolumeError;
use crate::volume::Volume;
use voxel_grid::MAX_VOXELS;

/// Resamples to cubic voxels of `spacing_m` by trilinear interpolation between voxel centres. Keeps axes and outer extent; values at the
/// rim are those of the outermost centres. Resample a binary mask after [`mask_to_hu`](crate::mask_to_hu).
///
/// # Errors
/// [`VolumeError::Argument`] if the spacing is not a positive length, or the result would have more than [`MAX_VOXELS`].
pub fn resample(volume: &Volume, spacing_m: f64) -> Result<Volume, VolumeError> {
    volume.check(Path::new("volume to resample"))?;
    let refuse = |given: String, expected: &str| VolumeError::Argument {
        field: "spacing_m",
        given,
        expected: expected.to_owned(),
    };
    if !(spacing_m.is_finite() && spacing_m > 0.0) {
        return Err(refuse(spacing_m.to_string(), "a finite length above 0"));
    }
    let extent = |axis: usize| volume.dims[axis] as f64 * volume.spacing_m[axis];
    let counts = [0, 1, 2].map(|axis| libm::floor(extent(axis) / spacing_m + 0.5).max(1.0));
    if counts.iter().product::<f64>() > MAX_VOXELS as f64 {
        let given = format!(
            "{spacing_m} m, which makes {:.0} x {:.0} x {:.0} voxels",
            counts[0], counts[1], counts[2]
        );
        return Err(refuse(given, "at most 2^29 voxels: a larger spacing"));
    }
    let dims = counts.map(|count| count as usize);
    // The outer faces of the first voxels coincide.
    let first = [0, 1, 2].map(|axis| 0.5 * (spacing_m / volume.spacing_m[axis] - 1.0));
    let axes = [0, 1, 2]
        .map(|axis| samples(dims[axis], volume.dims[axis], first[axis], spacing_m / volume.spacing_m[axis]));
    let mut hu = Vec::with_capacity(dims.iter().product());
    for k in &axes[2] {
        for j in &axes[1] {
            for i in &axes[0] {
                hu.push(interpolate(volume, i, j, k));
            }
        }
    }
    Ok(Volume {
        dims,
        spacing_m: [spacing_m; 3],
        origin_m: volume.voxel_to_world_m(first),
        direction: volume.direction,
        hu,
    })
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
    let [nx, ny, _] = volume.dims;
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
        let direction = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let mut volume = Volume {
            dims,
            spacing_m,
            origin_m: [0.01, -0.02, 0.03],
            direction,
            hu: vec![0; dims.iter().product()],
        };
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let p = volume.voxel_to_world_m([i as f64, j as f64, k as f64]);
                    volume.hu[i + dims[0] * (j + dims[1] * k)] =
                        (p[0] * 2e4 - p[1] * 3e4 + p[2] * 1e4) as i16;
                }
            }
        }
        volume
    }

    #[test]
    fn a_linear_field_stays_the_same_field_in_the_world() {
        let coarse = linear([8, 7, 6], [3e-3, 2e-3, 4e-3]);
        let fine = resample(&coarse, 1e-3).unwrap();
        assert_eq!(fine.dims, [24, 14, 24]);
        // Inside the outermost centres; 1 HU for rounding the coarse values, 1 for the fine ones.
        for (i, j, k) in [(5, 4, 5), (12, 7, 11), (20, 11, 20)] {
            let p = fine.voxel_to_world_m([i as f64, j as f64, k as f64]);
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
