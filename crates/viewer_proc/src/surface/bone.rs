//! The bone with removals applied, and its surface on the board.

use ipc_types::messages::Removed;
use voxel_grid::VoxelGrid;

use super::coarse::CoarseBone;
use super::field::{Field, Voxel};
use super::nets::Blocks;
use crate::board::Board;
use crate::channels::{COARSE_SURFACE, SURFACE};
use crate::info::VolumeBox;

/// Number of blocks meshed per call, so that other work gets its turn.
const BLOCKS_AT_ONCE: usize = 64;

/// Voxels, blocks, and the predrilled voxels.
#[derive(Debug, Clone)]
pub struct Bone {
    field: Field,
    blocks: Blocks,
    coarse: Option<CoarseBone>,
    predrilled: Vec<u32>,
}

impl Bone {
    /// Undrilled bone, with nothing meshed yet.
    pub fn new(grid: VoxelGrid, threshold_hu: i16) -> Bone {
        Bone {
            field: Field::new(grid, threshold_hu),
            blocks: Blocks::new(&grid),
            coarse: CoarseBone::new(&grid, threshold_hu).ok(),
            predrilled: Vec::new(),
        }
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
            self.coarse.iter_mut().for_each(|coarse| coarse.touch(voxel));
        }
    }

    /// Meshes some of the changed blocks and publishes them, the coarse ones first, the others only if a
    /// client wants them. Returns whether more are pending.
    pub fn publish(&mut self, hu: &[i16], board: &Board) -> bool {
        if let Some(coarse) = &mut self.coarse {
            coarse.update(&self.field, hu);
            for mesh in coarse.mesh_changed() {
                board.publish(COARSE_SURFACE, board.time_ns(), mesh.block, mesh.bytes());
            }
        }
        if !board.wants(SURFACE) {
            return false;
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::Channels;
    use crate::protocol::Subscription;

    /// Regression: without a graphics card the first picture waited for half a million triangles.
    #[test]
    fn the_coarse_surface_is_there_at_once_and_the_fine_one_only_for_a_client_that_wants_it() {
        let grid = VoxelGrid::axis_aligned([100; 3], [1e-3; 3], [0.0; 3]).unwrap();
        let hu = vec![1000; grid.voxel_count()];
        let board = Board::new(Channels::new(&[], false));
        let mut bone = Bone::new(grid, 150);
        assert!(!bone.publish(&hu, &board), "nothing is pending for nobody");
        let client = board.join();
        let subscribe = |id, topic| {
            let channel_id = board.channels().id(topic).unwrap();
            board.subscribe(&client, Subscription { id, channel_id, newest: false }).unwrap();
        };
        let taken = || std::iter::from_fn(|| client.take(usize::MAX).pop()).count();
        subscribe(1, COARSE_SURFACE);
        let coarse = taken();
        subscribe(2, SURFACE);
        assert_eq!((coarse, taken()), (26, 0), "of 27 blocks, the middle one has no surface");
        while bone.publish(&hu, &board) {}
        assert!(taken() > coarse);
        // A drilled voxel changes both.
        bone.set(0, Voxel::Removed);
        bone.publish(&hu, &board);
        assert_eq!(taken(), 2);
    }
}
