//! Tracks what is drilled (one bit per voxel) and what is empty (one byte per block of 8x8x8 voxels).

use rayon::prelude::*;

use crate::attenuation::MuTable;
use crate::error::DrrError;
use crate::grid::{Grid, VolumeView};
use crate::pieces::{PIECE, least_hu, pieces_from};

/// log2 of a block's side.
pub(crate) const BLOCK_SHIFT: usize = 3;
const BLOCK: usize = 1 << BLOCK_SHIFT;
const _: () = assert!(PIECE.is_multiple_of(BLOCK), "a block lies in one piece");

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

/// Flags of the blocks. Block (i, j, k) covers the voxels 8i..=8i+8 along each axis: one more than its own,
/// so that it includes every voxel read by an interpolation that starts inside it.
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
        let mut flags = vec![EMPTY; blocks[0] * blocks[1] * blocks[2]];
        let least = least_hu(|hu| table.mu_per_m(hu) > 0.0);
        flags.par_chunks_mut(blocks[0] * blocks[1]).enumerate().for_each(|(bz, layer)| {
            let mut of_row = vec![EMPTY; blocks[0]];
            for z in bz << BLOCK_SHIFT..dims[2].min((bz << BLOCK_SHIFT) + BLOCK + 1) {
                for (y, row) in view.hu()[dims[0] * dims[1] * z..].chunks(dims[0]).take(dims[1]).enumerate() {
                    mark_occupied(row, table, least, &mut of_row);
                    let (before, own) = (y.saturating_sub(1) >> BLOCK_SHIFT, y >> BLOCK_SHIFT);
                    for flags in layer[blocks[0] * before..blocks[0] * (own + 1)].chunks_mut(blocks[0]) {
                        flags.iter_mut().zip(&of_row).for_each(|(flag, of_row)| *flag |= of_row);
                    }
                }
            }
        });
        Self { flags, blocks }
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

    /// Memory strides between neighbouring blocks.
    pub(crate) fn strides(&self) -> [usize; 3] {
        [1, self.blocks[0], self.blocks[0] * self.blocks[1]]
    }

    /// The flags, x fastest.
    pub(crate) fn flags(&self) -> &[u8] {
        &self.flags
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

/// Marks the blocks in which a voxel of this row attenuates. Voxels below `least` never attenuate.
fn mark_occupied(row: &[i16], table: &MuTable, least: i16, blocks: &mut [u8]) {
    blocks.fill(EMPTY);
    let attenuates = |hu: &i16| table.mu_per_m(*hu) > 0.0;
    for (first, piece) in pieces_from(row, least) {
        for (block, voxels) in (first / BLOCK..).zip(piece.chunks(BLOCK)) {
            if voxels.iter().any(attenuates) {
                blocks[block] = OCCUPIED;
            }
            // The first voxel is the last one of the block before.
            if block > 0 && voxels.first().is_some_and(attenuates) {
                blocks[block - 1] = OCCUPIED;
            }
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    const DIMS: [usize; 3] = [139, 18, 9];

    /// Reference flags for one occupied voxel, straight from the definition of a block.
    fn flags_of(voxel: [usize; 3]) -> Vec<u8> {
        let blocks = DIMS.map(|n| n.div_ceil(BLOCK));
        let holds = |block: [usize; 3]| (0..3).all(|a| (8 * block[a]..=8 * block[a] + 8).contains(&voxel[a]));
        let places = (0..blocks[2])
            .flat_map(|z| (0..blocks[1]).flat_map(move |y| (0..blocks[0]).map(move |x| [x, y, z])));
        places.map(|block| if holds(block) { OCCUPIED } else { EMPTY }).collect()
    }

    #[test]
    fn a_voxel_occupies_the_blocks_that_read_it_wherever_it_lies() {
        let grid = Grid::axis_aligned(DIMS, [1e-3; 3], [0.0; 3]).unwrap();
        let table = MuTable::new(60.0, -900).unwrap();
        let mut hu = vec![-1000_i16; grid.voxels()];
        // Coprime to the dimensions, so that all kinds of positions occur.
        for linear in (0..grid.voxels()).step_by(11) {
            hu[linear] = 40;
            let map = BlockMap::new(&VolumeView::new(grid, &hu).unwrap(), &table);
            assert_eq!(map.flags(), flags_of(grid.voxel_of(linear)), "voxel {:?}", grid.voxel_of(linear));
            hu[linear] = -1000;
        }
    }
}
