//! Cells of the smoothed surface that are used again as long as nothing changes in them.
//!
//! Each tick of drilling notes where it changed bone ([`Changes`]). A cell that is asked for again is compared with the changes since it
//! was last found good, and made anew if one of them may have met it, or if there are more of them than are kept. So a remembered
//! cell has the bits of a fresh one.

use nalgebra::Vector3;

use super::field::BoneField;
use super::occupancy::VoxelBox;
use super::query::MAX_SEEDS;
use super::spline::{SPLINE_VOXELS, SplineCell};

/// Changes that are kept. A sphere that rests on bone asks in every tick.
const KEPT_CHANGES: usize = 8;
/// Cells of a sphere: as many as it can have seeds, so that those of one tick are there in the next.
const KEPT_CELLS: usize = MAX_SEEDS;

/// Where a tick of drilling changed bone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Change {
    /// In the voxels whose boxes are within `reach_m` of this point of the grid's metric frame,
    pub centre: Vector3<f64>,
    pub reach_m: f64,
    /// and in this box of voxels.
    pub voxels: VoxelBox,
}

impl Change {
    /// None.
    pub const NOTHING: Self =
        Self { centre: Vector3::new(0.0, 0.0, 0.0), reach_m: -1.0, voxels: VoxelBox::NOTHING };

    /// Whether it may have met one of the voxels `start..start + 7` of each axis.
    fn meets_cell(&self, start: [i64; 3], spacing: [f64; 3]) -> bool {
        let last = start.map(|x| x + SPLINE_VOXELS as i64 - 1);
        if self.voxels.meets(&VoxelBox { low: start, high: last }) {
            return true;
        }
        let mut distance2 = 0.0;
        for axis in 0..3 {
            let low = (start[axis] as f64 - 0.5) * spacing[axis] - self.centre[axis];
            let high = self.centre[axis] - (last[axis] as f64 + 0.5) * spacing[axis];
            let outside = low.max(high).max(0.0);
            distance2 += outside * outside;
        }
        self.reach_m >= 0.0 && distance2 <= self.reach_m * self.reach_m
    }
}

/// The newest changes.
#[derive(Debug, Clone)]
pub(super) struct Changes {
    newest: [Change; KEPT_CHANGES],
    /// Number of all changes ever.
    count: u64,
}

impl Changes {
    pub fn new() -> Self {
        Self { newest: [Change::NOTHING; KEPT_CHANGES], count: 0 }
    }

    pub fn note(&mut self, change: Change) {
        self.newest[(self.count % KEPT_CHANGES as u64) as usize] = change;
        self.count += 1;
    }

    /// For any change of the bone but drilling.
    pub fn forget_all(&mut self) {
        self.count += KEPT_CHANGES as u64 + 1;
    }

    /// The changes from number `seen` on; `None` if they are not all kept.
    fn since(&self, seen: u64) -> Option<impl Iterator<Item = &Change>> {
        let place = |number: u64| (number % KEPT_CHANGES as u64) as usize;
        (self.count - seen <= KEPT_CHANGES as u64)
            .then(|| (seen..self.count).map(move |number| &self.newest[place(number)]))
    }
}

/// A cell, and when it was last known to be good.
#[derive(Debug, Clone, Copy)]
struct RememberedCell {
    start: [i64; 3],
    cell: SplineCell,
    /// Number of changes that it has seen; `None`: nothing is remembered.
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
}

impl BoneField {
    /// [`BoneField::spline_cell`], bit for bit.
    #[inline(always)]
    pub(super) fn remembered_cell<'r>(
        &self,
        remembered: &'r mut RememberedCells,
        start: [i64; 3],
    ) -> &'r SplineCell {
        let cell = remembered.at(start);
        let changes = cell.seen.and_then(|seen| self.changes.since(seen));
        let spacing = self.geometry.spacing_m;
        let good = cell.start == start
            && changes.is_some_and(|mut all| !all.any(|change| change.meets_cell(start, spacing)));
        if !good {
            cell.start = start;
            cell.cell = self.spline_cell(start);
        }
        cell.seen = Some(self.changes.count);
        &cell.cell
    }
}
