//! Anatomy in a short interval of a ray. Same bits as
//! [`joseph::interval_integral`](crate::joseph::interval_integral), but without its divisions: the interval
//! spans only a few planes, so checking both ends is enough to know that all of it is inside the volume.

use crate::joseph;
use crate::ray::IndexRay;
use crate::removal::{AttenuationField, BLOCK_SHIFT, is_drilled, is_occupied};

const ONE: f64 = 4_294_967_296.0;
const FRACTION: f64 = 1.0 / ONE;
/// Positions beyond this many voxels go to the general routine.
const FAR: f64 = 1e6;

/// Line integral of attenuation between two parameters of the ray, 0 <= a <= b <= 1.
pub(crate) fn displaced_integral(field: &AttenuationField<'_>, ray: &IndexRay, range: (f64, f64)) -> f64 {
    match Interval::new(field, ray, range) {
        Some(interval) => interval.integral(field),
        None => joseph::interval_integral(field, ray, range),
    }
}

/// Planes `first..=last` of the dominant axis k whose samples all have four neighbours in the volume.
struct Interval {
    low: f64,
    high: f64,
    first: i64,
    last: i64,
    position: [i64; 2],
    step: [i64; 2],
    /// Distance in memory along u, v and k, of voxels and of blocks.
    stride: [usize; 3],
    block_stride: [usize; 3],
    metres_per_plane: f64,
}

impl Interval {
    /// `None` if a neighbour could be missing.
    #[inline]
    fn new(field: &AttenuationField<'_>, ray: &IndexRay, range: (f64, f64)) -> Option<Self> {
        let d = ray.direction.map(f64::abs);
        let (k, axes) = if d[0] >= d[1] && d[0] >= d[2] {
            (0, [1, 2])
        } else if d[1] >= d[2] {
            (1, [0, 2])
        } else {
            (2, [0, 1])
        };
        let grid = field.view.grid();
        let (dims, strides, blocks) = (grid.dims(), grid.strides(), field.blocks.strides());
        let direction_k = ray.direction[k];
        let (a, b) = (ray.origin[k] + range.0 * direction_k, ray.origin[k] + range.1 * direction_k);
        let (low, high) = (a.min(b), a.max(b));
        // Negated, so that a NaN goes to the general routine.
        if !(low > 0.5 && high < dims[k] as f64 - 1.5 && high < FAR) {
            return None;
        }
        // Source and pixel must lie outside the interval's planes; otherwise some planes count only partly.
        let (from, to) = (ray.origin[k], ray.origin[k] + direction_k);
        if low - 1.0 < from.min(to) || high + 1.0 > from.max(to) {
            return None;
        }
        let (first, last) = (ceil(low - 0.5), floor(high + 0.5));
        let mut start = [0_i64; 2];
        let mut step = [0_i64; 2];
        for m in 0..2 {
            let slope = ray.direction[axes[m]] / direction_k;
            let at_zero = ray.origin[axes[m]] - ray.origin[k] * slope;
            if !(slope.abs() < FAR && at_zero.abs() < FAR) {
                return None;
            }
            (start[m], step[m]) = (fixed(at_zero), fixed(slope));
            let highest = (dims[axes[m]] as i64 - 1) * ONE as i64 - 1;
            let ends = [first, last].map(|plane| start[m] + plane * step[m]);
            if ends.iter().any(|&p| p < 0 || p > highest) {
                return None;
            }
        }
        Some(Self {
            low,
            high,
            first,
            last,
            position: [0, 1].map(|m| start[m] + first * step[m]),
            step,
            stride: [strides[axes[0]], strides[axes[1]], strides[k]],
            block_stride: [blocks[axes[0]], blocks[axes[1]], blocks[k]],
            metres_per_plane: ray.length_m / direction_k.abs(),
        })
    }

    #[inline]
    fn integral(&self, field: &AttenuationField<'_>) -> f64 {
        let [mut u, mut v] = self.position;
        let mut sum = 0.0;
        for k in self.first..=self.last {
            let overlap = self.high.min(k as f64 + 0.5) - self.low.max(k as f64 - 0.5);
            if overlap > 0.0 {
                sum += overlap * self.sample(field, [u, v, k << 32]);
            }
            u += self.step[0];
            v += self.step[1];
        }
        sum * self.metres_per_plane
    }

    /// Bilinear sample of a plane; position in voxels as 32.32 fixed point.
    #[inline]
    fn sample(&self, field: &AttenuationField<'_>, position: [i64; 3]) -> f64 {
        let voxel = position.map(|p| (p >> 32) as usize);
        let at = |stride: &[usize; 3], c: [usize; 3]| stride[0] * c[0] + stride[1] * c[1] + stride[2] * c[2];
        let block = at(&self.block_stride, voxel.map(|v| v >> BLOCK_SHIFT));
        // A block includes all four neighbours of any position inside it.
        let flags = field.blocks.flags().get(block).copied().unwrap_or(u8::MAX);
        if !is_occupied(flags) {
            return 0.0;
        }
        let corner = at(&self.stride, voxel);
        let [su, sv, _] = self.stride;
        let corners = [corner, corner + su, corner + sv, corner + su + sv];
        let hu = field.view.hu();
        let mu = if is_drilled(flags) {
            corners.map(|linear| field.mu_per_m(linear))
        } else {
            corners.map(|linear| hu.get(linear).map_or(0.0, |&h| field.table.mu_per_m(h)))
        };
        let [fu, fv] = [position[0], position[1]].map(|p| f64::from(p as u32) * FRACTION);
        let near = mu[0] + fu * (mu[1] - mu[0]);
        let far = mu[2] + fu * (mu[3] - mu[2]);
        near + fv * (far - near)
    }
}

/// Same as `libm::round(position * 2^32)`, half away from zero, for positions in range.
#[inline]
fn fixed(position: f64) -> i64 {
    let scaled = position * ONE;
    (scaled + (0.5 - 0.25 * f64::EPSILON).copysign(scaled)) as i64
}

#[inline]
fn floor(x: f64) -> i64 {
    let truncated = x as i64;
    truncated - i64::from(truncated as f64 > x)
}

#[inline]
fn ceil(x: f64) -> i64 {
    let truncated = x as i64;
    truncated + i64::from((truncated as f64) < x)
}
