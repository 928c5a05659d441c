//! The detector's plane in an intermediate image: where the volume extends behind the detector, a ray's
//! samples end at its plane.
//!
//! As in [`joseph`](crate::joseph), a slice counts if the ray meets it at or before the detector. That is a
//! half-plane of the image for each slice: for samples (i, j) of the image, the inverse of the ray's
//! parameter at the detector is linear in i and j.

use super::plan::ImagePlan;
use crate::ray::RayFan;

/// Inverse of the parameter at which the ray of sample (i, j) meets the detector, `constant + i per_column +
/// j per_row`; the parameter is 0 at the source and 1 in the image's plane.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DetectorClip {
    constant: f64,
    per_column: f64,
    per_row: f64,
}

impl DetectorClip {
    /// Computes the coefficients for the samples of an image.
    pub fn new(fan: &RayFan, plan: &ImagePlan) -> Self {
        let normal = fan.detector_normal();
        let [k, u, v] = [plan.axes.slow, plan.axes.u, plan.axes.v];
        // A sample's ray is `far` along k, and (first + sample) / oversampling - source along u and v.
        let along = |axis: usize, m: usize| plan.first[m] as f64 / plan.oversampling - plan.source[axis];
        Self {
            constant: normal[k] * plan.far + normal[u] * along(u, 0) + normal[v] * along(v, 1),
            per_column: normal[u] / plan.oversampling,
            per_row: normal[v] / plan.oversampling,
        }
    }

    /// True if the plane can cut some of the rays of these columns and rows (half-open) before the slice with
    /// this inverse ratio of depths.
    #[inline(always)]
    pub fn cuts(&self, inverse_ratio: f64, columns: (usize, usize), rows: (usize, usize)) -> bool {
        let most = |each: f64, (first, end): (usize, usize)| (each * first as f64).max(each * end as f64);
        // Rounding must not hide a cut that [`Self::columns`] finds.
        let least_ratio = inverse_ratio * (1.0 - 1e-9);
        self.constant + most(self.per_column, columns) + most(self.per_row, rows) >= least_ratio
    }

    /// The columns out of `within` of an image row whose rays meet the slice before the detector, half-open.
    #[inline(always)]
    pub fn columns(&self, inverse_ratio: f64, row: usize, within: (usize, usize)) -> (usize, usize) {
        let left = inverse_ratio - self.constant - row as f64 * self.per_row;
        let end = left / self.per_column;
        let clamp = |column: f64| column.max(within.0 as f64).min(within.1 as f64) as usize;
        if self.per_column > 0.0 {
            (within.0, clamp(libm::floor(end) + 1.0))
        } else if self.per_column < 0.0 {
            (clamp(libm::ceil(end)), within.1)
        } else if left >= 0.0 {
            within
        } else {
            (within.0, within.0)
        }
    }
}
