//! Geometry of a CT's voxel grid: dimensions, spacing, direction and origin, in the patient frame.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use voxel_grid::VoxelGrid;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::BoneError;

/// Linear index of a voxel in memory order, x fastest. Messages and keyframes identify voxels by it.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    FromBytes,
    IntoBytes,
    Immutable,
    KnownLayout,
)]
#[repr(transparent)]
pub struct VoxelIndex(u32);

const _: () = assert!(voxel_grid::MAX_VOXELS <= u32::MAX as usize, "every voxel index fits into u32");

impl VoxelIndex {
    /// Returns the voxel with this index.
    pub fn new(number: u32) -> Self {
        Self(number)
    }

    /// Returns the index as a number.
    #[inline]
    pub fn number(self) -> u32 {
        self.0
    }

    /// Returns the position of the voxel's value in the CT.
    #[inline]
    pub fn at(self) -> usize {
        self.0 as usize
    }

    /// Returns a slice of indices as plain numbers.
    pub fn numbers(many: &[Self]) -> &[u32] {
        zerocopy::transmute_ref!(many)
    }
}

/// A uniform voxel grid in the world frame (patient frame, LPS, metres). Voxel (i, j, k) is the box of size
/// `spacing_m` about its centre `origin + direction * (i dx, j dy, k dz)`; x is fastest in memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridGeometry {
    /// Number of voxels along x, y, z.
    pub dims: [usize; 3],
    /// Voxel size along x, y, z in metres.
    pub spacing_m: [f64; 3],
    /// R_world_grid: column a is the world direction of grid axis a. Orthonormal; a mirrored grid is allowed.
    pub direction_world_grid: Matrix3<f64>,
    /// World position of the centre of voxel (0, 0, 0) in metres.
    pub origin_world_m: Vector3<f64>,
}

impl GridGeometry {
    /// Returns an unrotated grid.
    pub fn axis_aligned(dims: [usize; 3], spacing_m: [f64; 3], origin_world_m: Vector3<f64>) -> Self {
        Self { dims, spacing_m, direction_world_grid: Matrix3::identity(), origin_world_m }
    }

    /// Returns the number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.dims[0] * self.dims[1] * self.dims[2]
    }

    /// Returns the volume of one voxel in cubic metres.
    pub fn voxel_volume_m3(&self) -> f64 {
        self.spacing_m[0] * self.spacing_m[1] * self.spacing_m[2]
    }

    /// Returns the smallest voxel edge in metres.
    pub(super) fn smallest_spacing_m(&self) -> f64 {
        self.spacing_m.iter().fold(f64::INFINITY, |low, h| low.min(*h))
    }

    /// Returns the linear index of a voxel, x fastest.
    pub fn linear_index(&self, i: usize, j: usize, k: usize) -> usize {
        (k * self.dims[1] + j) * self.dims[0] + i
    }

    /// Returns the linear index of a voxel of the grid, as a [`VoxelIndex`].
    #[inline]
    pub fn index(&self, [i, j, k]: [usize; 3]) -> VoxelIndex {
        VoxelIndex(self.linear_index(i, j, k) as u32)
    }

    /// Returns the inverse of the linear index.
    #[inline]
    pub fn voxel(&self, index: VoxelIndex) -> [usize; 3] {
        let [nx, ny, _] = self.dims;
        let index = index.at();
        [index % nx, (index / nx) % ny, index / (nx * ny)]
    }

    /// Returns the centre of a voxel in the grid's metric frame, metres.
    #[inline]
    pub(super) fn voxel_position(&self, voxel: [i64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|a| voxel[a] as f64 * self.spacing_m[a])
    }

    /// Returns the world position of a voxel's centre in metres.
    pub fn voxel_centre_world_m(&self, i: usize, j: usize, k: usize) -> Vector3<f64> {
        let [dx, dy, dz] = self.spacing_m;
        self.point_to_world(&Vector3::new(i as f64 * dx, j as f64 * dy, k as f64 * dz))
    }

    /// Transforms a world point into the grid's metric frame: origin at voxel (0, 0, 0), axes along the grid,
    /// metres.
    pub fn point_to_grid(&self, point_world_m: &Vector3<f64>) -> Vector3<f64> {
        self.direction_world_grid.tr_mul(&(point_world_m - self.origin_world_m))
    }

    /// Returns the inverse of [`Self::point_to_grid`].
    pub fn point_to_world(&self, point_grid_m: &Vector3<f64>) -> Vector3<f64> {
        self.origin_world_m + self.direction_world_grid * point_grid_m
    }

    /// Returns the grid after validation, with perpendicular axes, as [`VoxelGrid`] requires.
    pub(super) fn validated(self) -> Result<Self, BoneError> {
        let axes = [0, 1, 2].map(|axis| self.direction_world_grid.column(axis).into_owned().into());
        let grid = VoxelGrid::new(self.dims, self.spacing_m, self.origin_world_m.into(), axes)?;
        Ok(GridGeometry::from(&grid))
    }
}

impl From<&VoxelGrid> for GridGeometry {
    fn from(grid: &VoxelGrid) -> Self {
        Self {
            dims: grid.dims(),
            spacing_m: grid.spacing_m(),
            direction_world_grid: Matrix3::from_columns(&grid.axes().map(Vector3::from)),
            origin_world_m: Vector3::from(grid.origin_m()),
        }
    }
}

/// Returns the floor as an integer, saturating. `f64::floor` is a library call without SSE4.1.
#[inline]
pub(super) fn floor_to_i64(x: f64) -> i64 {
    let truncated = x as i64;
    if (truncated as f64) > x { truncated - 1 } else { truncated }
}
