//! Records which voxels changed recently, so that caches can determine which of their entries are still
//! valid.
//!
//! A cache stores the number of edits it has seen ([`Journal::edits`]). The journal returns the changes since
//! then; if it no longer goes back that far, the cache drops everything. A cache therefore cannot miss a
//! change: it polls the journal and needs no notification.

use crate::bone::occupancy::VoxelBox;
use crate::bone::spline::SPLINE_VOXELS;

/// Maximum number of first cuts of an edit that are recorded individually.
const KEPT_FIRST_CUTS: usize = 128;

/// Number of regions kept. A few are enough, because a sphere that rests on bone checks in every tick.
const KEPT_REGIONS: usize = 8;

/// Boxes around the voxels that one tick of drilling has changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::bone) struct Region {
    /// Voxels cut by the burr.
    pub cut: VoxelBox,
    /// Voxels crushed by the rest of the tool, which may press elsewhere.
    pub crushed: VoxelBox,
}

impl Region {
    /// No voxel.
    pub const NOTHING: Self = Self { cut: VoxelBox::NOTHING, crushed: VoxelBox::NOTHING };

    /// Returns true if the region overlaps the box.
    #[inline]
    fn meets(&self, voxels: &VoxelBox) -> bool {
        self.cut.meets(voxels) || self.crushed.meets(voxels)
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
    /// The voxels that the last edit cut for the first time (up to the maximum), their number, and their
    /// bounding box.
    first_cuts: [[i64; 3]; KEPT_FIRST_CUTS],
    first_cut_count: usize,
    first_cut_box: VoxelBox,
}

impl Journal {
    pub(super) fn new() -> Self {
        Self {
            edits: 0,
            newest: [Region::NOTHING; KEPT_REGIONS],
            regions: 0,
            blocks_before: 0,
            first_cuts: [[0; 3]; KEPT_FIRST_CUTS],
            first_cut_count: 0,
            first_cut_box: VoxelBox::NOTHING,
        }
    }

    /// Begins an edit by drilling.
    pub(super) fn begin(&mut self, blocks_in_use: usize) {
        self.edits += 1;
        self.blocks_before = blocks_in_use;
        self.first_cut_count = 0;
        self.first_cut_box = VoxelBox::NOTHING;
    }

    /// Records that the edit cuts a voxel that was whole.
    pub(super) fn note_first_cut(&mut self, voxel: [i64; 3]) {
        if let Some(kept) = self.first_cuts.get_mut(self.first_cut_count) {
            *kept = voxel;
        }
        self.first_cut_count += 1;
        self.first_cut_box = self.first_cut_box.with(voxel);
    }

    /// Returns the voxels that the last edit cut for the first time, or their bounding box if there are too
    /// many.
    pub fn first_cuts(&self) -> Result<&[[i64; 3]], &VoxelBox> {
        self.first_cuts.get(..self.first_cut_count).ok_or(&self.first_cut_box)
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
        // Add two edits and more regions than are kept, so that every cache finds itself more than one edit
        // behind.
        self.edits += 2;
        self.regions += KEPT_REGIONS as u64 + 1;
    }

    /// Returns the number of edits so far.
    #[inline]
    pub fn edits(&self) -> u64 {
        self.edits
    }

    /// Returns the number of regions so far, for [`Self::is_unchanged`].
    #[inline]
    pub fn regions(&self) -> u64 {
        self.regions
    }

    /// Returns the blocks of the pool that were in use before the last edit.
    pub fn blocks_before(&self) -> usize {
        self.blocks_before
    }

    /// Returns true if no region from number `seen` on overlaps the voxels `start..start + 7` per axis.
    #[inline]
    pub fn cell_is_unchanged(&self, seen: u64, start: [i64; 3]) -> bool {
        let high = start.map(|x| x + SPLINE_VOXELS as i64 - 1);
        self.is_unchanged(seen, &VoxelBox { low: start, high })
    }

    /// Returns true if no region from number `seen` on overlaps the box.
    #[inline]
    pub fn is_unchanged(&self, seen: u64, voxels: &VoxelBox) -> bool {
        let place = |number: u64| (number % KEPT_REGIONS as u64) as usize;
        self.regions - seen <= KEPT_REGIONS as u64
            && !(seen..self.regions).any(|number| self.newest[place(number)].meets(voxels))
    }
}
