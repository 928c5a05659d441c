//! Siddon's exact line integral through voxels of constant attenuation: the reference projector.
//!
//! R. L. Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Med.
//! Phys. 12 (1985) 252. Each crossing is computed from its plane's index, not accumulated, so errors do not
//! grow along the ray.

use crate::grid::Grid;
use crate::ray::IndexRay;
use crate::removal::AttenuationField;

/// Line integral of attenuation over the parameter interval `range` of the ray (0 source, 1 pixel),
/// dimensionless. Voxel i fills the interval [i - 1/2, i + 1/2] of its axis.
pub fn line_integral(field: &AttenuationField<'_>, ray: &IndexRay, range: (f64, f64)) -> f64 {
    let mut sum = 0.0;
    walk(field.view.grid(), ray, range, |linear, from, to| sum += field.mu_per_m(linear) * (to - from));
    sum * ray.length_m
}

/// Calls `visit(linear, from, to)` for each voxel on the part `range` of the ray, from the source on: its
/// linear index, and the parameters at which the ray enters and leaves it.
#[inline]
pub(crate) fn walk(grid: &Grid, ray: &IndexRay, range: (f64, f64), mut visit: impl FnMut(usize, f64, f64)) {
    let dims = grid.dims();
    let Some((enter, leave)) = clip_to_volume(ray, dims, range) else { return };
    let mut walk = Walk::new(ray, dims, enter);
    let mut here = enter;
    // Each pass crosses one plane; there are at most nx + ny + nz + 3 of them.
    for _ in 0..dims[0] + dims[1] + dims[2] + 3 {
        let axis = walk.nearest_axis();
        let next = walk.crossing[axis].min(leave);
        if next > here {
            if let Some(linear) = grid.linear_of(walk.voxel()) {
                visit(linear, here, next);
            }
            here = next;
        }
        if walk.crossing[axis] >= leave {
            break;
        }
        walk.cross(axis);
    }
}

/// The part of `range` inside the volume's outer faces.
pub(crate) fn clip_to_volume(ray: &IndexRay, dims: [usize; 3], range: (f64, f64)) -> Option<(f64, f64)> {
    let (mut enter, mut leave) = range;
    for (axis, size) in dims.into_iter().enumerate() {
        let (o, d) = (ray.origin[axis], ray.direction[axis]);
        let (low, high) = (-0.5 - o, size as f64 - 0.5 - o);
        if d == 0.0 {
            if low > 0.0 || high <= 0.0 {
                return None;
            }
            continue;
        }
        let (a, b) = (low / d, high / d);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    (enter < leave).then_some((enter, leave))
}

/// The cell that contains the ray, and the ray's next plane crossing per axis.
struct Walk {
    cell: [i64; 3],
    step: [i64; 3],
    crossing: [f64; 3],
    origin: [f64; 3],
    direction: [f64; 3],
}

impl Walk {
    fn new(ray: &IndexRay, dims: [usize; 3], enter: f64) -> Self {
        let mut walk = Self {
            cell: [0; 3],
            step: [0; 3],
            crossing: [f64::INFINITY; 3],
            origin: ray.origin,
            direction: ray.direction,
        };
        for (axis, size) in dims.into_iter().enumerate() {
            let d = ray.direction[axis];
            let last = size as i64 - 1;
            let position = libm::floor(ray.origin[axis] + enter * d + 0.5);
            walk.cell[axis] = (position as i64).clamp(0, last);
            walk.step[axis] = if d > 0.0 { 1 } else { -1 };
            walk.update(axis);
        }
        walk
    }

    /// Parameter at which the ray leaves the current cell along `axis`.
    fn update(&mut self, axis: usize) {
        let d = self.direction[axis];
        if d != 0.0 {
            let plane = self.cell[axis] as f64 + 0.5 * self.step[axis] as f64;
            self.crossing[axis] = (plane - self.origin[axis]) / d;
        }
    }

    fn cross(&mut self, axis: usize) {
        self.cell[axis] += self.step[axis];
        self.update(axis);
    }

    fn nearest_axis(&self) -> usize {
        let [x, y, z] = self.crossing;
        if x <= y && x <= z {
            0
        } else if y <= z {
            1
        } else {
            2
        }
    }

    /// The current cell; a negative coordinate becomes an index outside any volume.
    fn voxel(&self) -> [usize; 3] {
        self.cell.map(|c| usize::try_from(c).unwrap_or(usize::MAX))
    }
}
