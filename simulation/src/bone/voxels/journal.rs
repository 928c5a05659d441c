//! Records which voxels changed recently, so that caches can tell which of their entries are still valid.
//!
//! A cache stores the number of edits it has seen ([`Journal::edits`]). The journal tells it what changed since then; if the journal no
//! longer goes back that far, the cache drops everything. A cache therefore cannot miss a change: it asks, and nobody has to notify it.

use nalgebra::Vector3;

use crate::bone::occupancy::VoxelBox;
use crate::bone::spline::SPLINE_VOXELS;

/// Number of regions kept. Few are enough, because a sphere that rests on bone asks in every tick.
const KEPT_REGIONS: usize = 8;

/// Where one tick of drilling may have changed bone: voxels that intersect the ball, and voxels in the box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::bone) struct Region {
    pub ball: Option<Ball>,
    pub voxels: VoxelBox,
}

/// A ball in the grid's metric frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::bone) struct Ball {
    pub centre_m: Vector3<f64>,
    pub radius_m: f64,
}

impl Region {
    /// No voxel.
    pub const NOTHING: Self = Self { ball: None, voxels: VoxelBox::NOTHING };

    /// True if the region may overlap one of the voxels `start..start + 7` per axis.
    fn meets_cell(&self, start: [i64; 3], spacing_m: [f64; 3]) -> bool {
        let last = start.map(|x| x + SPLINE_VOXELS as i64 - 1);
        if self.voxels.meets(&VoxelBox { low: start, high: last }) {
            return true;
        }
        let Some(ball) = &self.ball else { return false };
        let mut distance2 = 0.0;
        for axis in 0..3 {
            let low = (start[axis] as f64 - 0.5) * spacing_m[axis] - ball.centre_m[axis];
            let high = ball.centre_m[axis] - (last[axis] as f64 + 0.5) * spacing_m[axis];
            let outside = low.max(high).max(0.0);
            distance2 += outside * outside;
        }
        distance2 <= ball.radius_m * ball.radius_m
    }
}

/// The most recent changes.
#[derive(Debug, Clone)]
pub(in crate::bone) struct Journal {
    /// Number of edits so far, including those that changed nothing.
    edits: u64,
    newest: [Region; KEPT_REGIONS],
    /// Number of regions so far. An edit that changes nothing adds none.
    regions: u64,
    /// Blocks of the pool that were in use before the last edit.
    blocks_before: usize,
    /// Around the voxels that the last edit cut for the first time.
    first_cut: VoxelBox,
}

impl Journal {
    pub(super) fn new() -> Self {
        Self {
            edits: 0,
            newest: [Region::NOTHING; KEPT_REGIONS],
            regions: 0,
            blocks_before: 0,
            first_cut: VoxelBox::NOTHING,
        }
    }

    /// Begins an edit by drilling.
    pub(super) fn begin(&mut self, blocks_in_use: usize) {
        self.edits += 1;
        self.blocks_before = blocks_in_use;
        self.first_cut = VoxelBox::NOTHING;
    }

    /// Records that the edit cuts a voxel that was whole.
    pub(super) fn note_first_cut(&mut self, voxel: [i64; 3]) {
        self.first_cut = self.first_cut.with(voxel);
    }

    /// Around the voxels that the last edit cut for the first time.
    pub fn first_cut(&self) -> &VoxelBox {
        &self.first_cut
    }

    /// Ends the edit, which changed voxels in this region.
    pub(super) fn end(&mut self, region: Region) {
        if region != Region::NOTHING {
            self.newest[(self.regions % KEPT_REGIONS as u64) as usize] = region;
            self.regions += 1;
        }
    }

    /// Records an edit that may have changed any voxel: everything cached is out of date.
    pub(super) fn note_everything(&mut self) {
        // Two edits and more regions than are kept: every cache then finds itself more than one edit behind.
        self.edits += 2;
        self.regions += KEPT_REGIONS as u64 + 1;
    }

    /// Number of edits so far.
    #[inline]
    pub fn edits(&self) -> u64 {
        self.edits
    }

    /// Number of regions so far, for [`Self::cell_is_unchanged`].
    #[inline]
    pub fn regions(&self) -> u64 {
        self.regions
    }

    /// Blocks of the pool that were in use before the last edit.
    pub fn blocks_before(&self) -> usize {
        self.blocks_before
    }

    /// True if no region from number `seen` on can overlap the voxels `start..start + 7` per axis.
    #[inline]
    pub fn cell_is_unchanged(&self, seen: u64, start: [i64; 3], spacing_m: [f64; 3]) -> bool {
        let place = |number: u64| (number % KEPT_REGIONS as u64) as usize;
        self.regions - seen <= KEPT_REGIONS as u64
            && !(seen..self.regions).any(|number| self.newest[place(number)].meets_cell(start, spacing_m))
    }
}
