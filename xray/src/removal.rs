//! Tracks what is drilled (one bit per voxel) and what is empty (one byte per block of 8x8x8 voxels).

use crate::attenuation::MuTable;
use crate::error::DrrError;
use crate::grid::{Grid, VolumeView};

/// log2 of a block's side.
pub(crate) const BLOCK_SHIFT: usize = 3;
const BLOCK: usize = 1 << BLOCK_SHIFT;

/// A block where nothing attenuates.
const EMPTY: u8 = 0;
/// A block with a voxel that attenuates.
const OCCUPIED: u8 = 1;
/// A block with a removed voxel.
const DRILLED: u8 = 2;

/// The set of removed voxels of one grid.
#[derive(Debug, Clone)]
pub struct RemovedVoxels {
    words: Vec<u64>,
    voxels: usize,
    count: usize,
}

impl RemovedVoxels {
    /// Nothing removed.
    pub fn new(grid: &Grid) -> Self {
        let voxels = grid.voxels();
        Self { words: vec![0; voxels.div_ceil(64)], voxels, count: 0 }
    }

    /// True if a voxel is removed; false outside the volume.
    #[inline]
    pub fn contains(&self, linear: usize) -> bool {
        self.words.get(linear >> 6).is_some_and(|w| w >> (linear & 63) & 1 == 1)
    }

    /// The removed voxels, in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = usize> {
        self.words.iter().enumerate().flat_map(|(n, &word)| {
            let bits = core::iter::successors(Some(word), |w| Some(w & w.wrapping_sub(1)));
            bits.take_while(|&w| w != 0).map(move |w| 64 * n + w.trailing_zeros() as usize)
        })
    }

    /// Number of removed voxels.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Refuses a batch with a voxel outside the volume.
    ///
    /// # Errors
    /// The first such index.
    pub fn check(&self, batch: &[u32]) -> Result<(), DrrError> {
        match batch.iter().position(|&i| i as usize >= self.voxels) {
            None => Ok(()),
            Some(position) => {
                Err(DrrError::VoxelIndex { given: batch[position], position, voxels: self.voxels })
            }
        }
    }

    /// Removes a voxel; false if it was already removed or lies outside.
    pub fn insert(&mut self, linear: usize) -> bool {
        let bit = 1_u64 << (linear & 63);
        match self.words.get_mut(linear >> 6) {
            Some(word) if linear < self.voxels && *word & bit == 0 => {
                *word |= bit;
                self.count += 1;
                true
            }
            _ => false,
        }
    }

    /// Restores all voxels.
    pub(crate) fn clear(&mut self) {
        self.words.fill(0);
        self.count = 0;
    }
}

/// Flags of the blocks. Block (i, j, k) covers the voxels 8i..=8i+8 along each axis: one more than its own, so that it includes every
/// voxel read by an interpolation that starts inside it.
#[derive(Debug, Clone)]
pub struct BlockMap {
    flags: Vec<u8>,
    blocks: [usize; 3],
}

impl BlockMap {
    /// Reads the volume once and marks the blocks where something attenuates.
    pub fn new(view: &VolumeView<'_>, table: &MuTable) -> Self {
        let dims = view.grid().dims();
        let blocks = dims.map(|n| n.div_ceil(BLOCK));
        let mut map = Self { flags: Vec::with_capacity(blocks[0] * blocks[1] * blocks[2]), blocks };
        for bz in 0..blocks[2] {
            for by in 0..blocks[1] {
                for bx in 0..blocks[0] {
                    let occupied = block_is_occupied(view, table, [bx, by, bz]);
                    map.flags.push(if occupied { OCCUPIED } else { EMPTY });
                }
            }
        }
        map
    }

    /// Marks the blocks that cover a removed voxel, whose attenuation is now `fill_mu_per_m`.
    pub(crate) fn mark_drilled(&mut self, voxel: [usize; 3], fill_mu_per_m: f64) {
        let flag = DRILLED | if fill_mu_per_m > 0.0 { OCCUPIED } else { 0 };
        let first = voxel.map(|v| v.saturating_sub(1) >> BLOCK_SHIFT);
        let last = voxel.map(|v| v >> BLOCK_SHIFT);
        for z in first[2]..=last[2] {
            for y in first[1]..=last[1] {
                for x in first[0]..=last[0] {
                    let block = x + self.blocks[0] * (y + self.blocks[1] * z);
                    if let Some(f) = self.flags.get_mut(block) {
                        *f |= flag;
                    }
                }
            }
        }
    }

    /// Steps in memory between neighbouring blocks.
    pub(crate) fn strides(&self) -> [usize; 3] {
        [1, self.blocks[0], self.blocks[0] * self.blocks[1]]
    }

    /// The flags, x fastest.
    pub(crate) fn flags(&self) -> &[u8] {
        &self.flags
    }

    /// Number of attenuating blocks, and of all blocks.
    pub fn occupancy(&self) -> (usize, usize) {
        (self.flags.iter().filter(|&&f| is_occupied(f)).count(), self.flags.len())
    }
}

/// True if anything attenuates in a block (or in several blocks with OR-ed flags).
#[inline]
pub(crate) fn is_occupied(flags: u8) -> bool {
    flags & OCCUPIED != 0
}

/// True if anything is drilled in a block (or in several blocks with OR-ed flags).
#[inline]
pub(crate) fn is_drilled(flags: u8) -> bool {
    flags & DRILLED != 0
}

fn block_is_occupied(view: &VolumeView<'_>, table: &MuTable, block: [usize; 3]) -> bool {
    let dims = view.grid().dims();
    let range = |axis: usize| {
        let start = block[axis] << BLOCK_SHIFT;
        start..(start + BLOCK + 1).min(dims[axis])
    };
    for z in range(2) {
        for y in range(1) {
            let line = dims[0] * (y + dims[1] * z);
            let x = range(0);
            let voxels = view.hu().get(line + x.start..line + x.end).unwrap_or(&[]);
            if voxels.iter().any(|&hu| table.mu_per_m(hu) > 0.0) {
                return true;
            }
        }
    }
    false
}

/// The attenuation field: the CT without the removed voxels.
#[derive(Debug, Clone, Copy)]
pub struct AttenuationField<'a> {
    /// The CT.
    pub view: VolumeView<'a>,
    /// The removed voxels.
    pub removed: &'a RemovedVoxels,
    /// The flags of the blocks.
    pub blocks: &'a BlockMap,
    /// Hounsfield units to attenuation.
    pub table: &'a MuTable,
    /// Attenuation of the material that fills a removed voxel, 1/m.
    pub fill_mu_per_m: f64,
}

impl AttenuationField<'_> {
    /// Attenuation of a voxel, 1/m; 0 outside the volume.
    #[inline]
    pub fn mu_per_m(&self, linear: usize) -> f64 {
        match self.view.hu().get(linear) {
            None => 0.0,
            Some(_) if self.removed.contains(linear) => self.fill_mu_per_m,
            Some(&hu) => self.table.mu_per_m(hu),
        }
    }
}
