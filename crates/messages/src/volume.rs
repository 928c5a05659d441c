use voxel_grid::{Ct, GridError, VoxelGrid};

use crate::message;

message! {
    /// Voxels removed from this tick on. Published before the tick's state, and only for ticks that remove
    /// voxels; a tick that removes more than 4096 has several, in order of their `sequence`. Messages of tick
    /// 0 hold the scene's predrilled holes, which `removed_total` does not count.
    pub struct Removed = "trabecula_msgs/msg/Removed" {
        /// `State.tick` of the first state without them.
        tick: u64,
        /// Sequence number of these messages: 1, 2, 3 and so on.
        sequence: u64,
        /// Voxels drilled since the start or the last reset, including these.
        removed_total: u64,
        /// 1 after a reset: first restore all drilled voxels (not the predrilled ones), then remove these.
        restore_first: u32,
        /// Number of entries in `voxel_index`.
        voxel_index_length: u32,
    }
    tail voxel_index: [u32] = "uint32"
}

/// What a tick restored before removing voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Restores {
    /// Nothing.
    #[default]
    Nothing,
    /// All drilled voxels, as after a reset; the predrilled ones stay removed.
    Drilled,
}

impl Restores {
    /// Returns its value of [`Removed::restore_first`].
    pub const fn code(self) -> u32 {
        match self {
            Restores::Nothing => 0,
            Restores::Drilled => 1,
        }
    }
}

impl Removed {
    /// Returns what was restored first.
    pub fn restores(&self) -> Restores {
        if self.restore_first != 0 { Restores::Drilled } else { Restores::Nothing }
    }
}

message! {
    /// The CT volume: geometry, then Hounsfield units with x varying fastest. Published once; late joiners
    /// receive it.
    pub struct Volume = "trabecula_msgs/msg/Volume" {
        /// SHA-256 of geometry and voxels.
        sha256: [u8; 32],
        /// Position of the centre of voxel (0, 0, 0), world frame.
        origin_m: [f64; 3],
        /// Distance between voxel centres along i, j, k.
        spacing_m: [f64; 3],
        /// Unit vectors along i, j, k in the world frame, one after the other.
        direction: [f64; 9],
        /// Number of voxels along i, j, k.
        dimensions: [u32; 3],
        /// Number of voxels.
        hu_length: u32,
    }
    tail hu: [i16] = "int16"
}

impl Volume {
    /// Creates the message of a CT, whose voxels are its tail.
    pub fn of(ct: &Ct) -> Volume {
        let (grid, hu) = (&ct.volume.grid, &ct.volume.hu);
        let [[a, b, c], [d, e, f], [g, h, i]] = grid.axes();
        Volume {
            sha256: ct.sha256,
            origin_m: grid.origin_m(),
            spacing_m: grid.spacing_m(),
            direction: [a, b, c, d, e, f, g, h, i],
            dimensions: grid.dims().map(|n| n as u32),
            hu_length: hu.len() as u32,
        }
    }

    /// Returns the grid of its voxels.
    ///
    /// # Errors
    /// If the geometry is not a valid grid.
    pub fn grid(&self) -> Result<VoxelGrid, GridError> {
        let [a, b, c, d, e, f, g, h, i] = self.direction;
        let dims = self.dimensions.map(|n| n as usize);
        VoxelGrid::new(dims, self.spacing_m, self.origin_m, [[a, b, c], [d, e, f], [g, h, i]])
    }
}
