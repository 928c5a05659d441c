//! Cells of the smoothed surface that are used again as long as nothing changes in them.
//!
//! The voxels' journal says where drilling changed bone. A cell that is asked for again is compared with the changes since it
//! was last found good, and made anew if one of them may have met it, or if there are more of them than are kept. So a remembered
//! cell has the bits of a fresh one.

use super::query::MAX_SEEDS;
use super::spline::SplineCell;
use super::voxels::Voxels;

/// Cells of a sphere: as many as it can have seeds, so that those of one tick are there in the next.
const KEPT_CELLS: usize = MAX_SEEDS;

/// A cell, and when it was last known to be good.
#[derive(Debug, Clone, Copy)]
struct RememberedCell {
    start: [i64; 3],
    cell: SplineCell,
    /// Number of changed regions that it has seen; `None`: nothing is remembered.
    seen: Option<u64>,
    /// When it was last asked for.
    used: u64,
}

/// The cells that a sphere's contacts asked for last.
#[derive(Debug, Clone)]
pub(super) struct RememberedCells {
    cells: [RememberedCell; KEPT_CELLS],
    /// How often one was asked for.
    uses: u64,
}

impl RememberedCells {
    pub fn new() -> Self {
        let nothing = RememberedCell { start: [0; 3], cell: SplineCell::AIR, seen: None, used: 0 };
        Self { cells: [nothing; KEPT_CELLS], uses: 0 }
    }

    /// The cell that starts at a voxel, or else the one that was not asked for the longest.
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

    /// [`Voxels::spline_cell`], bit for bit.
    #[inline(always)]
    pub fn cell(&mut self, voxels: &Voxels, start: [i64; 3]) -> &SplineCell {
        let journal = voxels.journal();
        let cell = self.at(start);
        let good = cell.start == start
            && cell
                .seen
                .is_some_and(|seen| journal.cell_is_unchanged(seen, start, voxels.geometry().spacing_m));
        if !good {
            cell.start = start;
            cell.cell = voxels.spline_cell(start);
        }
        cell.seen = Some(journal.regions());
        &cell.cell
    }
}
