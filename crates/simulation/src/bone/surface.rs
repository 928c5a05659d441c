//! The bone surface smoothed over a few voxels: its normal and its distance from a point.
//!
//! The sampled field is the exact convolution of the (fractional) occupancy with a tent along each axis. Its
//! gradient is the tent-weighted sum of the exposed voxel faces. It is exact for axis-aligned walls. For
//! slanted walls it is unbiased, because the faces of a staircase add up to the area of the plane that it
//! approximates.

use core::ops::Range;

use nalgebra::Vector3;

use super::grid::floor_to_i64;
use super::occupancy::{WINDOW_VOXELS, WindowPlace};
use super::remembered::RememberedCells;
use super::spline::SPLINE_VOXELS;
use super::voxels::Voxels;

/// Maximum tent half width in voxels; smaller for spheres of only a few voxels, so that the two walls of a
/// corner stay separate. With 3 the normal on a slanted wall is within 2 degrees (slope 0.3 and more), with 2
/// within 9; measured in `tests/physics/bone_query.rs`.
const TENT_MAX_VOXELS: f64 = 3.0;
/// Minimum tent half width in voxels.
const TENT_MIN_VOXELS: f64 = 1.0;
/// Maximum voxels under a tent along an axis: 2 * TENT_MAX_VOXELS + 1 for the partial ends, rounded up to a
/// byte.
const TENT_VOXELS: usize = 8;

const _: () = assert!(2.0 * TENT_MAX_VOXELS + 1.0 <= TENT_VOXELS as f64, "the widest tent fits");
const _: () = assert!(TENT_MIN_VOXELS < TENT_MAX_VOXELS && TENT_VOXELS as i64 <= WINDOW_VOXELS);
const _: () =
    assert!(SPLINE_VOXELS as f64 == 2.0 * TENT_MAX_VOXELS + 1.0, "the polynomial is that of the widest tent");

/// The smoothed field at a point, in the grid's metric frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfaceSample {
    /// Negative gradient of the smoothed occupancy, 1/m, which points out of the bone.
    pub outward_per_m: Vector3<f64>,
    /// Smoothed occupancy; 0.5 on a flat surface.
    pub level: f64,
}

/// Tent sizes for a sphere.
#[derive(Debug, Clone, Copy)]
pub(super) struct TentSizes {
    /// Voxels per metre along each axis.
    per_spacing: [f64; 3],
    /// Half width along each axis in voxels, and its inverse.
    half_width: [f64; 3],
    per_half_width: [f64; 3],
}

/// The tent along one axis at the faces of the voxels `start..start + count`. The weight of a run of voxels
/// is the difference between its two ends.
struct AxisTent {
    start: i64,
    count: usize,
    /// Integral of the tent up to each face: 0 at the first, 1 at the last.
    integral: [f64; TENT_VOXELS + 1],
    /// The tent at each face: 0 at the first and the last.
    tent: [f64; TENT_VOXELS + 1],
}

impl AxisTent {
    /// Creates a tent; `position` and `half_width` are in voxels, `inverse` is that of the half width.
    fn new(position: f64, half_width: f64, inverse: f64) -> Self {
        let start = floor_to_i64(position - half_width + 0.5);
        let count = ((floor_to_i64(position + half_width + 0.5) - start + 1) as usize).min(TENT_VOXELS);
        let mut axis = Self { start, count, integral: [0.0; TENT_VOXELS + 1], tent: [0.0; TENT_VOXELS + 1] };
        let first = start as f64 - 0.5 - position;
        for face in 1..=TENT_VOXELS {
            let t = first + face as f64;
            let height = (1.0 - t.abs() * inverse).max(0.0);
            let tail = 0.5 * height * height;
            axis.integral[face] = if t < 0.0 { tail } else { 1.0 - tail };
            axis.tent[face] = height * inverse;
        }
        axis
    }

    /// Returns the integral of the tent over one voxel, and the tent's rise over it.
    #[inline]
    fn voxel(&self, voxel: usize) -> (f64, f64) {
        (self.integral[voxel + 1] - self.integral[voxel], self.tent[voxel + 1] - self.tent[voxel])
    }
}

impl Voxels {
    /// Returns the tent for spheres of radius `radius_m`.
    #[inline]
    pub(super) fn tent_sizes(&self, radius_m: f64) -> TentSizes {
        let per_spacing = self.geometry().spacing_m.map(|spacing| 1.0 / spacing);
        let half_width =
            per_spacing.map(|inverse| (0.8 * radius_m * inverse).clamp(TENT_MIN_VOXELS, TENT_MAX_VOXELS));
        TentSizes { per_spacing, half_width, per_half_width: half_width.map(|half| 1.0 / half) }
    }

    /// Samples the smoothed surface at a point in the grid's metric frame. The point's cell is looked up in
    /// `remembered`, or computed and stored there.
    #[inline(always)]
    pub(super) fn sample_surface(
        &self,
        point: &Vector3<f64>,
        tent: &TentSizes,
        remembered: Option<&mut RememberedCells>,
    ) -> SurfaceSample {
        let position = [0, 1, 2].map(|axis| point[axis] * tent.per_spacing[axis]);
        let mut sample = if tent.half_width == [TENT_MAX_VOXELS; 3] {
            let start = position.map(|position| floor_to_i64(position - TENT_MAX_VOXELS + 0.5));
            let behind = [0, 1, 2].map(|axis| start[axis] as f64 + TENT_MAX_VOXELS + 0.5 - position[axis]);
            match remembered {
                Some(remembered) => remembered.cell(self, start).sample(behind),
                None => self.spline_cell(start).sample(behind),
            }
        } else {
            self.sample_tents(position, tent)
        };
        for axis in 0..3 {
            sample.outward_per_m[axis] *= tent.per_spacing[axis];
        }
        sample
    }

    /// Returns the smoothed occupancy and its slopes in 1/voxel, for tents of any width.
    pub(super) fn sample_tents(&self, position: [f64; 3], tent: &TentSizes) -> SurfaceSample {
        let [x, y, z] = [0, 1, 2]
            .map(|axis| AxisTent::new(position[axis], tent.half_width[axis], tent.per_half_width[axis]));
        let place = self.occupancy().window_place(x.start);
        let (rows_y, rows_z) = (self.rows_inside(&y, 1), self.rows_inside(&z, 2));
        let (mut level, mut outward) = (0.0, Vector3::zeros());
        for row_z in rows_z {
            let k = (z.start + row_z as i64) as usize;
            let (mut value, mut rise_x, mut rise_y) = (0.0, 0.0, 0.0);
            for row_y in rows_y.clone() {
                let (row_value, row_rise) = self.row_sums(&x, place, (y.start + row_y as i64) as usize, k);
                let (weight, weight_rise) = y.voxel(row_y);
                value += row_value * weight;
                rise_x += row_rise * weight;
                rise_y += row_value * weight_rise;
            }
            let (weight, weight_rise) = z.voxel(row_z);
            level += value * weight;
            outward += Vector3::new(rise_x * weight, rise_y * weight, value * weight_rise);
        }
        SurfaceSample { outward_per_m: outward, level }
    }

    /// Returns the voxels of a tent that lie in the grid.
    fn rows_inside(&self, tent: &AxisTent, axis: usize) -> Range<usize> {
        let first = (-tent.start).clamp(0, tent.count as i64) as usize;
        let end =
            (self.geometry().dims[axis] as i64 - tent.start).clamp(first as i64, tent.count as i64) as usize;
        first..end
    }

    /// Returns the sums of the x weights and of their rises over the bone of one row.
    #[inline]
    fn row_sums(&self, x: &AxisTent, place: WindowPlace, j: usize, k: usize) -> (f64, f64) {
        const FULL: u64 = (1 << TENT_VOXELS) - 1;
        let solid = self.occupancy().window(place, j, k) & FULL;
        if solid == 0 {
            return (0.0, 0.0);
        }
        let (mut value, mut rise) = (0.0, 0.0);
        let mut bits = solid;
        while bits != 0 {
            let from = bits.trailing_zeros() as usize;
            let to = from + (bits >> from).trailing_ones() as usize;
            bits &= FULL << to;
            value += x.integral[to] - x.integral[from];
            rise += x.tent[to] - x.tent[from];
        }
        let mut partial = solid & u64::from(self.pool().partial_window(x.start, j, k));
        while partial != 0 {
            let voxel = partial.trailing_zeros() as usize;
            partial &= partial - 1;
            let spent = self.pool().spent((x.start + voxel as i64) as usize, j, k);
            let (weight, weight_rise) = x.voxel(voxel);
            value -= weight * spent;
            rise -= weight_rise * spent;
        }
        (value, rise)
    }
}
