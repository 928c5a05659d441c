//! The tool: closed-form chords of its parts, and the anatomy they displace.
//!
//! Along a ray, L = L_anatomy - (anatomy inside the union of the parts' envelopes) + sum(mu_metal * chord). A hollow part's
//! lumen belongs to its envelope and holds air, apart from what other parts put there (a drive cable). Metal that two parts
//! both claim counts twice.

use crate::attenuation::Material;
use crate::carm::{Pinhole, PixelBox};
use crate::error::DrrError;
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
    Tube { start_m: Vec3, axis: Vec3, length_m: f64, outer_radius_m: f64, inner_radius_m: f64 },
}

impl Tool {
    /// Checks the parts and works out their constants.
    ///
    /// # Errors
    /// The first part that is no body: a number that is not finite or above 10 m, a radius or length that is not positive, a lumen as
    /// wide as the tube.
    pub fn prepare(&self) -> Result<Vec<PreparedPart>, DrrError> {
        self.parts
            .iter()
            .enumerate()
            .map(|(part, p)| PreparedPart::new(p).map_err(|reason| DrrError::ToolPart { part, reason }))
            .collect()
    }
}

impl PreparedPart {
    /// Works out the constants of a part.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn new(part: &ToolPart) -> Result<Self, &'static str> {
        let (shape, material) = match *part {
            ToolPart::Sphere { centre_m, radius_m, material } => {
                check_points(&[centre_m])?;
                check_radius(radius_m)?;
                (Shape::Sphere { centre_m, radius_m }, material)
            }
            ToolPart::Cylinder { start_m, end_m, radius_m, material } => {
                (tube(start_m, end_m, radius_m, 0.0)?, material)
            }
            ToolPart::HollowCylinder { start_m, end_m, outer_radius_m, inner_radius_m, material } => {
                check_radius(inner_radius_m)?;
                if inner_radius_m >= outer_radius_m {
                    return Err(
                        "the inner radius is not below the outer one: give inner_radius_m < outer_radius_m",
                    );
                }
                (tube(start_m, end_m, outer_radius_m, inner_radius_m)?, material)
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
        match self.shape {
            Shape::Sphere { centre_m, radius_m } => {
                let envelope = clip(sphere_interval(ray, centre_m, radius_m)?)?;
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0) * ray.length_m })
            }
            Shape::Tube { start_m, axis, length_m, outer_radius_m, inner_radius_m } => {
                let frame = TubeRay::new(ray, start_m, axis);
                let caps = frame.between_caps(length_m)?;
                let envelope = clip(overlap(caps, frame.inside_radius(outer_radius_m)?)?)?;
                let lumen = frame
                    .inside_radius(inner_radius_m)
                    .and_then(|i| overlap(envelope, i))
                    .map_or(0.0, |(a, b)| b - a);
                Some(Crossing { envelope, metal_m: (envelope.1 - envelope.0 - lumen) * ray.length_m })
            }
        }
    }

    /// The pixels that the part can cover.
    pub fn bounds(&self, pinhole: &Pinhole, columns: u32, rows: u32) -> Option<PixelBox> {
        let (centre, half) = match self.shape {
            Shape::Sphere { centre_m, radius_m: r } => {
                (centre_m, [[r, 0.0, 0.0], [0.0, r, 0.0], [0.0, 0.0, r]])
            }
            Shape::Tube { start_m, axis, length_m, outer_radius_m, .. } => {
                let side = scale(any_perpendicular(axis), outer_radius_m);
                let other = cross(axis, side);
                let centre = add_scaled(start_m, 0.5 * length_m, axis);
                (centre, [scale(axis, 0.5 * length_m), side, other])
            }
        };
        pinhole.bounds(centre, &half, columns, rows)
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

fn tube(start_m: Vec3, end_m: Vec3, outer_radius_m: f64, inner_radius_m: f64) -> Result<Shape, &'static str> {
    check_points(&[start_m, end_m])?;
    check_radius(outer_radius_m)?;
    let along = sub(end_m, start_m);
    let length_m = norm(along);
    if length_m < 1e-9 {
        return Err("its two ends coincide: give it a length");
    }
    let axis = scale(along, 1.0 / length_m);
    Ok(Shape::Tube { start_m, axis, length_m, outer_radius_m, inner_radius_m })
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

fn sphere_interval(ray: &WorldRay, centre_m: Vec3, radius_m: f64) -> Option<(f64, f64)> {
    quadratic_interval(sub(ray.origin_m, centre_m), ray.direction_m, radius_m)
}

/// Parameters where |o + t d| < r. By way of the closest point, which loses no digits when the source is far away.
fn quadratic_interval(o: Vec3, d: Vec3, radius: f64) -> Option<(f64, f64)> {
    let dd = dot(d, d);
    let closest = -dot(o, d) / dd;
    let miss = add_scaled(o, closest, d);
    let rest = radius * radius - dot(miss, miss);
    if rest.is_nan() || rest <= 0.0 {
        return None;
    }
    let half = (rest / dd).sqrt();
    Some((closest - half, closest + half))
}

/// A ray split along and across a tube's axis.
struct TubeRay {
    along: (f64, f64),
    across: (Vec3, Vec3),
    parallel: bool,
}

impl TubeRay {
    fn new(ray: &WorldRay, start_m: Vec3, axis: Vec3) -> Self {
        let o = sub(ray.origin_m, start_m);
        let along = (dot(o, axis), dot(ray.direction_m, axis));
        let across = (add_scaled(o, -along.0, axis), add_scaled(ray.direction_m, -along.1, axis));
        let parallel = norm(across.1) < 1e-12 * ray.length_m;
        Self { along, across, parallel }
    }

    fn between_caps(&self, length_m: f64) -> Option<(f64, f64)> {
        let (o, d) = self.along;
        if d == 0.0 {
            return (o > 0.0 && o < length_m).then_some((f64::NEG_INFINITY, f64::INFINITY));
        }
        let (a, b) = (-o / d, (length_m - o) / d);
        Some((a.min(b), a.max(b)))
    }

    fn inside_radius(&self, radius_m: f64) -> Option<(f64, f64)> {
        let (o, d) = self.across;
        if self.parallel {
            return (dot(o, o) < radius_m * radius_m).then_some((f64::NEG_INFINITY, f64::INFINITY));
        }
        quadratic_interval(o, d, radius_m)
    }
}
