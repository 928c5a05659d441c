//! The contact plane between a convex shape and a sphere.

use nalgebra::{Isometry3, Unit, Vector3};
use rapier3d_f64::math::Pose;
use rapier3d_f64::parry::query::PointQuery;
use rapier3d_f64::parry::shape::{Ball, Capsule, Cuboid};

use super::body::BodyShape;
use super::world::{from_vector, vector};

/// Distance from the surface within which a sphere centre defines no reliable direction, m.
const ON_SURFACE_M: f64 = 1e-10;

/// A shape in the form that Parry's point projection needs.
#[derive(Debug, Clone)]
pub(super) enum QueryShape {
    Box(Cuboid),
    Ball(Ball),
    Capsule(Capsule),
}

/// Closest surface point and the outward direction there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Nearest {
    pub point_m: Vector3<f64>,
    pub normal: Unit<Vector3<f64>>,
    /// Signed distance from the surface to the query point, negative inside, m.
    pub distance_m: f64,
}

impl QueryShape {
    pub fn new(shape: &BodyShape) -> QueryShape {
        match shape {
            BodyShape::Box { half_extents_m } => QueryShape::Box(Cuboid::new(vector(half_extents_m))),
            BodyShape::Ball { radius_m } => QueryShape::Ball(Ball::new(*radius_m)),
            BodyShape::Capsule { half_height_m, radius_m } => {
                QueryShape::Capsule(Capsule::new_z(*half_height_m, *radius_m))
            }
        }
    }

    /// Returns the radius of the bounding sphere about the origin, m.
    pub fn bounding_radius_m(&self) -> f64 {
        match self {
            QueryShape::Box(cuboid) => cuboid.half_extents.length(),
            QueryShape::Ball(ball) => ball.radius,
            QueryShape::Capsule(capsule) => capsule.half_height() + capsule.radius,
        }
    }

    /// Returns the surface point nearest to `centre_m`.
    pub fn nearest(&self, t_world_body: &Isometry3<f64>, centre_m: &Vector3<f64>) -> Nearest {
        let (pose, centre) = (Pose::from(*t_world_body), vector(centre_m));
        let projection = match self {
            QueryShape::Box(shape) => shape.project_point(&pose, centre, false),
            QueryShape::Ball(shape) => shape.project_point(&pose, centre, false),
            QueryShape::Capsule(shape) => shape.project_point(&pose, centre, false),
        };
        let point_m = from_vector(projection.point);
        let outward = if projection.is_inside { point_m - centre_m } else { centre_m - point_m };
        let side = if projection.is_inside { -1.0 } else { 1.0 };
        let length = libm::sqrt(outward.norm_squared());
        if length > ON_SURFACE_M {
            let normal = Unit::new_unchecked(outward / length);
            return Nearest { point_m, normal, distance_m: side * length };
        }
        // On the surface, use the direction away from the body's centre, which leads out of every convex
        // shape.
        let away = centre_m - t_world_body.translation.vector;
        let normal = Unit::try_new(away, ON_SURFACE_M).unwrap_or_else(Vector3::z_axis);
        Nearest { point_m, normal, distance_m: 0.0 }
    }
}
