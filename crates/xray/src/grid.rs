//! The CT's grid in the world, and the borrowed voxels.

use voxel_grid::{Volume, VoxelGrid};

use crate::error::DrrError;
use crate::vector::{Vec3, add_scaled, cross, dot, scale, sub};

/// Voxel geometry: voxel (i, j, k) has its centre at `origin_m + i s_x d_0 + j s_y d_1 + k s_z d_2` (world
/// LPS).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    dims: [usize; 3],
    spacing_m: Vec3,
    origin_m: Vec3,
    /// World vector from a voxel to its neighbour along each index axis.
    axis_steps_m: [Vec3; 3],
    /// Rows of the inverse of the index-to-world matrix, 1/m.
    world_to_index: [Vec3; 3],
}

impl Grid {
    /// A grid of `dims` voxels, x fastest in memory. `axes` are the unit world vectors of the index axes,
    /// `origin_m` is the centre of voxel (0, 0, 0).
    ///
    /// # Errors
    /// [`VoxelGrid`] refuses the grid.
    pub fn new(
        dims: [usize; 3],
        spacing_m: [f64; 3],
        origin_m: [f64; 3],
        axes: [[f64; 3]; 3],
    ) -> Result<Self, DrrError> {
        Ok(Self::from(VoxelGrid::new(dims, spacing_m, origin_m, axes)?))
    }

    /// A grid along the world axes.
    ///
    /// # Errors
    /// As [`Grid::new`].
    pub fn axis_aligned(dims: [usize; 3], spacing_m: [f64; 3], origin_m: [f64; 3]) -> Result<Self, DrrError> {
        Ok(Self::from(VoxelGrid::axis_aligned(dims, spacing_m, origin_m)?))
    }

    /// A grid along the world axes, centred on the world origin.
    ///
    /// # Errors
    /// As [`Grid::new`].
    pub fn centred(dims: [usize; 3], spacing_m: [f64; 3]) -> Result<Self, DrrError> {
        let origin_m = [0, 1, 2].map(|a| -0.5 * (dims[a] as f64 - 1.0) * spacing_m[a]);
        Self::axis_aligned(dims, spacing_m, origin_m)
    }

    /// Number of voxels along each index axis.
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Distance between voxel centres along each index axis.
    pub fn spacing_m(&self) -> [f64; 3] {
        self.spacing_m
    }

    /// World position of the centre of voxel (0, 0, 0).
    pub fn origin_m(&self) -> [f64; 3] {
        self.origin_m
    }

    /// Number of voxels.
    pub fn voxels(&self) -> usize {
        self.dims[0] * self.dims[1] * self.dims[2]
    }

    /// Distance in memory between neighbours along each index axis, in elements.
    pub fn strides(&self) -> [usize; 3] {
        [1, self.dims[0], self.dims[0] * self.dims[1]]
    }

    /// World vector from a voxel to its neighbour along each index axis.
    pub fn axis_steps_m(&self) -> [[f64; 3]; 3] {
        self.axis_steps_m
    }

    /// Voxel coordinates (i, j, k) of a linear index `i + nx (j + ny k)`.
    pub fn voxel_of(&self, linear: usize) -> [usize; 3] {
        let [nx, ny, _] = self.dims;
        [linear % nx, (linear / nx) % ny, linear / (nx * ny)]
    }

    /// Linear index of voxel (i, j, k), or `None` outside the volume.
    pub fn linear_of(&self, voxel: [usize; 3]) -> Option<usize> {
        let inside = voxel.iter().zip(&self.dims).all(|(v, n)| v < n);
        inside.then(|| voxel[0] + self.dims[0] * (voxel[1] + self.dims[1] * voxel[2]))
    }

    /// World position of a point in index coordinates (voxel centres at integers).
    pub fn index_to_world(&self, index: [f64; 3]) -> [f64; 3] {
        let mut p = self.origin_m;
        for (coordinate, step) in index.into_iter().zip(self.axis_steps_m) {
            p = add_scaled(p, coordinate, step);
        }
        p
    }

    /// Index coordinates of a world position.
    pub fn world_to_index(&self, p_m: [f64; 3]) -> [f64; 3] {
        self.vector_to_index(sub(p_m, self.origin_m))
    }

    /// Index-space components of a world displacement.
    pub fn vector_to_index(&self, d_m: [f64; 3]) -> [f64; 3] {
        self.world_to_index.map(|row| dot(row, d_m))
    }
}

impl From<VoxelGrid> for Grid {
    fn from(grid: VoxelGrid) -> Self {
        let (axes, spacing_m) = (grid.axes(), grid.spacing_m());
        let axis_steps_m = [0, 1, 2].map(|a| scale(axes[a], spacing_m[a]));
        Self {
            dims: grid.dims(),
            spacing_m,
            origin_m: grid.origin_m(),
            axis_steps_m,
            world_to_index: inverse_rows(axis_steps_m),
        }
    }
}

/// Rows of the inverse of the matrix whose columns are `c`.
fn inverse_rows(c: [Vec3; 3]) -> [Vec3; 3] {
    let det = dot(c[0], cross(c[1], c[2]));
    [
        scale(cross(c[1], c[2]), 1.0 / det),
        scale(cross(c[2], c[0]), 1.0 / det),
        scale(cross(c[0], c[1]), 1.0 / det),
    ]
}

impl<'a> TryFrom<&'a Volume> for VolumeView<'a> {
    type Error = DrrError;

    fn try_from(volume: &'a Volume) -> Result<Self, DrrError> {
        Self::new(Grid::from(volume.grid), &volume.hu)
    }
}

/// The CT in place: a grid and its borrowed Hounsfield units, x fastest.
#[derive(Debug, Clone, Copy)]
pub struct VolumeView<'a> {
    grid: Grid,
    hu: &'a [i16],
}

impl<'a> VolumeView<'a> {
    /// Borrows `hu` as the voxels of `grid`.
    ///
    /// # Errors
    /// The slice does not have exactly one value per voxel.
    pub fn new(grid: Grid, hu: &'a [i16]) -> Result<Self, DrrError> {
        if hu.len() != grid.voxels() {
            return Err(DrrError::Length { field: "hu", given: hu.len(), expected: grid.voxels() });
        }
        Ok(Self { grid, hu })
    }

    /// The grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The Hounsfield units, x fastest.
    pub fn hu(&self) -> &'a [i16] {
        self.hu
    }
}
