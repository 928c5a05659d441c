//! Ray intersections with the tool's parts.

use super::part::{Cut, Radii};
use crate::vector::{Vec3, add_scaled, dot};

/// Where a ray enters and leaves a part's envelope, and its path length in metal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Parameters of the ray inside the envelope, clipped to 0..=1.
    pub envelope: (f64, f64),
    /// Path length in the material.
    pub metal_m: f64,
}

/// A part with precomputed constants for one source.
#[derive(Debug, Clone, Copy)]
pub(crate) enum SeenPart {
    /// `o` runs from the centre to the source.
    Sphere { o: Vec3, radius_m: f64 },
    /// The same, and the planes that cut the sphere.
    Zone { o: Vec3, radius_m: f64, ends: [End; 2] },
    /// The three pairs of faces.
    Cuboid { ends: [[End; 2]; 3] },
    /// The source's coordinate along the axis, and its vector across the axis.
    Axial { axis: Vec3, ends: [End; 2], radii: Radii, along: f64, across: Vec3 },
}

/// The plane that cuts an end of a part, seen from the source.
#[derive(Debug, Clone, Copy)]
pub(crate) struct End {
    /// Unit normal, from the part's start to its end.
    pub(crate) normal: Vec3,
    /// From the source to the plane, along the normal.
    pub(crate) ahead_m: f64,
}

/// Parameters for which a ray from the source is beyond the first end and before the second.
#[inline]
fn between_ends(ends: &[End; 2], direction_m: Vec3) -> Option<(f64, f64)> {
    let whole = (f64::NEG_INFINITY, f64::INFINITY);
    let side = |end: &End, is_first: bool| {
        let rate = dot(direction_m, end.normal);
        if rate == 0.0 {
            let is_inside = if is_first { end.ahead_m < 0.0 } else { end.ahead_m > 0.0 };
            return is_inside.then_some(whole);
        }
        let edge = end.ahead_m / rate;
        Some(if (rate > 0.0) == is_first { (edge, whole.1) } else { (whole.0, edge) })
    };
    overlap(side(&ends[0], true)?, side(&ends[1], false)?)
}

impl SeenPart {
    /// Intersects a ray from this source with the part; `length_m` is the length of `direction_m`.
    #[inline]
    pub(crate) fn cross(&self, direction_m: Vec3, length_m: f64) -> Option<Crossing> {
        match *self {
            Self::Sphere { o, radius_m } => {
                let envelope = clip(Closest::new(o, direction_m).inside(radius_m)?)?;
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * length_m })
            }
            Self::Zone { o, radius_m, ends } => {
                let ball = Closest::new(o, direction_m).inside(radius_m)?;
                let envelope = clip(overlap(between_ends(&ends, direction_m)?, ball)?)?;
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * length_m })
            }
            Self::Cuboid { ends } => {
                let slab = |axis: usize| between_ends(&ends[axis], direction_m);
                let envelope = clip(overlap(overlap(slab(0)?, slab(1)?)?, slab(2)?)?)?;
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * length_m })
            }
            Self::Axial { axis, ends, radii, along, across } => {
                let d_along = dot(direction_m, axis);
                let ray = AxialRay {
                    along: (along, d_along),
                    across: (across, add_scaled(direction_m, -d_along, axis)),
                    length_m,
                };
                let caps = between_ends(&ends, direction_m)?;
                match radii {
                    Radii::Tube { outer_m, inner_m, notch } => ray.cross_tube(caps, outer_m, inner_m, notch),
                    Radii::Cone { start_m, slope, .. } => ray.cross_cone(caps, start_m, slope),
                }
            }
        }
    }
}

/// Sorts intervals by start and merges those that overlap or touch, in place; returns the number that remain.
pub fn join_intervals(intervals: &mut [(f64, f64)]) -> usize {
    intervals.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut kept = 0;
    for i in 0..intervals.len() {
        let next = intervals[i];
        if kept > 0 && next.0 <= intervals[kept - 1].1 {
            intervals[kept - 1].1 = intervals[kept - 1].1.max(next.1);
        } else {
            intervals[kept] = next;
            kept += 1;
        }
    }
    kept
}

fn overlap(a: (f64, f64), b: (f64, f64)) -> Option<(f64, f64)> {
    let both = (a.0.max(b.0), a.1.min(b.1));
    (both.0 < both.1).then_some(both)
}

fn clip(interval: (f64, f64)) -> Option<(f64, f64)> {
    overlap(interval, (0.0, 1.0))
}

fn length(interval: Option<(f64, f64)>) -> f64 {
    interval.map_or(0.0, |(a, b)| b - a)
}

/// The point of the line o + t d closest to the origin. Measured from there, |o + t d| < r is solved without
/// cancellation even for a distant source.
struct Closest {
    parameter: f64,
    square: f64,
    dd: f64,
}

impl Closest {
    #[inline]
    fn new(o: Vec3, d: Vec3) -> Self {
        let dd = dot(d, d);
        let parameter = -dot(o, d) / dd;
        let miss = add_scaled(o, parameter, d);
        Self { parameter, square: dot(miss, miss), dd }
    }

    #[inline]
    fn inside(&self, radius: f64) -> Option<(f64, f64)> {
        let rest = radius * radius - self.square;
        if rest.is_nan() || rest <= 0.0 {
            return None;
        }
        let half = (rest / self.dd).sqrt();
        Some((self.parameter - half, self.parameter + half))
    }
}

/// A ray decomposed along and across an axis: value at parameter 0, and rate.
struct AxialRay {
    along: (f64, f64),
    across: (Vec3, Vec3),
    length_m: f64,
}

impl AxialRay {
    /// Parameters for which the coordinate along the axis is between two values.
    #[inline]
    fn between(&self, low: f64, high: f64) -> Option<(f64, f64)> {
        let (o, d) = self.along;
        if d == 0.0 {
            return (o > low && o < high).then_some((f64::NEG_INFINITY, f64::INFINITY));
        }
        let (a, b) = ((low - o) / d, (high - o) / d);
        Some((a.min(b), a.max(b)))
    }

    #[inline]
    fn cross_tube(
        &self,
        caps: (f64, f64),
        outer_m: f64,
        inner_m: f64,
        notch: Option<Cut>,
    ) -> Option<Crossing> {
        let (o, d) = self.across;
        let closest = Closest::new(o, d);
        // Parallel to the axis within rounding: the distance from it is constant.
        let parallel = closest.dd.sqrt() < 1e-12 * self.length_m;
        let inside = |radius_m: f64| {
            if parallel {
                return (dot(o, o) < radius_m * radius_m).then_some((f64::NEG_INFINITY, f64::INFINITY));
            }
            closest.inside(radius_m)
        };
        let envelope = clip(overlap(caps, inside(outer_m)?)?)?;
        let lumen = if inner_m > 0.0 { inside(inner_m).and_then(|i| overlap(envelope, i)) } else { None };
        let mut wall = envelope.1 - envelope.0 - length(lumen);
        if let Some(cut) = notch.and_then(|cut| self.inside_cut(&cut)) {
            // The notch removes its part of the envelope, except in the lumen, which holds no metal anyway.
            wall -= length(overlap(envelope, cut)) - length(lumen.and_then(|l| overlap(l, cut)));
        }
        Some(Crossing { envelope, metal_m: wall.max(0.0) * self.length_m })
    }

    /// Parameters for which the ray is inside a notch.
    fn inside_cut(&self, cut: &Cut) -> Option<(f64, f64)> {
        let slab = self.between(cut.along.0, cut.along.1)?;
        let (o, d) = (dot(self.across.0, cut.side) - cut.above, dot(self.across.1, cut.side));
        if d == 0.0 {
            return (o > 0.0).then_some(slab);
        }
        let edge = -o / d;
        overlap(slab, if d > 0.0 { (edge, f64::INFINITY) } else { (f64::NEG_INFINITY, edge) })
    }

    /// Solves |across|^2 < (start + slope z)^2 between the caps, where the radius is not negative. The body
    /// is convex, so the solution is one interval.
    fn cross_cone(&self, caps: (f64, f64), start_m: f64, slope: f64) -> Option<Crossing> {
        let (o, d) = self.across;
        // Relative to the point closest to the cone's start, to avoid cancellation for a distant source.
        let near = -(dot(o, d) + self.along.0 * self.along.1) / (dot(d, d) + self.along.1 * self.along.1);
        let o = add_scaled(o, near, d);
        let (r, rate) = (start_m + slope * (self.along.0 + near * self.along.1), slope * self.along.1);
        // a t^2 + 2 b t + c < 0
        let (a, b, c) = (dot(d, d) - rate * rate, dot(o, d) - r * rate, dot(o, o) - r * r);
        let discriminant = b * b - a * c;
        let whole = (f64::NEG_INFINITY, f64::INFINITY);
        let pieces = if a.abs() <= 1e-15 * (dot(d, d) + rate * rate) {
            // Parallel to a generatrix of the cone.
            if b == 0.0 {
                [(c < 0.0).then_some(whole), None]
            } else {
                let edge = -0.5 * c / b;
                [Some(if b > 0.0 { (whole.0, edge) } else { (edge, whole.1) }), None]
            }
        } else if discriminant <= 0.0 {
            [(a < 0.0).then_some(whole), None]
        } else {
            // One root without cancellation, the other from their product.
            let q = -(b + discriminant.sqrt().copysign(b));
            let (t0, t1) = (q / a, c / q);
            let (low, high) = (t0.min(t1), t0.max(t1));
            if a > 0.0 { [Some((low, high)), None] } else { [Some((whole.0, low)), Some((high, whole.1))] }
        };
        let envelope =
            clip(pieces.into_iter().flatten().find_map(|(a, b)| overlap(caps, (a + near, b + near)))?)?;
        Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * self.length_m })
    }
}
