//! The bone with removals applied, and its surface on the board.

use ipc_types::messages::Removed;
use voxel_grid::VoxelGrid;

use super::field::{Field, Voxel};
use super::nets::Blocks;
use crate::board::Board;
use crate::channels::SURFACE;
use crate::info::VolumeBox;

/// Number of blocks meshed per call, so that other work gets its turn.
const BLOCKS_AT_ONCE: usize = 64;

/// Voxels, blocks, and the predrilled voxels.
#[derive(Debug, Clone)]
pub struct Bone {
    field: Field,
    blocks: Blocks,
    predrilled: Vec<u32>,
}

impl Bone {
    /// Undrilled bone, with nothing meshed yet.
    pub fn new(grid: VoxelGrid, threshold_hu: i16) -> Bone {
        Bone { field: Field::new(grid, threshold_hu), blocks: Blocks::new(&grid), predrilled: Vec::new() }
    }

    /// The voxels.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// Applies a removal.
    pub fn apply(&mut self, removed: &Removed, voxels: &[u32]) {
        if removed.tick == 0 {
            self.predrilled.extend_from_slice(voxels);
        }
        if removed.restore_first != 0 {
            self.restore();
        }
        voxels.iter().for_each(|index| self.set(*index, Voxel::Removed));
    }

    /// Restores all voxels except the predrilled ones.
    pub fn restore(&mut self) {
        let predrilled = self.predrilled.clone();
        self.field.removed().into_iter().for_each(|index| self.set(index, Voxel::Present));
        predrilled.into_iter().for_each(|index| self.set(index, Voxel::Removed));
    }

    /// Removes or restores a voxel and marks the blocks around it for meshing.
    pub fn set(&mut self, index: u32, voxel: Voxel) {
        if self.field.set(index, voxel)
            && let Some(voxel) = self.field.grid().voxel(index as usize)
        {
            self.blocks.touch(voxel);
        }
    }

    /// Meshes some of the changed blocks and publishes them. Returns whether more are pending.
    pub fn publish(&mut self, hu: &[i16], board: &Board) -> bool {
        for mesh in self.blocks.mesh_changed(&self.field, hu, BLOCKS_AT_ONCE) {
            board.publish(SURFACE, board.time_ns(), mesh.block, mesh.bytes());
        }
        self.blocks.changed_count() > 0
    }
}

/// Bounding box of a grid's voxels.
pub fn volume_box(grid: &VoxelGrid) -> VolumeBox {
    let last = grid.dims().map(|n| n as f64 - 0.5);
    let corner = |i: usize| {
        grid.world_m(core::array::from_fn(|axis| if i >> axis & 1 == 1 { last[axis] } else { -0.5 }))
    };
    let (mut min_m, mut max_m) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for point in (0..8).map(corner) {
        for axis in 0..3 {
            min_m[axis] = min_m[axis].min(point[axis]);
            max_m[axis] = max_m[axis].max(point[axis]);
        }
    }
    VolumeBox { min_m, max_m, spacing_m: grid.spacing_m() }
}
