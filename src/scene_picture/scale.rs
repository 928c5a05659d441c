//! Lengths of a picture that follow from its volume, so that a specimen of 3 mm and a pelvis are both shown
//! whole and sampled at their own resolution.

use voxel_grid::VoxelGrid;

/// Maximum distance between samples of Hounsfield units, mm.
const STEP_MM: f64 = 0.25;
/// Margin around the path, and minimum half width of a slice, in a volume of more than twice this size, mm.
const MARGIN_MM: f64 = 14.0;
const LEAST_HALF_MM: f64 = 25.0;
/// Parts of the path within this distance of a plane are drawn solid, mm, and as a share of the plane's half
/// width.
const NEAR_MM: f64 = 1.5;
const NEAR_SHARE: f64 = 0.06;

/// Lengths that follow from a volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    /// Distance between samples of Hounsfield units: half a voxel, at most a quarter of a millimetre, mm.
    pub step_mm: f64,
    /// Margin around the path in a slice, mm.
    pub margin_mm: f64,
    /// Minimum half width of a slice, mm.
    pub least_half_mm: f64,
}

impl Scale {
    /// Derives the lengths from a volume's grid.
    pub fn of(grid: &VoxelGrid) -> Scale {
        let spacing_mm = grid.spacing_m().map(|spacing_m| 1e3 * spacing_m);
        let sides_mm = [0, 1, 2].map(|axis| spacing_mm[axis] * grid.dims()[axis] as f64);
        let half_mm = 0.5 * sides_mm.iter().copied().fold(0.0, f64::max);
        let voxel_mm = spacing_mm.iter().copied().fold(f64::INFINITY, f64::min);
        Scale {
            step_mm: (0.5 * voxel_mm).min(STEP_MM),
            margin_mm: (0.5 * half_mm).min(MARGIN_MM),
            least_half_mm: (1.1 * half_mm).min(LEAST_HALF_MM),
        }
    }

    /// Returns the number of decimals, in mm, that a sample's place has.
    pub fn decimals(&self) -> usize {
        (-self.step_mm.log10()).ceil().clamp(1.0, 4.0) as usize
    }

    /// Returns the distance from a plane of this half width within which the path is drawn solid, mm.
    pub fn near_mm(half_mm: f64) -> f64 {
        (NEAR_SHARE * half_mm).min(NEAR_MM)
    }

    /// Returns the longest round length (1, 2 or 5 times a power of ten) of at most a fifth of a plane's
    /// width, mm.
    pub fn bar_mm(half_mm: f64) -> f64 {
        let most_mm = 0.4 * half_mm;
        let power = 10f64.powf(most_mm.log10().floor());
        let fits = |digit: &f64| digit * power <= most_mm * (1.0 + 1e-9);
        [5.0, 2.0].into_iter().find(fits).unwrap_or(1.0) * power
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(count: usize, spacing_m: f64) -> Scale {
        Scale::of(&VoxelGrid::axis_aligned([count; 3], [spacing_m; 3], [0.0; 3]).unwrap())
    }

    /// Regression: a specimen of 3.9 mm, scanned at 19 µm, was sampled every 13 voxels, in slices of 50 mm.
    #[test]
    fn a_specimen_is_sampled_at_its_own_resolution_and_fills_its_slices() {
        let (specimen, femur, pelvis) = (cube(205, 19e-6), cube(220, 0.5e-3), cube(370, 1e-3));
        assert!((specimen.step_mm - 0.0095).abs() < 1e-12, "{specimen:?}");
        assert!(specimen.least_half_mm < 2.2 && specimen.margin_mm < 1.0, "{specimen:?}");
        assert_eq!([specimen, femur, pelvis].map(|scale| scale.decimals()), [3, 1, 1]);
        assert_eq!(femur, Scale { step_mm: 0.25, margin_mm: 14.0, least_half_mm: 25.0 });
        assert_eq!(femur, pelvis);
    }

    #[test]
    fn a_scale_bar_is_round_and_takes_a_tenth_to_a_fifth_of_the_width() {
        for (half_mm, bar_mm) in [(2.1, 0.5), (25.0, 10.0), (50.0, 20.0), (70.0, 20.0), (150.0, 50.0)] {
            assert!((Scale::bar_mm(half_mm) / bar_mm - 1.0).abs() < 1e-9, "{half_mm}");
        }
    }
}
