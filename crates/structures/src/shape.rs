//! Shapes with a signed distance.

use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use scene::{BuiltInStructure, Scene, StructureCuboid, StructureVoxels};
use thiserror::Error;
use voxel_grid::{GridError, VoxelGrid};

use crate::field::DistanceField;
use crate::solid::Solid;

/// A shape in the patient frame.
#[derive(Debug, Clone, PartialEq)]
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
    /// What a mesh bounds.
    Solid(Arc<Solid>),
    /// What a volume defines, and all that is closer to it than `more_m`.
    Field {
        /// Distance from what the volume defines.
        field: Arc<DistanceField>,
        /// Width that is added to it, m.
        more_m: f64,
    },
}

/// Why a structure of a scene has no shape.
#[derive(Debug, Error)]
pub enum StructureError {
    /// The scene was not read from a file together with the files that it names.
    #[error("the file of structure `{0}` has not been read: read the scene from its file")]
    Unread(String),
    /// Its content is malformed.
    #[error("structure `{name}` {problem}")]
    Malformed {
        /// Its name.
        name: String,
        /// What is wrong.
        problem: String,
    },
    /// Its voxels are not a grid.
    #[error("structure `{name}` has {cause}")]
    Grid {
        /// Its name.
        name: String,
        /// What is wrong.
        cause: GridError,
    },
    /// It follows from the bone of a volume, but the scene has no volume.
    #[error("structure `{0}` needs a volume")]
    NoVolume(String),
}

impl Shape {
    /// Returns the shape of a scene's structure where the bone of `[truth]` is; `outside` is the distance
    /// from the outside of the bone.
    ///
    /// # Errors
    /// [`StructureError`]: its file has not been read, or it needs a volume.
    pub fn of(
        scene: &Scene,
        structure: &scene::Structure,
        outside: Option<&Arc<DistanceField>>,
    ) -> Result<Shape, StructureError> {
        let place_m = |point_mm: [f64; 3]| Vector3::from(scene.in_bone_mm(point_mm)) * 1e-3;
        let name = || structure.name.clone();
        let malformed = |problem: String| StructureError::Malformed { name: name(), problem };
        if let Some(ball) = &structure.ball {
            let points_m = vec![place_m(ball.centre_mm)];
            return Ok(Shape::Tube { points_m, radius_m: ball.radius_mm * 1e-3 });
        }
        if let Some(tube) = &structure.tube {
            let points_m = tube.points_mm.iter().copied().map(place_m).collect();
            return Ok(Shape::Tube { points_m, radius_m: tube.radius_mm * 1e-3 });
        }
        if let Some(cuboid) = &structure.cuboid {
            return Ok(placed_cuboid(scene, cuboid));
        }
        if let Some(label) = &structure.label {
            let voxels = label.voxels.as_ref().ok_or_else(|| StructureError::Unread(name()))?;
            let is_inside = voxels.is_inside().map_err(malformed)?;
            let field = label_grid(scene, voxels)
                .and_then(|grid| DistanceField::around(&grid, &is_inside, voxels.grown_by()))
                .map_err(|cause| StructureError::Grid { name: name(), cause })?;
            return Ok(Shape::Field { field, more_m: 0.0 });
        }
        if let Some(mesh) = &structure.mesh {
            let surface = mesh.surface.as_ref().ok_or_else(|| StructureError::Unread(name()))?;
            let mesh = surface.mesh().map_err(malformed)?;
            return Ok(Shape::Solid(Arc::new(Solid::new(&mesh, place_m))));
        }
        // The volume lies where the bone is.
        let field = Arc::clone(outside.ok_or_else(|| StructureError::NoVolume(name()))?);
        let thickness_mm = match structure.built_in {
            Some(BuiltInStructure::Cortex) => structure.thickness_mm.unwrap_or(0.0),
            _ => 0.0,
        };
        Ok(Shape::Field { field, more_m: thickness_mm * 1e-3 })
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
            Shape::Solid(solid) => solid.distance_m(point_m),
            Shape::Field { field, more_m } => field.distance_m(point_m) - more_m,
        }
    }

    /// Returns the largest change of the distance over the way of a point.
    pub fn steepness(&self) -> f64 {
        match self {
            Shape::Field { field, .. } => field.steepness(),
            _ => 1.0,
        }
    }
}

/// Returns the grid of a label's voxels where the bone is.
///
/// # Errors
/// The grid is not one.
pub fn label_grid(scene: &Scene, voxels: &StructureVoxels) -> Result<VoxelGrid, GridError> {
    let origin_m = scene.in_bone_mm(voxels.origin_mm).map(|x| x * 1e-3);
    let axes = voxels.axes.map(|axis| scene.turned_with_bone(axis));
    VoxelGrid::new(voxels.dims, voxels.spacing_mm.map(|x| x * 1e-3), origin_m, axes)
}

/// Returns a box where the bone is.
fn placed_cuboid(scene: &Scene, cuboid: &StructureCuboid) -> Shape {
    let turn_rad = Vector3::from(cuboid.rotation_vector_deg.map(f64::to_radians));
    let axes = UnitQuaternion::from_scaled_axis(turn_rad).to_rotation_matrix();
    let axis =
        |index: usize| Vector3::from(scene.turned_with_bone(axes.matrix().column(index).into_owned().into()));
    let turned = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[axis(0), axis(1), axis(2)]));
    let centre_m = Vector3::from(scene.in_bone_mm(cuboid.centre_mm)) * 1e-3;
    let t_world_cuboid =
        Isometry3::from_parts(Translation3::from(centre_m), UnitQuaternion::from_rotation_matrix(&turned));
    Shape::Cuboid { t_world_cuboid, half_m: Vector3::from(cuboid.half_extents_mm) * 1e-3 }
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
