use voxel_grid::{GridError, VoxelGrid};

use crate::message;

message! {
    /// Voxels that are gone from this tick on, published before the state of the tick, and only for ticks that removed
    /// some. Messages of tick 0 hold the holes that the scene predrills, which `removed_total` does not count.
    pub struct Removed = "trabecula_msgs/msg/Removed" {
        /// `State.tick` of the state in which they are gone.
        tick: u64,
        /// Counts these messages, from 1, rising by one.
        sequence: u64,
        /// Voxels drilled since the start or the last reset, these included.
        removed_total: u64,
        /// 1 if all drilled voxels, not the predrilled ones, are put back before these are removed (a reset).
        restore_first: u32,
        /// Number of entries of `voxel_index`.
        voxel_index_length: u32,
    }
    tail voxel_index: [u32] = "uint32"
}

message! {
    /// The CT volume: geometry, then Hounsfield units, x fastest. Published once; late joiners receive it.
    pub struct Volume = "trabecula_msgs/msg/Volume" {
        /// SHA-256 of geometry and voxels.
        sha256: [u8; 32],
        /// World position of the centre of voxel (0, 0, 0).
        origin_m: [f64; 3],
        /// Distance between voxel centres along i, j, k.
        spacing_m: [f64; 3],
        /// Unit axes of i, j, k in the world, one after the other.
        direction: [f64; 9],
        /// Number of voxels along i, j, k.
        dimensions: [u32; 3],
        /// Number of voxels.
        hu_length: u32,
    }
    tail hu: [i16] = "int16"
}

impl Volume {
    /// Where its voxels lie.
    ///
    /// # Errors
    /// The message holds no grid.
    pub fn grid(&self) -> Result<VoxelGrid, GridError> {
        let [a, b, c, d, e, f, g, h, i] = self.direction;
        let dims = self.dimensions.map(|n| n as usize);
        VoxelGrid::new(dims, self.spacing_m, self.origin_m, [[a, b, c], [d, e, f], [g, h, i]])
    }
}
