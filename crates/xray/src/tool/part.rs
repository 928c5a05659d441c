//! A validated part of the tool with its precomputed constants.

use super::crossing::{Crossing, End, SeenPart};
use super::{Notch, ToolPart};
use crate::attenuation::Material;
use crate::error::check_orthonormal;
use crate::ray::WorldRay;
use crate::vector::{Vec3, add_scaled, cross, dot, norm, scale, sub};

/// A validated part with its constants.
#[derive(Debug, Clone, Copy)]
pub struct PreparedPart {
    shape: Shape,
    material: Material,
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    Sphere { centre_m: Vec3, radius_m: f64 },
    Zone { centre_m: Vec3, radius_m: f64, axis: Vec3, along_m: [f64; 2] },
    Axial { start_m: Vec3, axis: Vec3, length_m: f64, normals: [Vec3; 2], radii: Radii },
    Cuboid { centre_m: Vec3, axes: [Vec3; 3], half_m: [f64; 3] },
}

/// Least cosine between an axis and the normal of an end: 60 degrees.
pub(crate) const LEAST_MITRE_COSINE: f64 = 0.5;

/// The cross-section about an axis.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Radii {
    Tube { outer_m: f64, inner_m: f64, notch: Option<Cut> },
    Cone { start_m: f64, slope: f64, widest_m: f64 },
}

/// A notch as a range along the axis, and a lower bound of the coordinate toward `side`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cut {
    pub(super) along: (f64, f64),
    pub(super) side: Vec3,
    pub(super) above: f64,
}

impl PreparedPart {
    /// Checks a part and computes its constants.
    ///
    /// # Errors
    /// A number is not finite or above 100 m, a radius or length is not positive, axes are not perpendicular
    /// unit vectors, the lumen is as wide as the tube, a notch is outside its tube, a zone
    /// outside its sphere, or an end is cut more obliquely than at 60 degrees.
    pub fn new(part: &ToolPart) -> Result<Self, &'static str> {
        let (shape, material) = match *part {
            ToolPart::Sphere { centre_m, radius_m, material } => {
                check_points(&[centre_m])?;
                check_radius(radius_m)?;
                (Shape::Sphere { centre_m, radius_m }, material)
            }
            ToolPart::SphereZone { centre_m, radius_m, axis, along_m, material } => {
                check_points(&[centre_m])?;
                check_radius(radius_m)?;
                check_zone(radius_m, axis, along_m)?;
                (Shape::Zone { centre_m, radius_m, axis, along_m }, material)
            }
            ToolPart::Tube { start_m, end_m, normals, outer_radius_m, inner_radius_m, notch, material } => {
                check_tube(outer_radius_m, inner_radius_m)?;
                let notched = |axis, length_m| {
                    let notch = notch.map(|notch| notch.cut(axis, length_m, outer_radius_m)).transpose()?;
                    Ok(Radii::Tube { outer_m: outer_radius_m, inner_m: inner_radius_m, notch })
                };
                (axial(start_m, end_m, normals, notched)?, material)
            }
            ToolPart::Cuboid { centre_m, axes, half_m, material } => {
                check_points(&[centre_m])?;
                check_cuboid(&axes, half_m)?;
                (Shape::Cuboid { centre_m, axes, half_m }, material)
            }
            ToolPart::Cone { start_m, end_m, start_radius_m, end_radius_m, material } => {
                let widest_m = start_radius_m.max(end_radius_m);
                check_radius(widest_m)?;
                // Negated, so that a NaN is refused.
                if !(start_radius_m >= 0.0 && end_radius_m >= 0.0) {
                    return Err("a radius of the cone is negative or NaN: use 0 for a point");
                }
                let cone = |_, length_m: f64| {
                    let slope = (end_radius_m - start_radius_m) / length_m;
                    Ok(Radii::Cone { start_m: start_radius_m, slope, widest_m })
                };
                (axial(start_m, end_m, None, cone)?, material)
            }
        };
        Ok(Self { shape, material })
    }

    /// The part's material.
    pub fn material(&self) -> Material {
        self.material
    }

    /// Intersects a ray with the part; `None` if it misses.
    pub fn cross(&self, ray: &WorldRay) -> Option<Crossing> {
        self.seen_from(ray.origin_m).cross(ray.direction_m, ray.length_m)
    }

    /// The part with everything that rays from one source share.
    pub(crate) fn seen_from(&self, source_m: Vec3) -> SeenPart {
        match self.shape {
            Shape::Sphere { centre_m, radius_m } => SeenPart::Sphere { o: sub(source_m, centre_m), radius_m },
            Shape::Zone { centre_m, radius_m, axis, along_m } => {
                let o = sub(source_m, centre_m);
                let ends = along_m.map(|at_m| End { normal: axis, ahead_m: at_m - dot(o, axis) });
                SeenPart::Zone { o, radius_m, ends }
            }
            Shape::Cuboid { centre_m, axes, half_m } => {
                let o = sub(source_m, centre_m);
                let ends = |axis: usize| {
                    let (normal, half_m) = (axes[axis], half_m[axis]);
                    [-half_m, half_m].map(|at_m| End { normal, ahead_m: at_m - dot(o, normal) })
                };
                SeenPart::Cuboid { ends: [ends(0), ends(1), ends(2)] }
            }
            Shape::Axial { start_m, axis, length_m, normals, radii } => {
                let o = sub(source_m, start_m);
                let along = dot(o, axis);
                let end = |normal: Vec3, at_m: f64| {
                    let is_flat = normal == axis;
                    let ahead_m =
                        if is_flat { at_m - along } else { at_m * dot(axis, normal) - dot(o, normal) };
                    End { normal, ahead_m }
                };
                let ends = [end(normals[0], 0.0), end(normals[1], length_m)];
                SeenPart::Axial { axis, ends, radii, along, across: add_scaled(o, -along, axis) }
            }
        }
    }

    /// Centre and half-extent vectors of a bounding box, rotated to be as narrow as possible as seen from
    /// `source_m`.
    pub(crate) fn box_from(&self, source_m: Vec3) -> (Vec3, [Vec3; 3]) {
        match self.shape {
            Shape::Sphere { centre_m, radius_m: r } => {
                (centre_m, [[r, 0.0, 0.0], [0.0, r, 0.0], [0.0, 0.0, r]])
            }
            Shape::Cuboid { centre_m, axes, half_m } => {
                (centre_m, [0, 1, 2].map(|axis| scale(axes[axis], half_m[axis])))
            }
            Shape::Zone { centre_m, radius_m, axis, along_m: [from_m, to_m] } => {
                let side = any_perpendicular(axis);
                let half_m = 0.5 * (to_m - from_m);
                let half = [scale(axis, half_m), scale(side, radius_m), scale(cross(axis, side), radius_m)];
                (add_scaled(centre_m, from_m + half_m, axis), half)
            }
            Shape::Axial { start_m, axis, length_m, normals, radii } => {
                let radius_m = match radii {
                    Radii::Tube { outer_m, .. } => outer_m,
                    Radii::Cone { widest_m, .. } => widest_m,
                };
                // An oblique end protrudes by the radius times the tangent of its angle.
                let [before_m, beyond_m] = normals.map(|normal| {
                    let cosine = dot(normal, axis);
                    if normal == axis { 0.0 } else { radius_m * norm(cross(normal, axis)) / cosine }
                });
                let centre = add_scaled(start_m, 0.5 * (length_m + beyond_m - before_m), axis);
                let half_m = 0.5 * (length_m + beyond_m + before_m);
                let sight = sub(centre, source_m);
                let side = cross(axis, sight);
                let size = norm(side);
                let side =
                    if size > 1e-6 * norm(sight) { scale(side, 1.0 / size) } else { any_perpendicular(axis) };
                let half = [scale(axis, half_m), scale(side, radius_m), scale(cross(axis, side), radius_m)];
                (centre, half)
            }
        }
    }
}

impl Notch {
    fn cut(&self, axis: Vec3, length_m: f64, outer_radius_m: f64) -> Result<Cut, &'static str> {
        let inside = self.offset_m >= 0.0 && self.width_m > 0.0 && self.offset_m + self.width_m <= length_m;
        if !inside {
            return Err(
                "the notch is not within the tube: offset_m must be >= 0, width_m > 0, and their sum at most \
                 the length",
            );
        }
        if !(self.depth_m > 0.0 && self.depth_m < 2.0 * outer_radius_m) {
            return Err("the notch's depth_m is out of range: must be between 0 and the outer diameter");
        }
        let unit = (norm(self.side) - 1.0).abs() < 1e-6 && dot(self.side, axis).abs() < 1e-6;
        if !unit {
            return Err("the notch's side is not a unit vector perpendicular to the axis: normalise it");
        }
        let along = (self.offset_m, self.offset_m + self.width_m);
        Ok(Cut { along, side: self.side, above: outer_radius_m - self.depth_m })
    }
}

/// Checks the normals of a part's ends.
fn check_normals(normals: &[Vec3; 2], axis: Vec3) -> Result<(), &'static str> {
    let is_good =
        |normal: &Vec3| (norm(*normal) - 1.0).abs() < 1e-6 && dot(*normal, axis) >= LEAST_MITRE_COSINE;
    if normals.iter().all(is_good) {
        Ok(())
    } else {
        Err("an end normal is not a unit vector within 60 degrees of the axis from start to end: \
             correct `normals`")
    }
}

fn check_points(points: &[Vec3]) -> Result<(), &'static str> {
    if points.iter().flatten().all(|x| x.abs() <= 100.0) {
        Ok(())
    } else {
        Err("a coordinate is not finite or exceeds 100 m: give world positions in metres")
    }
}

fn check_radius(radius_m: f64) -> Result<(), &'static str> {
    if radius_m > 0.0 && radius_m <= 1.0 {
        Ok(())
    } else {
        Err("a radius is out of range: must be above 0 and at most 1 m")
    }
}

fn check_cuboid(axes: &[Vec3; 3], half_m: [f64; 3]) -> Result<(), &'static str> {
    if check_orthonormal("axes", axes, 1e-6).is_err() {
        return Err("the axes of a cuboid are not perpendicular unit vectors: normalise them");
    }
    if half_m.iter().all(|half_m| *half_m > 0.0 && *half_m <= 1.0) {
        Ok(())
    } else {
        Err("a half_m of a cuboid is out of range: must be above 0 and at most 1 m")
    }
}

fn check_zone(radius_m: f64, axis: Vec3, [from_m, to_m]: [f64; 2]) -> Result<(), &'static str> {
    // False for a NaN.
    let is_unit = (norm(axis) - 1.0).abs() < 1e-6;
    let rounded_m = radius_m * (1.0 + 1e-9);
    let is_within = -rounded_m <= from_m && from_m < to_m && to_m <= rounded_m;
    if !is_unit {
        return Err("the axis of a sphere zone is not a unit vector: normalise it");
    }
    if !is_within {
        return Err("along_m of a sphere zone must be in ascending order and within the sphere");
    }
    Ok(())
}

fn check_tube(outer_radius_m: f64, inner_radius_m: f64) -> Result<(), &'static str> {
    check_radius(outer_radius_m)?;
    if inner_radius_m == 0.0 {
        return Ok(());
    }
    check_radius(inner_radius_m)?;
    if inner_radius_m >= outer_radius_m {
        return Err("the inner radius is too large: expected inner_radius_m < outer_radius_m");
    }
    Ok(())
}

fn axial(
    start_m: Vec3,
    end_m: Vec3,
    normals: Option<[Vec3; 2]>,
    radii: impl Fn(Vec3, f64) -> Result<Radii, &'static str>,
) -> Result<Shape, &'static str> {
    check_points(&[start_m, end_m])?;
    let along = sub(end_m, start_m);
    let length_m = norm(along);
    if length_m < 1e-9 {
        return Err("the two ends coincide: the length must be positive");
    }
    let axis = scale(along, 1.0 / length_m);
    let normals = normals.unwrap_or([axis; 2]);
    check_normals(&normals, axis)?;
    Ok(Shape::Axial { start_m, axis, length_m, normals, radii: radii(axis, length_m)? })
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
