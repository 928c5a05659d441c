//! Cached cells of the smoothed surface, reused as long as nothing changes in them.
//!
//! The voxels' journal records where drilling changed bone. On each request, the cached cell is checked
//! against the changes since it was last valid. It is recomputed if one of them may overlap it, or if there
//! were more changes than the journal keeps. A cached cell therefore has the same bits as a new one.

use super::spline::SplineCell;
use super::voxels::Voxels;

/// Cells cached per sphere: about as many as its planes need, so that one tick's cells are still cached in
/// the next.
const KEPT_CELLS: usize = 32;

/// A cell, and when it was last known to be valid.
#[derive(Debug, Clone, Copy)]
struct RememberedCell {
    start: [i64; 3],
    cell: SplineCell,
    /// Number of changed regions that it was checked against; `None` if the entry is empty.
    seen: Option<u64>,
}

/// The cells that a sphere's contacts requested most recently.
#[derive(Debug, Clone)]
pub(super) struct RememberedCells {
    cells: [RememberedCell; KEPT_CELLS],
    /// [`key`] of each cell's start, and the time of its last request; stored apart from the cells so that a
    /// search reads little memory.
    keys: [u64; KEPT_CELLS],
    used: [u64; KEPT_CELLS],
    /// Number of requests so far.
    uses: u64,
}

/// Returns a hash of a start; starts far apart may share it.
#[inline(always)]
fn key([x, y, z]: [i64; 3]) -> u64 {
    const BITS: u32 = 21;
    const MASK: i64 = (1 << BITS) - 1;
    ((x & MASK) | (y & MASK) << BITS | (z & MASK) << (2 * BITS)) as u64
}

impl RememberedCells {
    pub fn new() -> Self {
        let nothing = RememberedCell { start: [0; 3], cell: SplineCell::AIR, seen: None };
        Self { cells: [nothing; KEPT_CELLS], keys: [u64::MAX; KEPT_CELLS], used: [0; KEPT_CELLS], uses: 0 }
    }

    /// Returns the entry of the cell that starts at a voxel, or else the least recently used one. The loops
    /// have no early exit, so that they use vector instructions.
    #[inline(always)]
    fn at(&mut self, start: [i64; 3]) -> &mut RememberedCell {
        self.uses += 1;
        let key = key(start);
        let mut found = KEPT_CELLS;
        for place in 0..KEPT_CELLS {
            found = if self.keys[place] == key { place } else { found };
        }
        if found == KEPT_CELLS {
            found = 0;
            for place in 1..KEPT_CELLS {
                found = if self.used[place] < self.used[found] { place } else { found };
            }
            self.keys[found] = key;
        }
        self.used[found] = self.uses;
        &mut self.cells[found]
    }

    /// Returns the same as [`Voxels::spline_cell`], bit for bit.
    #[inline(always)]
    pub fn cell(&mut self, voxels: &Voxels, start: [i64; 3]) -> &SplineCell {
        let journal = voxels.journal();
        let cell = self.at(start);
        let good =
            cell.start == start && cell.seen.is_some_and(|seen| journal.cell_is_unchanged(seen, start));
        if !good {
            cell.start = start;
            cell.cell = voxels.spline_cell(start);
        }
        cell.seen = Some(journal.regions());
        &cell.cell
    }
}
