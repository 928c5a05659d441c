//! The tool: closed-form chords of its parts, and the anatomy they displace.
//!
//! Along a ray, L = L_anatomy - (anatomy inside the union of the parts' envelopes) + sum(mu_metal * chord). A hollow part's
//! lumen belongs to its envelope and holds air, apart from what other parts put there (a drive cable). Metal that two parts
//! both claim counts twice.

use crate::attenuation::Material;
use crate::ray::WorldRay;
use crate::vector::{Vec3, add_scaled, cross, dot, norm, scale, sub};

/// One part of the tool, in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ToolPart {
    /// A solid cylinder with flat ends.
    Cylinder {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// What it is made of.
        material: Material,
    },
    /// A tube with flat, open ends.
    HollowCylinder {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Outer radius.
        outer_radius_m: f64,
        /// Radius of the lumen.
        inner_radius_m: f64,
        /// What the wall is made of.
        material: Material,
    },
    /// A tube with a notch in its wall, as between two flexures. The notch belongs to the envelope and holds air.
    NotchedTube {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Outer radius.
        outer_radius_m: f64,
        /// Radius of the lumen.
        inner_radius_m: f64,
        /// What was cut out.
        notch: Notch,
        /// What the wall is made of.
        material: Material,
    },
    /// A solid frustum of a cone with flat ends.
    Cone {
        /// Centre of one end.
        start_m: [f64; 3],
        /// Centre of the other end.
        end_m: [f64; 3],
        /// Radius at the start, 0 for a point.
        start_radius_m: f64,
        /// Radius at the end, 0 for a point.
        end_radius_m: f64,
        /// What it is made of.
        material: Material,
    },
    /// A solid sphere.
    Sphere {
        /// Centre.
        centre_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// What it is made of.
        material: Material,
    },
}

/// What is cut out of a tube: all that lies between two planes across its axis and further to one side than a plane along it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Notch {
    /// From the tube's start to the notch's first plane, along the axis.
    pub offset_m: f64,
    /// Width along the axis.
    pub width_m: f64,
    /// The side that is open: a unit vector perpendicular to the axis.
    pub side: [f64; 3],
    /// Depth from the tube's outer surface, less than its outer diameter.
    pub depth_m: f64,
}

/// A tool: any number of parts. No part, no cost.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tool {
    /// The parts, in any order; the order fixes the order of the sums.
    pub parts: Vec<ToolPart>,
}

/// What one part does to one ray: parameters of entry and exit of its envelope, and metres of metal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Parameters of the ray inside the envelope, clipped to 0..=1.
    pub envelope: (f64, f64),
    /// Path in the material.
    pub metal_m: f64,
}

/// A part with its constants worked out.
#[derive(Debug, Clone, Copy)]
pub struct PreparedPart {
    shape: Shape,
    material: Material,
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    Sphere { centre_m: Vec3, radius_m: f64 },
    Axial { start_m: Vec3, axis: Vec3, length_m: f64, radii: Radii },
}

/// What stands around an axis.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Radii {
    Tube { outer_m: f64, inner_m: f64, notch: Option<Cut> },
    Cone { start_m: f64, slope: f64, widest_m: f64 },
}

/// A notch as bounds of the coordinate along the axis and of the one towards `side`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cut {
    along: (f64, f64),
    side: Vec3,
    above: f64,
}

impl PreparedPart {
    /// Works out the constants of a part.
    ///
    /// # Errors
    /// What is wrong with it: a number that is not finite or above 100 m, a radius or length that is not positive, a lumen as wide as the
    /// tube, a notch outside its tube.
    pub fn new(part: &ToolPart) -> Result<Self, &'static str> {
        let (shape, material) = match *part {
            ToolPart::Sphere { centre_m, radius_m, material } => {
                check_points(&[centre_m])?;
                check_radius(radius_m)?;
                (Shape::Sphere { centre_m, radius_m }, material)
            }
            ToolPart::Cylinder { start_m, end_m, radius_m, material } => {
                check_radius(radius_m)?;
                (axial(start_m, end_m, |_, _| Ok(tube(radius_m, 0.0)))?, material)
            }
            ToolPart::HollowCylinder { start_m, end_m, outer_radius_m, inner_radius_m, material } => {
                check_tube(outer_radius_m, inner_radius_m)?;
                (axial(start_m, end_m, |_, _| Ok(tube(outer_radius_m, inner_radius_m)))?, material)
            }
            ToolPart::NotchedTube { start_m, end_m, outer_radius_m, inner_radius_m, notch, material } => {
                check_tube(outer_radius_m, inner_radius_m)?;
                let notched = |axis, length_m| {
                    let cut = Some(notch.cut(axis, length_m, outer_radius_m)?);
                    Ok(Radii::Tube { outer_m: outer_radius_m, inner_m: inner_radius_m, notch: cut })
                };
                (axial(start_m, end_m, notched)?, material)
            }
            ToolPart::Cone { start_m, end_m, start_radius_m, end_radius_m, material } => {
                let widest_m = start_radius_m.max(end_radius_m);
                check_radius(widest_m)?;
                // Written so that a NaN is refused.
                if !(start_radius_m >= 0.0 && end_radius_m >= 0.0) {
                    return Err("a radius of the cone is negative or NaN: give 0 for a point");
                }
                let cone = |_, length_m: f64| {
                    let slope = (end_radius_m - start_radius_m) / length_m;
                    Ok(Radii::Cone { start_m: start_radius_m, slope, widest_m })
                };
                (axial(start_m, end_m, cone)?, material)
            }
        };
        Ok(Self { shape, material })
    }

    /// What the part is made of.
    pub fn material(&self) -> Material {
        self.material
    }

    /// How a ray crosses the part; `None` if it misses.
    pub fn cross(&self, ray: &WorldRay) -> Option<Crossing> {
        self.seen_from(ray.origin_m).cross(ray.direction_m, ray.length_m)
    }

    /// The part with what is common to all rays from one source.
    pub(crate) fn seen_from(&self, source_m: Vec3) -> SeenPart {
        match self.shape {
            Shape::Sphere { centre_m, radius_m } => SeenPart::Sphere { o: sub(source_m, centre_m), radius_m },
            Shape::Axial { start_m, axis, length_m, radii } => {
                let o = sub(source_m, start_m);
                let along = dot(o, axis);
                SeenPart::Axial { axis, length_m, radii, along, across: add_scaled(o, -along, axis) }
            }
        }
    }

    /// Centre and half edges of a box that holds the part, turned so that it looks narrow from `source_m`.
    pub(crate) fn box_from(&self, source_m: Vec3) -> (Vec3, [Vec3; 3]) {
        match self.shape {
            Shape::Sphere { centre_m, radius_m: r } => {
                (centre_m, [[r, 0.0, 0.0], [0.0, r, 0.0], [0.0, 0.0, r]])
            }
            Shape::Axial { start_m, axis, length_m, radii } => {
                let centre = add_scaled(start_m, 0.5 * length_m, axis);
                let sight = sub(centre, source_m);
                let side = cross(axis, sight);
                let size = norm(side);
                let side =
                    if size > 1e-6 * norm(sight) { scale(side, 1.0 / size) } else { any_perpendicular(axis) };
                let radius_m = match radii {
                    Radii::Tube { outer_m, .. } => outer_m,
                    Radii::Cone { widest_m, .. } => widest_m,
                };
                let half =
                    [scale(axis, 0.5 * length_m), scale(side, radius_m), scale(cross(axis, side), radius_m)];
                (centre, half)
            }
        }
    }
}

/// A part as one source sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) enum SeenPart {
    /// `o` runs from the centre to the source.
    Sphere { o: Vec3, radius_m: f64 },
    /// Coordinate of the source along the axis, and its vector across it.
    Axial { axis: Vec3, length_m: f64, radii: Radii, along: f64, across: Vec3 },
}

impl SeenPart {
    /// How a ray of this source crosses the part; `length_m` is that of `direction_m`.
    #[inline]
    pub(crate) fn cross(&self, direction_m: Vec3, length_m: f64) -> Option<Crossing> {
        match *self {
            Self::Sphere { o, radius_m } => {
                let envelope = clip(Closest::new(o, direction_m).inside(radius_m)?)?;
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * length_m })
            }
            Self::Axial { axis, length_m: part_length_m, radii, along, across } => {
                let d_along = dot(direction_m, axis);
                let ray = AxialRay {
                    along: (along, d_along),
                    across: (across, add_scaled(direction_m, -d_along, axis)),
                    length_m,
                };
                let caps = ray.between((0.0, part_length_m))?;
                match radii {
                    Radii::Tube { outer_m, inner_m, notch } => ray.cross_tube(caps, outer_m, inner_m, notch),
                    Radii::Cone { start_m, slope, .. } => ray.cross_cone(caps, start_m, slope),
                }
            }
        }
    }
}

impl Notch {
    fn cut(&self, axis: Vec3, length_m: f64, outer_radius_m: f64) -> Result<Cut, &'static str> {
        let inside = self.offset_m >= 0.0 && self.width_m > 0.0 && self.offset_m + self.width_m <= length_m;
        if !inside {
            return Err(
                "its notch is not within the tube: give offset_m >= 0, width_m > 0, their sum at most the length",
            );
        }
        if !(self.depth_m > 0.0 && self.depth_m < 2.0 * outer_radius_m) {
            return Err("its notch's depth is not between 0 and the outer diameter: correct depth_m");
        }
        let unit = (norm(self.side) - 1.0).abs() < 1e-6 && dot(self.side, axis).abs() < 1e-6;
        if !unit {
            return Err("its notch's side is not a unit vector perpendicular to the axis: normalise it");
        }
        let along = (self.offset_m, self.offset_m + self.width_m);
        Ok(Cut { along, side: self.side, above: outer_radius_m - self.depth_m })
    }
}

/// Sorts intervals by their start and joins those that overlap or touch, in place; returns how many are left.
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

fn check_points(points: &[Vec3]) -> Result<(), &'static str> {
    if points.iter().flatten().all(|x| x.abs() <= 100.0) {
        Ok(())
    } else {
        Err("a coordinate is not finite or is beyond 100 m: give world positions in metres")
    }
}

fn check_radius(radius_m: f64) -> Result<(), &'static str> {
    if radius_m > 0.0 && radius_m <= 1.0 {
        Ok(())
    } else {
        Err("a radius is not in 0 to 1 m (0 excluded): give it in metres; a solid part is a Cylinder")
    }
}

fn check_tube(outer_radius_m: f64, inner_radius_m: f64) -> Result<(), &'static str> {
    check_radius(outer_radius_m)?;
    check_radius(inner_radius_m)?;
    if inner_radius_m >= outer_radius_m {
        return Err("the inner radius is not below the outer one: give inner_radius_m < outer_radius_m");
    }
    Ok(())
}

fn tube(outer_m: f64, inner_m: f64) -> Radii {
    Radii::Tube { outer_m, inner_m, notch: None }
}

fn axial(
    start_m: Vec3,
    end_m: Vec3,
    radii: impl Fn(Vec3, f64) -> Result<Radii, &'static str>,
) -> Result<Shape, &'static str> {
    check_points(&[start_m, end_m])?;
    let along = sub(end_m, start_m);
    let length_m = norm(along);
    if length_m < 1e-9 {
        return Err("its two ends coincide: give it a length");
    }
    let axis = scale(along, 1.0 / length_m);
    Ok(Shape::Axial { start_m, axis, length_m, radii: radii(axis, length_m)? })
}

/// A unit vector perpendicular to a unit vector.
fn any_perpendicular(axis: Vec3) -> Vec3 {
    let a = axis.map(f64::abs);
    let helper = if a[0] <= a[1] && a[0] <= a[2] {
        [1.0, 0.0, 0.0]
    } else if a[1] <= a[2] {
        [0.0, 1.0, 0.0]
    } else {
        [0.0, 0.0, 1.0]
    };
    let side = cross(axis, helper);
    scale(side, 1.0 / norm(side))
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

/// Where a line o + t d comes closest to the origin: |o + t d| < r is then solved without losing digits when the source is far away.
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

/// A ray split along and across an axis: the value at parameter 0 and the rate.
struct AxialRay {
    along: (f64, f64),
    across: (Vec3, Vec3),
    length_m: f64,
}

impl AxialRay {
    /// Where the coordinate along the axis is between two values.
    #[inline]
    fn between(&self, (low, high): (f64, f64)) -> Option<(f64, f64)> {
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
        // Within rounding parallel to the axis: the distance from it does not change.
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
            // The notch takes what it shares with the body, but for the lumen, which is no wall anyway.
            wall -= length(overlap(envelope, cut)) - length(lumen.and_then(|l| overlap(l, cut)));
        }
        Some(Crossing { envelope, metal_m: wall.max(0.0) * self.length_m })
    }

    /// Where the ray is in a notch.
    fn inside_cut(&self, cut: &Cut) -> Option<(f64, f64)> {
        let slab = self.between(cut.along)?;
        let (o, d) = (dot(self.across.0, cut.side) - cut.above, dot(self.across.1, cut.side));
        if d == 0.0 {
            return (o > 0.0).then_some(slab);
        }
        let edge = -o / d;
        overlap(slab, if d > 0.0 { (edge, f64::INFINITY) } else { (f64::NEG_INFINITY, edge) })
    }

    /// |across|^2 < (start + slope z)^2 between the caps, where the radius is not negative: a convex body, so one interval.
    fn cross_cone(&self, caps: (f64, f64), start_m: f64, slope: f64) -> Option<Crossing> {
        let (o, d) = self.across;
        // From the point closest to the cone's start on: no digits are lost when the source is far away.
        let near = -(dot(o, d) + self.along.0 * self.along.1) / (dot(d, d) + self.along.1 * self.along.1);
        let o = add_scaled(o, near, d);
        let (r, rate) = (start_m + slope * (self.along.0 + near * self.along.1), slope * self.along.1);
        // a t^2 + 2 b t + c < 0
        let (a, b, c) = (dot(d, d) - rate * rate, dot(o, d) - r * rate, dot(o, o) - r * r);
        let discriminant = b * b - a * c;
        let whole = (f64::NEG_INFINITY, f64::INFINITY);
        let pieces = if a.abs() <= 1e-15 * (dot(d, d) + rate * rate) {
            // Parallel to a line of the surface.
            if b == 0.0 {
                [(c < 0.0).then_some(whole), None]
            } else {
                let edge = -0.5 * c / b;
                [Some(if b > 0.0 { (whole.0, edge) } else { (edge, whole.1) }), None]
            }
        } else if discriminant <= 0.0 {
            [(a < 0.0).then_some(whole), None]
        } else {
            // The root without cancellation, and the other from their product.
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
