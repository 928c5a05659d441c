//! A signed distance sampled on the grid of a volume.

use nalgebra::Vector3;
use voxel_grid::VoxelGrid;
use voxel_grid::distance::squared_distance_m2;

/// The signed distance from the surface of a set of voxels, at their centres, m; interpolated between them.
///
/// From the exact Euclidean distance transform ([`squared_distance_m2`]): of a voxel centre outside the set
/// to the nearest one inside, and the reverse. The surface lies halfway between two such centres, so each
/// distance is shorter by half a voxel; where voxels are not cubes, by half their shortest edge.
#[derive(Debug, Clone)]
pub struct DistanceField {
    grid: VoxelGrid,
    /// Signed distance of each voxel centre, m, x fastest.
    distance_m: Vec<f32>,
}

impl DistanceField {
    /// Samples the distance from the voxels where `is_inside` holds. `is_inside` has one value for each voxel
    /// of the grid, x fastest.
    pub fn new(grid: &VoxelGrid, is_inside: &[bool]) -> DistanceField {
        let (dims, spacing_m) = (grid.dims(), grid.spacing_m());
        let from_inside = squared_distance_m2(dims, spacing_m, is_inside);
        let is_outside: Vec<bool> = is_inside.iter().map(|is_inside| !is_inside).collect();
        let from_outside = squared_distance_m2(dims, spacing_m, &is_outside);
        // The surface is halfway between the centres on its two sides.
        let half_m = 0.5 * spacing_m.into_iter().fold(f64::INFINITY, f64::min) as f32;
        let signed = |((is_inside, to_inside), to_outside): ((&bool, f32), f32)| {
            if *is_inside { half_m - to_outside.sqrt() } else { to_inside.sqrt() - half_m }
        };
        let distance_m = is_inside.iter().zip(from_inside).zip(from_outside).map(signed).collect();
        DistanceField { grid: *grid, distance_m }
    }

    /// Returns the distance of a point from the surface, m, negative inside. Outside the grid: that of the
    /// nearest point of the grid, less the distance to it if that is inside, and more if it is outside.
    pub fn distance_m(&self, point_m: &Vector3<f64>) -> f64 {
        let (dims, spacing_m) = (self.grid.dims(), self.grid.spacing_m());
        let voxel = self.grid.voxel_at((*point_m).into());
        let (mut low, mut share, mut beyond_m2) = ([0; 3], [0.0; 3], 0.0);
        for axis in 0..3 {
            let last = (dims[axis] - 1) as f64;
            let at = voxel[axis].clamp(0.0, last);
            let beyond_m = (voxel[axis] - at) * spacing_m[axis];
            beyond_m2 += beyond_m * beyond_m;
            let floor = (at as usize).min(dims[axis].saturating_sub(2));
            (low[axis], share[axis]) = (floor, at - floor as f64);
        }
        let along = |axis: usize| usize::from(dims[axis] > 1);
        let value = |i: usize, j: usize, k: usize| {
            let at = ((low[2] + k) * dims[1] + low[1] + j) * dims[0] + low[0] + i;
            f64::from(self.distance_m[at])
        };
        let row = |j: usize, k: usize| {
            let (a, b) = (value(0, j, k), value(along(0), j, k));
            a + share[0] * (b - a)
        };
        let plane = |k: usize| {
            let (a, b) = (row(0, k), row(along(1), k));
            a + share[1] * (b - a)
        };
        let (a, b) = (plane(0), plane(along(2)));
        let within_m = a + share[2] * (b - a);
        let beyond_m = libm::sqrt(beyond_m2);
        if within_m < 0.0 { within_m - beyond_m } else { within_m + beyond_m }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const N: usize = 41;
    const SPACING_M: [f64; 3] = [0.5e-3, 0.6e-3, 0.8e-3];

    fn grid() -> VoxelGrid {
        VoxelGrid::axis_aligned([N; 3], SPACING_M, SPACING_M.map(|h| -0.5 * h * (N - 1) as f64)).unwrap()
    }

    fn field(is_inside: impl Fn(Vector3<f64>) -> bool) -> DistanceField {
        let grid = grid();
        let centre = |index: usize| {
            let voxel = [index % N, index / N % N, index / (N * N)];
            Vector3::from([0, 1, 2].map(|a| grid.origin_m()[a] + voxel[a] as f64 * SPACING_M[a]))
        };
        DistanceField::new(
            &grid,
            &(0..N * N * N).map(|index| is_inside(centre(index))).collect::<Vec<bool>>(),
        )
    }

    proptest! {
        /// The distance from a ball of 6 mm is that of its closed form to within a voxel, and nowhere changes
        /// faster than the point moves.
        #[test]
        fn the_distance_from_a_ball_is_its_closed_form(
            place in [-9.0..9.0, -9.0..9.0, -9.0..9.0_f64],
            step in [-1.0..1.0, -1.0..1.0, -1.0..1.0_f64],
        ) {
            use std::sync::LazyLock;
            static BALL: LazyLock<DistanceField> = LazyLock::new(|| field(|point| point.norm() < 6e-3));
            let point = Vector3::from(place) * 1e-3;
            let found_m = BALL.distance_m(&point);
            prop_assert!((found_m - (point.norm() - 6e-3)).abs() < 0.8e-3, "{found_m}");
            let moved = Vector3::from(step) * 1e-3;
            let change_m = BALL.distance_m(&(point + moved)) - found_m;
            // Interpolated between samples whose slope along an axis is at most 1.
            prop_assert!(change_m.abs() <= moved.iter().map(|x| x.abs()).sum::<f64>() + 1e-6);
        }
    }

    /// A plane between two layers of voxels: exact at every depth, and beyond the grid.
    #[test]
    fn the_distance_from_a_plane_is_exact() {
        let half = field(|point| point.x < 0.1e-3);
        // The layers at 0 and 0.5 mm are its two sides.
        for x_mm in [-8.0, -1.3, 0.0, 0.25, 0.7, 9.0, 15.0] {
            let found_m = half.distance_m(&Vector3::new(x_mm * 1e-3, 1e-3, -2e-3));
            assert!((found_m - (x_mm - 0.25) * 1e-3).abs() < 1e-8, "{x_mm}: {found_m}");
        }
    }
}
