//! Buffers removed voxels from their arrival until the first frame without them.

use std::collections::VecDeque;

use messages::{Restores, Tick};
use thiserror::Error;

/// The voxels removed in one tick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemovedBatch {
    /// The tick; 0 for the scene's predrilled voxels.
    pub tick: Tick,
    /// Number of the batch: 1, 2, 3 and so on.
    pub sequence: u64,
    /// Number of voxels removed up to and including this tick.
    pub total: u64,
    /// What was restored before.
    pub restores: Restores,
    /// Linear indices.
    pub voxels: Vec<u32>,
}

/// Changes since the last frame.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RemovalDelta {
    /// What to restore before removing `voxels`.
    pub restores: Restores,
    /// Linear indices in order of removal; after a restore, the predrilled voxels come first.
    pub voxels: Vec<u32>,
}

/// Removed voxels were lost: frames would show bone that is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum RemovalLoss {
    /// The newest batches have not arrived.
    #[error("tick {tick}: {expected} voxels were removed, but only {received} were received")]
    Voxels {
        /// Tick of the state.
        tick: Tick,
        /// Voxels that the physics removed.
        expected: u64,
        /// Voxels received.
        received: u64,
    },
    /// A batch in between has not arrived: the queue has overflowed.
    #[error("tick {tick}: removed voxels lost: message {received} follows message {before}")]
    Batch {
        /// Tick of the batch after it.
        tick: Tick,
        /// Number of the batch before it; 0 if it is the first.
        before: u64,
        /// Number of the batch after it.
        received: u64,
    },
}

/// Matches removed voxels to the states they belong to.
#[derive(Debug, Default)]
pub struct Removals {
    waiting: VecDeque<RemovedBatch>,
    predrilled: Vec<u32>,
    since: RemovalDelta,
    total: u64,
    /// Number of the newest batch.
    sequence: u64,
    gap: Option<RemovalLoss>,
}

impl Removals {
    /// Queues a batch. Batches must arrive in tick order.
    pub fn receive(&mut self, batch: RemovedBatch) {
        let (before, received) = (self.sequence, batch.sequence);
        // Totals do not reveal the loss if the states in between are lost too.
        if received != before + 1 {
            self.gap.get_or_insert(RemovalLoss::Batch { tick: batch.tick, before, received });
        }
        self.sequence = received;
        self.waiting.push_back(batch);
    }

    /// Applies the batches up to the state of `tick`, by which `removed_total` voxels have been removed.
    ///
    /// # Errors
    /// If batches are missing.
    pub fn advance(&mut self, tick: Tick, removed_total: u64) -> Result<(), RemovalLoss> {
        // The missing ones may belong to this state.
        self.gap.map_or(Ok(()), Err)?;
        while self.waiting.front().is_some_and(|batch| batch.tick <= tick) {
            let Some(batch) = self.waiting.pop_front() else { break };
            if batch.restores == Restores::Drilled {
                self.since.restores = Restores::Drilled;
                self.since.voxels.clone_from(&self.predrilled);
            }
            if batch.tick == Tick::START {
                self.predrilled.extend_from_slice(&batch.voxels);
            }
            self.since.voxels.extend_from_slice(&batch.voxels);
            self.total = batch.total;
        }
        if self.total == removed_total {
            return Ok(());
        }
        Err(RemovalLoss::Voxels { tick, expected: removed_total, received: self.total })
    }

    /// Returns the changes since the last call, up to the tick of the last [`Removals::advance`].
    pub fn take(&mut self) -> RemovalDelta {
        std::mem::take(&mut self.since)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(sequence: u64, tick: u64, total: u64, voxels: &[u32]) -> RemovedBatch {
        let (tick, restores) = (Tick(tick), Restores::Nothing);
        RemovedBatch { tick, sequence, total, restores, voxels: voxels.to_vec() }
    }

    fn since(voxels: &[u32]) -> RemovalDelta {
        RemovalDelta { restores: Restores::Nothing, voxels: voxels.to_vec() }
    }

    #[test]
    fn a_frame_shows_the_voxels_up_to_its_tick_and_none_after_it() {
        let mut removals = Removals::default();
        for batch in [batch(1, 0, 2, &[1, 2]), batch(2, 5, 3, &[3]), batch(3, 6, 5, &[5, 4])] {
            removals.receive(batch);
        }
        removals.advance(Tick(0), 2).unwrap();
        assert_eq!(removals.take(), since(&[1, 2]));
        removals.advance(Tick(4), 2).unwrap();
        assert_eq!(removals.take(), since(&[]));
        removals.advance(Tick(5), 3).unwrap();
        removals.advance(Tick(6), 5).unwrap();
        assert_eq!(removals.take(), since(&[3, 5, 4]));
    }

    #[test]
    fn after_a_reset_only_the_predrilled_voxels_and_newer_ones_are_gone() {
        let mut removals = Removals::default();
        removals.receive(batch(1, 0, 1, &[7]));
        removals.receive(batch(2, 3, 2, &[8]));
        removals.advance(Tick(3), 2).unwrap();
        removals.take();
        removals.receive(RemovedBatch { restores: Restores::Drilled, ..batch(3, 4, 1, &[]) });
        removals.receive(batch(4, 5, 2, &[9]));
        removals.advance(Tick(5), 2).unwrap();
        assert_eq!(removals.take(), RemovalDelta { restores: Restores::Drilled, voxels: vec![7, 9] });
        assert_eq!(removals.take(), since(&[]));
    }

    #[test]
    fn a_lost_batch_is_an_error_with_both_counts() {
        let mut removals = Removals::default();
        removals.receive(batch(1, 0, 4, &[1, 2, 3, 4]));
        let lost = removals.advance(Tick(9), 6).unwrap_err();
        assert_eq!(lost, RemovalLoss::Voxels { tick: Tick(9), expected: 6, received: 4 });
        assert_eq!(lost.to_string(), "tick 9: 6 voxels were removed, but only 4 were received");
    }

    #[test]
    fn a_batch_lost_in_between_is_an_error_although_the_totals_agree() {
        let mut removals = Removals::default();
        removals.receive(batch(1, 0, 0, &[1]));
        removals.advance(Tick(0), 0).unwrap();
        removals.receive(batch(3, 8, 5, &[6, 7]));
        // It is unknown whether the lost batch belongs to this state.
        let lost = removals.advance(Tick(7), 0).unwrap_err();
        assert_eq!(lost.to_string(), "tick 8: removed voxels lost: message 3 follows message 1");
    }
}
