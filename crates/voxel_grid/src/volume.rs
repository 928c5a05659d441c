//! The voxels of a CT on their grid, and the CT with its identity.

use crate::VoxelGrid;
use crate::sample::{self, holds};

/// Hounsfield units on a grid: voxel (i, j, k) is `hu[i + ni * (j + nj * k)]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    /// The voxel grid.
    pub grid: VoxelGrid,
    /// Hounsfield units, i fastest, one for each voxel of the grid.
    pub hu: Vec<i16>,
}

impl Volume {
    /// Hounsfield units of voxel (i, j, k); `None` outside the volume.
    pub fn at(&self, voxel: [usize; 3]) -> Option<i16> {
        self.grid.index(voxel).and_then(|index| self.hu.get(index).copied())
    }

    /// Returns true if a world position lies in the volume's box, up to the outer voxel faces.
    pub fn holds(&self, world_m: [f64; 3]) -> bool {
        holds(self.grid.dims(), self.grid.voxel_at(world_m))
    }

    /// Hounsfield units at a world position (LPS, metres): trilinear between the eight surrounding voxel
    /// centres, clamped to the nearest centre beyond the outermost ones. `None` outside the volume's box.
    pub fn hu_at(&self, world_m: [f64; 3]) -> Option<f64> {
        sample::hu_at(self.grid.dims(), &self.hu, self.grid.voxel_at(world_m))
    }
}

/// A CT volume and its hash: the same description from the reader to shared memory and the simulation.
#[derive(Clone, Debug, PartialEq)]
pub struct Ct {
    /// Grid and voxels.
    pub volume: Volume,
    /// SHA-256 of both.
    pub sha256: [u8; 32],
}
