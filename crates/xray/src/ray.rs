//! Rays from the source to pixel centres, in the world and in index space.

use crate::carm::{CArm, PixelBox};
use crate::grid::Grid;
use crate::vector::{Vec3, add_scaled, cross, dot, norm, scale, sub};

/// A pixel of the detector.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pixel {
    pub column: u32,
    pub row: u32,
}

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

/// The same ray in index coordinates (voxel centres at integers), with the same parameter.
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
    /// A world ray in a grid's index coordinates.
    pub fn new(grid: &Grid, ray: &WorldRay) -> Self {
        Self {
            origin: grid.world_to_index(ray.origin_m),
            direction: grid.vector_to_index(ray.direction_m),
            length_m: ray.length_m,
        }
    }
}

/// All rays of a C-arm through a grid. A ray costs a few additions and depends only on its pixel, not on
/// other rays.
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

    /// A pixel's ray in the world.
    pub fn world_ray(&self, column: u32, row: u32) -> WorldRay {
        let in_row = add_scaled(self.first_m, f64::from(column), self.column_step_m);
        let direction_m = add_scaled(in_row, f64::from(row), self.row_step_m);
        WorldRay { origin_m: self.source_m, direction_m, length_m: norm(direction_m) }
    }

    /// World directions and lengths of a row's rays, starting at a pixel: the same bits as
    /// [`RayFan::world_ray`].
    #[inline(always)]
    pub(crate) fn world_rays_of_row(&self, first: Pixel, direction_m: [&mut [f64]; 3], length_m: &mut [f64]) {
        let (count, row) = (length_m.len(), first.row);
        let [x, y, z] = direction_m.map(|values| &mut values[..count]);
        for i in 0..count {
            let in_row = add_scaled(self.first_m, f64::from(first.column + i as u32), self.column_step_m);
            let d = add_scaled(in_row, f64::from(row), self.row_step_m);
            (x[i], y[i], z[i]) = (d[0], d[1], d[2]);
            length_m[i] = norm(d);
        }
    }

    /// A pixel's ray in index coordinates.
    pub fn index_ray(&self, column: u32, row: u32) -> IndexRay {
        self.index_ray_of(column, row, &self.world_ray(column, row))
    }

    /// A pixel's ray in index coordinates, given the same ray in the world.
    pub(crate) fn index_ray_of(&self, column: u32, row: u32, ray: &WorldRay) -> IndexRay {
        let direction = self.index_direction(column, row);
        IndexRay { origin: self.source_index, direction, length_m: ray.length_m }
    }

    /// The source in the world.
    pub(crate) fn source_m(&self) -> Vec3 {
        self.source_m
    }

    /// The source in index coordinates.
    pub(crate) fn source_index(&self) -> Vec3 {
        self.source_index
    }

    /// Index directions of the rays to the four corner pixels of a rectangle of the detector.
    pub(crate) fn corner_directions(&self, pixels: &PixelBox) -> [Vec3; 4] {
        let (c0, r0) = (pixels.columns.0, pixels.rows.0);
        let [c1, r1] = [pixels.columns.1, pixels.rows.1].map(|n| n.saturating_sub(1));
        [(c0, r0), (c1, r0), (c0, r1), (c1, r1)].map(|(column, row)| self.index_direction(column, row))
    }

    /// Covector n in index space with n . d = 1 for every vector d from the source to the detector's plane.
    pub(crate) fn detector_normal(&self) -> Vec3 {
        let normal = cross(self.column_step_index, self.row_step_index);
        scale(normal, 1.0 / dot(self.first_index, normal))
    }

    /// Index direction of a pixel's ray.
    #[inline]
    pub(crate) fn index_direction(&self, column: u32, row: u32) -> Vec3 {
        let in_row = add_scaled(self.first_index, f64::from(column), self.column_step_index);
        add_scaled(in_row, f64::from(row), self.row_step_index)
    }

    /// True if these points, in index coordinates, lie on the source's side of the detector plane.
    pub(crate) fn is_before_detector(&self, points: &[Vec3]) -> bool {
        let normal = cross(self.column_step_index, self.row_step_index);
        let plane = dot(self.first_index, normal);
        // The quotient is the ray parameter of the plane through the point parallel to the detector.
        points.iter().all(|p| dot(sub(*p, self.source_index), normal) / plane <= 1.0)
    }

    /// The rays of one detector row.
    pub(crate) fn row_steps(&self, row: u32) -> RowRays {
        let row = f64::from(row);
        RowRays {
            first_index: add_scaled(self.first_index, row, self.row_step_index),
            first_m: add_scaled(self.first_m, row, self.row_step_m),
            step_index: self.column_step_index,
            step_m: self.column_step_m,
        }
    }

    /// Pixel coordinates (column, row) of this index direction; `None` level with or behind the source.
    pub(crate) fn pixel_of(&self, direction: Vec3) -> Option<[f64; 2]> {
        let (c, r, f) = (self.column_step_index, self.row_step_index, self.first_index);
        let plane = dot(f, cross(c, r));
        // direction = depth (f + column c + row r), by Cramer's rule.
        let depth = dot(direction, cross(c, r)) / plane;
        let pixel =
            [dot(direction, cross(r, f)) / plane / depth, dot(direction, cross(f, c)) / plane / depth];
        (depth > 0.0 && pixel.iter().all(|p| p.is_finite())).then_some(pixel)
    }
}

/// The rays of one detector row; gives the index and world direction for each column.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RowRays {
    first_index: Vec3,
    first_m: Vec3,
    step_index: Vec3,
    step_m: Vec3,
}

impl RowRays {
    /// Index direction along an axis: at the first column, and for each further one.
    #[inline(always)]
    pub(crate) fn index(&self, axis: usize) -> (f64, f64) {
        (self.first_index[axis], self.step_index[axis])
    }

    /// The same of the world direction, metres.
    #[inline(always)]
    pub(crate) fn world_m(&self, axis: usize) -> (f64, f64) {
        (self.first_m[axis], self.step_m[axis])
    }
}
