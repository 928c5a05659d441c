//! Changes voxels: every function that does so is in this file and records the change in the journal.

use super::journal::{Ball, Region};
use super::{BoneSnapshot, Voxels};
use crate::bone::BoneError;
use crate::bone::drilling::is_ended;
use crate::bone::grid::VoxelIndex;
use crate::bone::occupancy::VoxelBox;
use crate::bone::strength::Place;

/// One tick of drilling. On drop it records in the journal what changed.
pub(in crate::bone) struct Drilling<'v> {
    voxels: &'v mut Voxels,
    /// Where voxels may be cut, and whether any was.
    ball: Ball,
    cut: bool,
    /// What has changed outside the ball.
    changed: VoxelBox,
}

impl core::ops::Deref for Drilling<'_> {
    type Target = Voxels;

    fn deref(&self) -> &Voxels {
        self.voxels
    }
}

impl Drop for Drilling<'_> {
    fn drop(&mut self) {
        let ball = self.cut.then_some(self.ball);
        self.voxels.journal.end(Region { ball, voxels: self.changed });
    }
}

impl Drilling<'_> {
    /// Where the voxel's spent fraction is stored, taking a block if needed; `None` if there are no more.
    pub fn claim(&mut self, voxel: VoxelIndex) -> Option<Place> {
        self.voxels.pool.claim(self.voxels.geometry.voxel(voxel))
    }

    /// Sets the spent fraction of a voxel whose box meets the edit's ball.
    #[inline]
    pub fn set_spent(&mut self, place: Place, spent: f64) {
        self.cut = true;
        self.set(place, spent);
    }

    /// True if another voxel may be queued for removal.
    pub fn has_room(&self) -> bool {
        self.voxels.waiting.len() < self.voxels.waiting_limit
    }

    /// Queues a spent voxel for removal, if [`Self::has_room`].
    pub fn queue(&mut self, voxel: VoxelIndex) {
        self.voxels.waiting.push(voxel);
    }

    /// Spends the rest of a voxel, whether or not it meets the ball, and queues it for removal.
    pub fn shed(&mut self, voxel: VoxelIndex, place: Place) {
        self.set(place, 1.0);
        self.queue(voxel);
        self.note(voxel);
    }

    /// Sets the spent fraction of a voxel anywhere, and queues it for removal if all of it is spent; false if there is no memory for it.
    pub fn crush(&mut self, voxel: VoxelIndex, spent: f64) -> bool {
        let Some(place) = self.claim(voxel) else { return false };
        let ended = is_ended(spent);
        let queued = ended && self.has_room();
        // If the queue is full, the voxel keeps a trace of strength and ends in a later tick.
        let spent = if queued { 1.0 } else { spent.min(1.0 - 1e-9) };
        self.set(place, spent);
        if queued {
            self.queue(voxel);
        }
        self.note(voxel);
        true
    }

    /// Removes queued voxels, up to the tick's limit.
    pub fn remove_queued(&mut self) {
        let count = self.voxels.waiting.len().min(self.voxels.parameters.removed_per_tick);
        for place in 0..count {
            let voxel = self.voxels.waiting[place];
            self.voxels.occupancy.empty(self.voxels.geometry.voxel(voxel));
            self.note(voxel);
            self.voxels.removed.push(voxel);
        }
        self.voxels.waiting.drain(..count);
        self.voxels.removed_total += count as u64;
    }

    #[inline(always)]
    fn set(&mut self, place: Place, spent: f64) {
        if self.voxels.pool.set(place, spent) {
            self.note_first_cut(place);
        }
    }

    #[cold]
    fn note_first_cut(&mut self, place: Place) {
        if let Some(voxel) = self.voxels.pool.voxel_at(place) {
            self.voxels.whole.empty(voxel);
            self.voxels.journal.note_first_cut(voxel.map(|x| x as i64));
        }
    }

    fn note(&mut self, voxel: VoxelIndex) {
        let voxel = self.voxels.geometry.voxel(voxel).map(|x| x as i64);
        self.changed = self.changed.with(voxel);
    }
}

impl Voxels {
    /// Begins a tick of drilling that cuts voxels whose boxes meet `ball`.
    pub(in crate::bone) fn drill(&mut self, ball: Ball) -> Drilling<'_> {
        self.journal.begin(self.pool.used());
        self.removed.clear();
        Drilling { voxels: self, ball, cut: false, changed: VoxelBox::NOTHING }
    }

    /// Removes voxels from the bone permanently.
    pub(super) fn take_out(&mut self, voxels: &[[usize; 3]]) {
        for voxel in voxels {
            self.occupancy.empty(*voxel);
            self.whole.empty(*voxel);
            self.pool.forget(*voxel);
        }
        self.predrilled_count += voxels.len() as u64;
        self.journal.note_everything();
    }

    /// Takes memory for the partly cut voxels of a tick, if the last one has left too little; false if the system gives none.
    pub(in crate::bone) fn make_room(&mut self) -> bool {
        self.pool.make_room()
    }

    /// Undoes all drilling: voxels and their strength, back to the start of the run. Pilot holes stay.
    pub(in crate::bone) fn reset(&mut self) {
        let Self { pool, occupancy, whole, .. } = self;
        // Only bone absorbs energy, so every voxel with a spent fraction was bone.
        pool.for_each(|voxel, spent| {
            if spent > 0.0 {
                occupancy.fill(voxel);
                whole.fill(voxel);
            }
        });
        self.pool.clear();
        self.removed.clear();
        self.waiting.clear();
        self.removed_total = 0;
        self.journal.note_everything();
    }

    /// Restores a snapshot, earlier or later, of a field with the same CT, parameters and pilot holes; continues bit for bit.
    pub(in crate::bone) fn restore(&mut self, snapshot: &BoneSnapshot) -> Result<(), BoneError> {
        if snapshot.voxel_count != self.geometry.voxel_count() {
            return Err(BoneError::Snapshot { reason: "it has another number of voxels" });
        }
        if snapshot.predrilled_count != self.predrilled_count {
            return Err(BoneError::Snapshot { reason: "it has other pilot holes" });
        }
        if snapshot.removed.len() > self.parameters.removed_per_tick
            || snapshot.waiting.len() > self.waiting_limit
        {
            return Err(BoneError::Snapshot { reason: "its removed voxels exceed this field's capacity" });
        }
        self.reset();
        if !self.pool.load(&snapshot.blocks, &snapshot.spent) {
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
        for voxel in &self.waiting {
            self.occupancy.fill(self.geometry.voxel(*voxel));
        }
        Ok(())
    }
}
