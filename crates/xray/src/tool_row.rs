//! Intersects all rays of one image row with one part of the tool. Branch-free for tubes, so that the loops
//! vectorise; same bits as [`SeenPart::cross`].

use core::ops::Range;

use pulp::Arch;

use crate::lanes::lanes;
use crate::ray::{Pixel, RayFan, WorldRay};
use crate::tool::{Crossing, End, Radii, SeenPart};
use crate::vector::{Vec3, add_scaled, dot};

/// World rays of neighbouring pixels of a row.
#[derive(Debug, Default)]
pub(crate) struct RowOfRays {
    direction_m: [Vec<f64>; 3],
    length_m: Vec<f64>,
}

impl RowOfRays {
    /// Computes the rays of `count` pixels, starting at `from`.
    pub(crate) fn aim(&mut self, arch: Arch, fan: &RayFan, from: Pixel, count: usize) {
        self.length_m.resize(count, 0.0);
        let direction_m = self.direction_m.each_mut().map(|values| {
            values.resize(count, 0.0);
            values.as_mut_slice()
        });
        let length_m = &mut self.length_m[..];
        arch.dispatch(Aim { fan, from, direction_m, length_m });
    }

    /// One of the rays.
    #[inline]
    pub(crate) fn at(&self, fan: &RayFan, i: usize) -> WorldRay {
        let direction_m = [0, 1, 2].map(|axis| self.direction_m[axis][i]);
        WorldRay { origin_m: fan.source_m(), direction_m, length_m: self.length_m[i] }
    }
}

/// Crossings of parts with rays, as concatenated lists.
#[derive(Debug, Default)]
pub(crate) struct Crossings {
    /// Parameters of the ray inside the envelope; for a miss the entry is after the exit.
    enter: Vec<f64>,
    leave: Vec<f64>,
    metal_m: Vec<f64>,
}

/// Entry and exit for a miss.
const MISS: (f64, f64) = (1.0, 0.0);

impl Crossings {
    /// Removes all crossings.
    pub(crate) fn clear(&mut self) {
        self.enter.clear();
        self.leave.clear();
        self.metal_m.clear();
    }

    /// One crossing; `None` if the ray misses.
    #[inline]
    pub(crate) fn at(&self, i: usize) -> Option<Crossing> {
        let envelope = (self.enter[i], self.leave[i]);
        (envelope.0 < envelope.1).then(|| Crossing { envelope, metal_m: self.metal_m[i] })
    }

    /// Appends the crossings of rays with a part; returns the start index.
    pub(crate) fn append(
        &mut self,
        arch: Arch,
        part: &SeenPart,
        rays: &RowOfRays,
        range: Range<usize>,
    ) -> usize {
        let start = self.enter.len();
        for list in [&mut self.enter, &mut self.leave, &mut self.metal_m] {
            list.resize(start + range.len(), 0.0);
        }
        let out = [&mut self.enter[start..], &mut self.leave[start..], &mut self.metal_m[start..]];
        let direction_m = rays.direction_m.each_ref().map(|values| &values[range.clone()]);
        let length_m = &rays.length_m[range];
        if let Some(tube) = Tube::of(part)
            && arch.dispatch(CrossTube { tube, direction_m, length_m, out })
        {
            return start;
        }
        for (i, &length_m) in length_m.iter().enumerate() {
            let crossing = part.cross(direction_m.map(|values| values[i]), length_m);
            let (enter, leave) = crossing.map_or(MISS, |c| c.envelope);
            (self.enter[start + i], self.leave[start + i]) = (enter, leave);
            self.metal_m[start + i] = crossing.map_or(0.0, |c| c.metal_m);
        }
        start
    }
}

lanes! {
    /// The rays of a piece of a row.
    Aim { fan: &'a RayFan, from: Pixel, direction_m: [&'a mut [f64]; 3], length_m: &'a mut [f64] } -> () {
        fan.world_rays_of_row(from, direction_m, length_m);
    }
}

lanes! {
    /// [`Tube::cross`].
    CrossTube {
        tube: Tube,
        direction_m: [&'a [f64]; 3],
        length_m: &'a [f64],
        out: [&'a mut [f64]; 3],
    } -> bool {
        tube.cross(direction_m, length_m, out)
    }
}

/// A solid or hollow cylinder without a notch, with precomputed constants for one source.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tube {
    axis: Vec3,
    ends: [End; 2],
    across: Vec3,
    outer_m: f64,
    inner_m: f64,
}

impl Tube {
    fn of(part: &SeenPart) -> Option<Self> {
        match *part {
            SeenPart::Axial {
                axis,
                ends,
                radii: Radii::Tube { outer_m, inner_m, notch: None },
                across,
                ..
            } => Some(Self { axis, ends, across, outer_m, inner_m }),
            _ => None,
        }
    }

    /// Same as [`SeenPart::cross`], operation by operation. False if a ray is exactly parallel to the axis or
    /// to an end: use [`SeenPart::cross`] then.
    #[inline(always)]
    fn cross(&self, direction_m: [&[f64]; 3], length_m: &[f64], out: [&mut [f64]; 3]) -> bool {
        let count = length_m.len();
        let [x, y, z] = direction_m.map(|values| &values[..count]);
        let [enter, leave, metal_m] = out.map(|values| &mut values[..count]);
        let (outer, inner) = (self.outer_m * self.outer_m, self.inner_m * self.inner_m);
        let hollow = self.inner_m > 0.0;
        let mut special = 0_u64;
        for i in 0..count {
            let direction = [x[i], y[i], z[i]];
            let d_along = dot(direction, self.axis);
            let d = add_scaled(direction, -d_along, self.axis);
            let [rate_a, rate_b] = self.ends.map(|end| dot(direction, end.normal));
            let (a, b) = (self.ends[0].ahead_m / rate_a, self.ends[1].ahead_m / rate_b);
            // The sign of each rate tells whether the ray enters or leaves at that end.
            let (a_enters, b_enters) = (rate_a > 0.0, rate_b < 0.0);
            let enter_a = if a_enters { a } else { f64::NEG_INFINITY };
            let enter_b = if b_enters { b } else { f64::NEG_INFINITY };
            let leave_a = if a_enters { f64::INFINITY } else { a };
            let leave_b = if b_enters { f64::INFINITY } else { b };
            let dd = dot(d, d);
            special |= u64::from(rate_a == 0.0) | u64::from(rate_b == 0.0);
            special |= u64::from(dd.sqrt() < 1e-12 * length_m[i]);
            let closest = -dot(self.across, d) / dd;
            let miss = add_scaled(self.across, closest, d);
            let square = dot(miss, miss);
            let (rest_outer, rest_inner) = (outer - square, inner - square);
            let half_outer = (rest_outer.max(0.0) / dd).sqrt();
            let half_inner = (rest_inner.max(0.0) / dd).sqrt();
            let first = enter_a.max(enter_b).max(closest - half_outer).max(0.0);
            let last = leave_a.min(leave_b).min(closest + half_outer).min(1.0);
            let hit = (rest_outer > 0.0) & (first < last);
            let lumen = first.max(closest - half_inner)..last.min(closest + half_inner);
            let open = hollow & (rest_inner > 0.0) & (lumen.start < lumen.end);
            let wall = last - first - if open { lumen.end - lumen.start } else { 0.0 };
            enter[i] = if hit { first } else { MISS.0 };
            leave[i] = if hit { last } else { MISS.1 };
            metal_m[i] = wall.max(0.0) * length_m[i];
        }
        special == 0
    }
}
