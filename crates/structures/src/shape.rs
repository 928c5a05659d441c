//! Shapes with a signed distance.

use std::sync::Arc;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::field::DistanceField;

/// A shape in the patient frame.
#[derive(Debug, Clone)]
pub enum Shape {
    /// All points within a radius of a polyline: a ball for one point, a capsule for two, a canal or vessel
    /// for more.
    Tube {
        /// The line, at least one point, m.
        points_m: Vec<Vector3<f64>>,
        /// Radius, m.
        radius_m: f64,
    },
    /// A box.
    Cuboid {
        /// Its centre and axes.
        t_world_cuboid: Isometry3<f64>,
        /// Half extents along its axes, m.
        half_m: Vector3<f64>,
    },
    /// What a volume defines.
    Field(Arc<DistanceField>),
}

impl Shape {
    /// Returns the shape of a scene's structure; `outside` is the distance from the outside of the bone.
    /// `None` for a structure that is defined by a volume, without one.
    pub fn of(structure: &scene::Structure, outside: Option<&Arc<DistanceField>>) -> Option<Shape> {
        let metres = |point_mm: [f64; 3]| Vector3::from(point_mm) * 1e-3;
        if let Some(ball) = &structure.ball {
            return Some(Shape::Tube {
                points_m: vec![metres(ball.centre_mm)],
                radius_m: ball.radius_mm * 1e-3,
            });
        }
        if let Some(tube) = &structure.tube {
            let points_m = tube.points_mm.iter().copied().map(metres).collect();
            return Some(Shape::Tube { points_m, radius_m: tube.radius_mm * 1e-3 });
        }
        if let Some(cuboid) = &structure.cuboid {
            let turn_rad = cuboid.rotation_vector_deg.map(f64::to_radians);
            let t_world_cuboid = Isometry3::from_parts(
                Translation3::from(metres(cuboid.centre_mm)),
                UnitQuaternion::from_scaled_axis(Vector3::from(turn_rad)),
            );
            return Some(Shape::Cuboid { t_world_cuboid, half_m: metres(cuboid.half_extents_mm) });
        }
        outside.map(|field| Shape::Field(Arc::clone(field)))
    }

    /// Returns the distance of a point from the surface, m, negative inside.
    pub fn distance_m(&self, point_m: &Vector3<f64>) -> f64 {
        match self {
            Shape::Tube { points_m, radius_m } => from_line_m(points_m, point_m) - radius_m,
            Shape::Cuboid { t_world_cuboid, half_m } => {
                let local = t_world_cuboid.inverse_transform_point(&(*point_m).into()).coords;
                let beyond = local.abs() - half_m;
                beyond.map(|x| x.max(0.0)).norm() + beyond.max().min(0.0)
            }
            Shape::Field(field) => field.distance_m(point_m),
        }
    }
}

/// Returns the distance of a point from a polyline, m.
fn from_line_m(line_m: &[Vector3<f64>], point_m: &Vector3<f64>) -> f64 {
    let first = line_m.first().map_or(f64::INFINITY, |first| (point_m - first).norm_squared());
    let from_piece = |piece: &[Vector3<f64>]| {
        let (way, away) = (piece[1] - piece[0], point_m - piece[0]);
        let share = (away.dot(&way) / way.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        (away - way * share).norm_squared()
    };
    libm::sqrt(line_m.windows(2).map(from_piece).fold(first, f64::min))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn v(x: f64, y: f64, z: f64) -> Vector3<f64> {
        Vector3::new(x, y, z)
    }

    #[test]
    fn distances_of_balls_tubes_and_boxes_are_those_of_their_closed_forms() {
        let ball = Shape::Tube { points_m: vec![v(1.0, 2.0, 3.0)], radius_m: 0.5 };
        assert_eq!(ball.distance_m(&v(1.0, 2.0, 5.0)), 1.5);
        assert_eq!(ball.distance_m(&v(1.0, 2.0, 3.0)), -0.5);
        // A bend: beside its first leg, beyond its end, and inside the corner.
        let tube = Shape::Tube {
            points_m: vec![v(0.0, 0.0, 0.0), v(4.0, 0.0, 0.0), v(4.0, 4.0, 0.0)],
            radius_m: 1.0,
        };
        for (point, expected) in [
            (v(2.0, -3.0, 0.0), 2.0),
            (v(4.0, 7.0, 0.0), 2.0),
            (v(-3.0, 0.0, 4.0), 4.0),
            (v(3.5, 0.5, 0.0), -0.5),
        ] {
            assert!((tube.distance_m(&point) - expected).abs() < 1e-15, "{point}");
        }
        let turn = UnitQuaternion::from_scaled_axis(v(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        let t_world_cuboid = Isometry3::from_parts(Translation3::new(1.0, 0.0, 0.0), turn);
        let cuboid = Shape::Cuboid { t_world_cuboid, half_m: v(2.0, 1.0, 0.5) };
        // Its long axis points along y.
        for (point, expected) in [
            (v(1.0, 3.0, 0.0), 1.0),
            (v(3.0, 0.0, 0.0), 1.0),
            (v(1.0, 0.0, 0.0), -0.5),
            (v(1.0, 1.8, 0.0), -0.2),
            (v(5.0, 6.0, 0.0), 5.0),
        ] {
            assert!(
                (cuboid.distance_m(&point) - expected).abs() < 1e-12,
                "{point}: {}",
                cuboid.distance_m(&point)
            );
        }
    }
}
