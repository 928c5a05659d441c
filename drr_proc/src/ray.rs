//! Rays from the source to pixel centres, in the world and in index space.

use crate::carm::CArm;
use crate::grid::Grid;
use crate::vector::{Vec3, add_scaled, norm, scale, sub};

/// A ray from the source (parameter 0) to a pixel centre (parameter 1), world metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldRay {
    /// The source.
    pub origin_m: [f64; 3],
    /// From the source to the pixel centre, not normalised.
    pub direction_m: [f64; 3],
    /// Length of `direction_m`.
    pub length_m: f64,
}

/// The same ray in index coordinates (voxel centres at whole numbers), with the same parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IndexRay {
    /// The source.
    pub origin: [f64; 3],
    /// From the source to the pixel centre.
    pub direction: [f64; 3],
    /// World length of the ray: parameter times this is a distance in metres.
    pub length_m: f64,
}

impl WorldRay {
    /// The ray between two world points.
    pub fn between(origin_m: [f64; 3], target_m: [f64; 3]) -> Self {
        let direction_m = sub(target_m, origin_m);
        Self { origin_m, direction_m, length_m: norm(direction_m) }
    }
}

impl IndexRay {
    /// A world ray seen in a grid's index coordinates.
    pub fn new(grid: &Grid, ray: &WorldRay) -> Self {
        Self {
            origin: grid.world_to_index(ray.origin_m),
            direction: grid.vector_to_index(ray.direction_m),
            length_m: ray.length_m,
        }
    }
}

/// All rays of a C-arm through a grid; any ray costs a few additions, and depends on its pixel only.
#[derive(Debug, Clone, Copy)]
pub struct RayFan {
    source_m: Vec3,
    first_m: Vec3,
    column_step_m: Vec3,
    row_step_m: Vec3,
    source_index: Vec3,
    first_index: Vec3,
    column_step_index: Vec3,
    row_step_index: Vec3,
}

impl RayFan {
    /// The rays of `c_arm` through `grid`.
    pub fn new(grid: &Grid, c_arm: &CArm) -> Self {
        let first_m = sub(c_arm.pixel_m(0.0, 0.0), c_arm.source_m);
        let column_step_m = scale(c_arm.row_axis, c_arm.pixel_pitch_m[0]);
        let row_step_m = scale(c_arm.column_axis, c_arm.pixel_pitch_m[1]);
        Self {
            source_m: c_arm.source_m,
            first_m,
            column_step_m,
            row_step_m,
            source_index: grid.world_to_index(c_arm.source_m),
            first_index: grid.vector_to_index(first_m),
            column_step_index: grid.vector_to_index(column_step_m),
            row_step_index: grid.vector_to_index(row_step_m),
        }
    }

    /// The ray of a pixel in the world.
    pub fn world_ray(&self, column: u32, row: u32) -> WorldRay {
        let in_row = add_scaled(self.first_m, f64::from(column), self.column_step_m);
        let direction_m = add_scaled(in_row, f64::from(row), self.row_step_m);
        WorldRay { origin_m: self.source_m, direction_m, length_m: norm(direction_m) }
    }

    /// The ray of a pixel in index coordinates.
    pub fn index_ray(&self, column: u32, row: u32) -> IndexRay {
        self.index_ray_of(column, row, &self.world_ray(column, row))
    }

    /// The ray of a pixel in index coordinates, given the same ray in the world.
    pub(crate) fn index_ray_of(&self, column: u32, row: u32, ray: &WorldRay) -> IndexRay {
        let in_row = add_scaled(self.first_index, f64::from(column), self.column_step_index);
        let direction = add_scaled(in_row, f64::from(row), self.row_step_index);
        IndexRay { origin: self.source_index, direction, length_m: ray.length_m }
    }
}
