//! Changes voxels. Every function that does so is in this file and records the change in the journal.

use super::journal::Region;
use super::{BoneSnapshot, Voxels};
use crate::bone::BoneError;
use crate::bone::drilling::{GONE, is_ended};
use crate::bone::grid::VoxelIndex;
use crate::bone::occupancy::VoxelBox;
use crate::bone::strength::PoolIndex;

/// One tick of drilling. On drop, it records the changes in the journal.
pub(in crate::bone) struct Drilling<'v> {
    voxels: &'v mut Voxels,
    changed: Region,
}

impl core::ops::Deref for Drilling<'_> {
    type Target = Voxels;

    fn deref(&self) -> &Voxels {
        self.voxels
    }
}

impl Drop for Drilling<'_> {
    fn drop(&mut self) {
        self.voxels.journal.end(self.changed);
    }
}

impl Drilling<'_> {
    /// Returns the place of the voxel's spent fraction, taking a block if needed; `None` if there are no
    /// more.
    pub fn claim(&mut self, voxel: VoxelIndex) -> Option<PoolIndex> {
        self.voxels.pool.claim(self.voxels.geometry.voxel(voxel))
    }

    /// Sets the spent fraction of a voxel, given by index and by its position along each axis; returns the
    /// value set.
    #[inline]
    pub fn cut(&mut self, voxel: VoxelIndex, at: [i64; 3], place: PoolIndex, spent: f64) -> f64 {
        self.changed.cut = self.changed.cut.with(at);
        self.set(voxel, place, spent)
    }

    /// Records that voxels in this box are cut, for [`Self::set`].
    pub fn note_cuts(&mut self, around: &VoxelBox) {
        self.changed.cut = self.changed.cut.hull(around);
    }

    /// Returns true if another voxel may be queued for the list of removed voxels.
    pub fn has_room(&self) -> bool {
        self.voxels.waiting.len() < self.voxels.waiting_limit
    }

    /// Sets the spent fraction of any voxel; returns false if memory runs out.
    pub fn crush(&mut self, voxel: VoxelIndex, spent: f64) -> bool {
        let Some(place) = self.claim(voxel) else { return false };
        self.set(voxel, place, spent);
        let at = self.voxels.geometry.voxel(voxel).map(|x| x as i64);
        self.changed.crushed = self.changed.crushed.with(at);
        true
    }

    /// Moves queued voxels to the list of removed ones, up to the tick's limit.
    pub fn list_queued(&mut self) {
        let Voxels { waiting, removed, parameters, removed_total, .. } = &mut *self.voxels;
        let count = waiting.len().min(parameters.removed_per_tick);
        removed.extend(waiting.drain(..count));
        *removed_total += count as u64;
    }

    /// Sets the spent fraction of a voxel in a box recorded by [`Self::note_cuts`]; returns the value set.
    #[inline(always)]
    pub fn set(&mut self, voxel: VoxelIndex, place: PoolIndex, spent: f64) -> f64 {
        let spent = if spent > GONE { self.pass(voxel, place, spent) } else { spent };
        if self.voxels.pool.set(place, spent) {
            self.note_first_cut(place);
        }
        spent
    }

    /// Queues a voxel that is now gone, and empties one that is fully spent. Returns the fraction to set: if
    /// the queue is full, the voxel keeps half and is removed in a later tick.
    fn pass(&mut self, voxel: VoxelIndex, place: PoolIndex, spent: f64) -> f64 {
        if self.voxels.pool.spent_at(place) <= GONE {
            if !self.has_room() {
                return GONE;
            }
            self.voxels.waiting.push(voxel);
        }
        if !is_ended(spent) {
            return spent;
        }
        self.voxels.occupancy.empty(self.voxels.geometry.voxel(voxel));
        self.voxels.emptied.push(voxel);
        1.0
    }

    #[cold]
    fn note_first_cut(&mut self, place: PoolIndex) {
        if let Some(voxel) = self.voxels.pool.voxel_at(place) {
            self.voxels.whole.empty(voxel);
            self.voxels.journal.note_first_cut(voxel.map(|x| x as i64));
        }
    }
}

impl Voxels {
    /// Begins a tick of drilling.
    pub(in crate::bone) fn drill(&mut self) -> Drilling<'_> {
        self.journal.begin(self.pool.used());
        self.removed.clear();
        self.emptied.clear();
        Drilling { voxels: self, changed: Region::NOTHING }
    }

    /// Removes a fraction of a voxel from the bone permanently, or what is left of that fraction; returns
    /// false if memory runs out.
    pub(super) fn take_out(&mut self, voxel: [usize; 3], spent: f64) -> bool {
        let [i, j, k] = voxel;
        let before = self.pilot.spent(i, j, k);
        if spent >= 1.0 {
            self.occupancy.empty(voxel);
            self.whole.empty(voxel);
            self.pool.forget(voxel);
            self.pilot.forget(voxel);
            self.pilot_count += 1;
            self.pilot_voxels += 1.0 - before;
            return true;
        }
        // Claim the pool's block first: the pilot's blocks are always a subset of the pool's.
        let Some(place) = self.pool.claim(voxel) else { return false };
        let Some(pilot) = self.pilot.claim(voxel) else { return false };
        self.pilot.set(pilot, spent.max(self.pilot.spent_at(pilot)));
        self.pool.set(place, spent.max(self.pool.spent_at(place)));
        self.whole.empty(voxel);
        self.pilot_count += 1;
        self.pilot_voxels += (spent - before).max(0.0);
        true
    }

    /// Finishes a series of [`Self::take_out`] calls.
    pub(super) fn end_taking_out(&mut self) {
        self.journal.note_everything();
    }

    /// Reserves memory for the partly cut voxels of a tick, if the last one left too little; returns false if
    /// memory runs out.
    pub(in crate::bone) fn make_room(&mut self) -> bool {
        self.pool.make_room()
    }

    /// Undoes all drilling: voxels and their strength, back to the start of the run. Pilot holes stay.
    pub(in crate::bone) fn reset(&mut self) {
        let Self { pool, pilot, occupancy, whole, .. } = self;
        // Only bone absorbs energy, so every voxel with a spent fraction was bone.
        pool.for_each(|voxel, spent| {
            if spent > 0.0 {
                occupancy.fill(voxel);
                whole.fill(voxel);
            }
        });
        pool.clear();
        pilot.for_each(|voxel, spent| {
            if let Some(place) = pool.claim(voxel).filter(|_| spent > 0.0) {
                pool.set(place, spent);
                whole.empty(voxel);
            }
        });
        self.removed.clear();
        self.emptied.clear();
        self.waiting.clear();
        self.removed_total = 0;
        self.journal.note_everything();
    }

    /// Restores a snapshot, earlier or later, of a field with the same CT, parameters and pilot holes;
    /// continues bit for bit.
    pub(in crate::bone) fn restore(&mut self, snapshot: &BoneSnapshot) -> Result<(), BoneError> {
        if snapshot.voxel_count != self.geometry.voxel_count() {
            return Err(BoneError::Snapshot { reason: "the number of voxels differs" });
        }
        if snapshot.pilot_count != self.pilot_count {
            return Err(BoneError::Snapshot { reason: "the pilot holes differ" });
        }
        if snapshot.removed.len() > self.parameters.removed_per_tick
            || snapshot.waiting.len() > self.waiting_limit
        {
            return Err(BoneError::Snapshot { reason: "its removed voxels exceed this field's capacity" });
        }
        self.reset();
        if !self.pool.load(&snapshot.blocks) {
            return Err(BoneError::Snapshot { reason: "its partly cut blocks exceed this field's pool" });
        }
        self.removed.extend_from_slice(&snapshot.removed);
        self.waiting.extend_from_slice(&snapshot.waiting);
        self.removed_total = snapshot.removed_total;
        let Self { pool, occupancy, whole, .. } = self;
        pool.for_each(|voxel, spent| {
            if spent > 0.0 {
                whole.empty(voxel);
            }
            if spent >= 1.0 {
                occupancy.empty(voxel);
            }
        });
        Ok(())
    }
}
