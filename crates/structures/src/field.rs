//! A signed distance sampled on the grid of a volume.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use nalgebra::Vector3;
use voxel_grid::distance::squared_distance_m2;
use voxel_grid::{GridError, VoxelGrid};
use xxhash_rust::xxh3::Xxh3;

/// The signed distance from the surface of a set of voxels, at their centres, m; interpolated between them.
///
/// From the exact Euclidean distance transform ([`squared_distance_m2`]): of a voxel centre outside the set
/// to the nearest one inside, and the reverse. The surface lies halfway between two such centres, so each
/// distance is shorter by half a voxel; where voxels are not cubes, by half their shortest edge.
#[derive(Debug, Clone, PartialEq)]
pub struct DistanceField {
    grid: VoxelGrid,
    /// Signed distance of each voxel centre, m, x fastest.
    distance_m: Vec<f32>,
    steepness: f64,
    /// Distance of the surface from the centres on its two sides, m.
    half_m: f64,
    /// Whether the set does not reach the grid's faces.
    is_enclosed: bool,
}

/// The fields in use, by the hash of what they were computed from: simulations of the same scene share them.
static IN_USE: Mutex<Vec<(u128, Weak<DistanceField>)>> = Mutex::new(Vec::new());

impl DistanceField {
    /// Samples the distance from the voxels where `is_inside` holds. `is_inside` has one value for each voxel
    /// of the grid, x fastest.
    pub fn new(grid: &VoxelGrid, is_inside: &[bool]) -> DistanceField {
        let (dims, spacing_m) = (grid.dims(), grid.spacing_m());
        let from_inside = squared_distance_m2(dims, spacing_m, is_inside);
        let is_outside: Vec<bool> = is_inside.iter().map(|is_inside| !is_inside).collect();
        let from_outside = squared_distance_m2(dims, spacing_m, &is_outside);
        // The surface is halfway between the centres on its two sides.
        let exact_half_m = 0.5 * spacing_m.into_iter().fold(f64::INFINITY, f64::min);
        let half_m = exact_half_m as f32;
        let signed = |((is_inside, to_inside), to_outside): ((&bool, f32), f32)| {
            if *is_inside { half_m - to_outside.sqrt() } else { to_inside.sqrt() - half_m }
        };
        let distance_m: Vec<f32> = is_inside.iter().zip(from_inside).zip(from_outside).map(signed).collect();
        let steepness = steepness(dims, spacing_m, &distance_m);
        let is_at_face = |index: usize| {
            let voxel = [index % dims[0], index / dims[0] % dims[1], index / (dims[0] * dims[1])];
            (0..3).any(|axis| voxel[axis] == 0 || voxel[axis] + 1 == dims[axis])
        };
        let is_enclosed = !is_inside.iter().enumerate().any(|(index, inside)| *inside && is_at_face(index));
        DistanceField { grid: *grid, distance_m, steepness, half_m: exact_half_m, is_enclosed }
    }

    /// As [`DistanceField::new`], but shares a field that is still in use and was computed from the same.
    pub fn shared(grid: &VoxelGrid, is_inside: &[bool]) -> Arc<DistanceField> {
        let key = key(grid, is_inside);
        // Whoever panicked while holding the lock left a valid list.
        let mut in_use = IN_USE.lock().unwrap_or_else(PoisonError::into_inner);
        in_use.retain(|(_, field)| field.strong_count() > 0);
        let same = in_use.iter().find(|(other, _)| *other == key);
        if let Some(field) = same.and_then(|(_, field)| field.upgrade()) {
            return field;
        }
        let field = Arc::new(DistanceField::new(grid, is_inside));
        in_use.push((key, Arc::downgrade(&field)));
        field
    }

    /// As [`DistanceField::shared`], on a grid with more voxels before and behind along each axis, all
    /// outside: there, distances from the set are exact, too.
    ///
    /// # Errors
    /// The grid has too many voxels.
    pub fn around(
        grid: &VoxelGrid,
        is_inside: &[bool],
        more: [usize; 3],
    ) -> Result<Arc<DistanceField>, GridError> {
        let (dims, spacing_m) = (grid.dims(), grid.spacing_m());
        let wide = [0, 1, 2].map(|axis| dims[axis].saturating_add(more[axis].saturating_mul(2)));
        let origin_m = grid.world_m(more.map(|count| -(count as f64)));
        let grid = VoxelGrid::new(wide, spacing_m, origin_m, grid.axes())?;
        let mut inside = vec![false; grid.voxel_count()];
        for (row, voxels) in is_inside.chunks_exact(dims[0]).enumerate() {
            let (j, k) = (row % dims[1] + more[1], row / dims[1] + more[2]);
            let begin = (k * wide[1] + j) * wide[0] + more[0];
            inside[begin..begin + dims[0]].copy_from_slice(voxels);
        }
        Ok(DistanceField::shared(&grid, &inside))
    }

    /// Returns the largest change of the distance over the way of a point. More than 1: between samples, the
    /// slopes along the axes may add up.
    pub fn steepness(&self) -> f64 {
        self.steepness
    }

    /// Returns the distance of a point from the surface, m, negative inside.
    ///
    /// Outside the grid, the nearest point of the grid counts, and the distance to it. If the set does not
    /// reach the grid's faces, the two distances are the legs of a right triangle, whose hypotenuse is a
    /// lower bound of the distance from the set. A set that does reach them goes on beyond: the distance to
    /// the grid is subtracted.
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
        if beyond_m2 == 0.0 {
            within_m
        } else if self.is_enclosed {
            let from_centres_m = within_m + self.half_m;
            libm::sqrt(from_centres_m * from_centres_m + beyond_m2) - self.half_m
        } else {
            within_m - libm::sqrt(beyond_m2)
        }
    }
}

/// Returns the length of the vector of the largest slopes along the axes, each at least 1: beyond the grid,
/// the distance may change by as much as a point moves.
fn steepness(dims: [usize; 3], spacing_m: [f64; 3], distance_m: &[f32]) -> f64 {
    let strides = [1, dims[0], dims[0] * dims[1]];
    let slope = |axis: usize| {
        let stride = strides[axis];
        let has_next = |index: &usize| index / stride % dims[axis] + 1 < dims[axis];
        let change = |index: usize| (distance_m[index + stride] - distance_m[index]).abs();
        let most = (0..distance_m.len()).filter(has_next).map(change).fold(0.0_f32, f32::max);
        // A volume that is all inside or all outside has infinite distances, which do not change.
        if most.is_finite() { (f64::from(most) / spacing_m[axis]).max(1.0) } else { 1.0 }
    };
    // Rounding of the interpolation, relative.
    let rounding = 1.0 + 1e-6;
    rounding * libm::sqrt([0, 1, 2].map(slope).into_iter().map(|slope| slope * slope).sum())
}

fn key(grid: &VoxelGrid, is_inside: &[bool]) -> u128 {
    let mut hasher = Xxh3::new();
    grid.dims().iter().for_each(|count| hasher.update(&count.to_le_bytes()));
    let placement =
        grid.spacing_m().into_iter().chain(grid.origin_m()).chain(grid.axes().into_iter().flatten());
    placement.for_each(|x| hasher.update(&x.to_bits().to_le_bytes()));
    for voxels in is_inside.chunks(64) {
        let bit = |(at, is_inside): (usize, &bool)| u64::from(*is_inside) << at;
        hasher.update(&voxels.iter().enumerate().map(bit).sum::<u64>().to_le_bytes());
    }
    hasher.digest128()
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
            prop_assert!(change_m.abs() <= BALL.steepness() * moved.norm() + 1e-9);
        }
    }

    /// A plane between two layers of voxels: exact at every depth; 5 mm beyond the grid, 5 mm less.
    #[test]
    fn the_distance_from_a_plane_is_exact() {
        let half = field(|point| point.x < 0.1e-3);
        // The layers at 0 and 0.5 mm are its two sides.
        for (x_mm, expected_mm) in
            [(-8.0, -8.25), (-1.3, -1.55), (0.0, -0.25), (0.7, 0.45), (9.0, 8.75), (15.0, 4.75)]
        {
            let found_m = half.distance_m(&Vector3::new(x_mm * 1e-3, 1e-3, -2e-3));
            assert!((found_m - expected_mm * 1e-3).abs() < 1e-8, "{x_mm}: {found_m}");
        }
        assert!((half.distance_m(&Vector3::new(-15e-3, 0.0, 0.0)) + 15.25e-3).abs() < 1e-8);
    }

    /// A field on a part of a grid with space around it is that of the whole grid, and both are shared.
    #[test]
    fn a_field_around_a_part_is_that_of_the_whole() {
        let is_inside =
            |[i, j, k]: [usize; 3]| (8..12).contains(&i) && (5..9).contains(&j) && (7..20).contains(&k);
        let (dims, low) = ([30, 24, 28], [8, 5, 7]);
        let voxels = |dims: [usize; 3], low: [usize; 3]| -> Vec<bool> {
            let voxel =
                |index: usize| [index % dims[0], index / dims[0] % dims[1], index / (dims[0] * dims[1])];
            let at = |index: usize| [0, 1, 2].map(|axis| voxel(index)[axis] + low[axis]);
            (0..dims.iter().product()).map(|index| is_inside(at(index))).collect()
        };
        let whole_grid = VoxelGrid::axis_aligned(dims, SPACING_M, [0.0; 3]).unwrap();
        let whole = DistanceField::new(&whole_grid, &voxels(dims, [0; 3]));
        let origin_m = whole_grid.world_m(low.map(|x| x as f64));
        let part_grid = VoxelGrid::axis_aligned([4, 4, 13], SPACING_M, origin_m).unwrap();
        let part = DistanceField::around(&part_grid, &voxels([4, 4, 13], low), [5, 5, 7]).unwrap();
        let again = DistanceField::around(&part_grid, &voxels([4, 4, 13], low), [5, 5, 7]).unwrap();
        assert!(Arc::ptr_eq(&part, &again));
        for point_mm in [[5.0, 4.0, 10.0], [2.0, 1.0, 3.0], [4.3, 3.1, 5.7], [7.9, 6.0, 20.0]] {
            let point_m = Vector3::from(point_mm) * 1e-3;
            let (expected_m, found_m) = (whole.distance_m(&point_m), part.distance_m(&point_m));
            assert!((expected_m - found_m).abs() < 1e-8, "{point_mm:?}: {found_m}, expected {expected_m}");
        }
    }

    proptest! {
        /// Beyond the grid, the distance from a set of voxels is never overstated, and by no more than what
        /// the triangle's legs leave out.
        #[test]
        fn a_distance_beyond_the_grid_is_a_lower_bound(place_mm in [-60.0..60.0, -60.0..60.0, -60.0..60.0_f64]) {
            let grid = VoxelGrid::axis_aligned([4; 3], [1e-3; 3], [0.0; 3]).unwrap();
            // Two opposite corners of the part.
            let is_inside: Vec<bool> = (0..64).map(|index| index == 0 || index == 63).collect();
            let field = DistanceField::around(&grid, &is_inside, [6; 3]).unwrap();
            let point_m = Vector3::from(place_mm) * 1e-3;
            let exact_m = point_m.norm().min((point_m - Vector3::repeat(3e-3)).norm()) - 0.5e-3;
            let found_m = field.distance_m(&point_m);
            // Between samples, the interpolation is off by up to a voxel's diagonal.
            prop_assert!(found_m <= exact_m + 0.9e-3, "{found_m}, at most {exact_m}");
            prop_assert!(found_m >= exact_m / 2.0_f64.sqrt() - 1.8e-3, "{found_m}, exact {exact_m}");
        }
    }
}
