//! Cached cells of the smoothed surface, reused as long as nothing changes in them.
//!
//! The voxels' journal says where drilling changed bone. On each request, the cached cell is checked against the changes since it was
//! last valid. It is recomputed if one of them may overlap it, or if there were more changes than the journal keeps. A cached cell
//! therefore has the same bits as a new one.

use super::spline::SplineCell;
use super::voxels::Voxels;

/// Cells cached per sphere: about as many as its planes look at, so that one tick's cells are still there in the next.
const KEPT_CELLS: usize = 32;

/// A cell, and when it was last known to be valid.
#[derive(Debug, Clone, Copy)]
struct RememberedCell {
    start: [i64; 3],
    cell: SplineCell,
    /// Number of changed regions it was checked against; `None` if the entry is empty.
    seen: Option<u64>,
    /// Time of the last request.
    used: u64,
}

/// The cells that a sphere's contacts requested most recently.
#[derive(Debug, Clone)]
pub(super) struct RememberedCells {
    cells: [RememberedCell; KEPT_CELLS],
    /// Number of requests so far.
    uses: u64,
}

impl RememberedCells {
    pub fn new() -> Self {
        let nothing = RememberedCell { start: [0; 3], cell: SplineCell::AIR, seen: None, used: 0 };
        Self { cells: [nothing; KEPT_CELLS], uses: 0 }
    }

    /// The cell that starts at a voxel, or else the least recently used one.
    #[inline(always)]
    fn at(&mut self, start: [i64; 3]) -> &mut RememberedCell {
        self.uses += 1;
        let mut place = 0;
        for (other, cell) in self.cells.iter().enumerate() {
            if cell.start == start {
                place = other;
                break;
            }
            if cell.used < self.cells[place].used {
                place = other;
            }
        }
        self.cells[place].used = self.uses;
        &mut self.cells[place]
    }

    /// Same as [`Voxels::spline_cell`], bit for bit.
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
