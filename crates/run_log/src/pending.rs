//! Collects the messages of a tick whose state has not arrived yet.

use std::path::Path;

use messages::services::MAX_KEYFRAME_BYTES;
use messages::{Keyframe, Latched, Removed, Reset, Restores, SensorReading, State, Tick};
use zerocopy::FromBytes;

use crate::error::LogError;
use crate::reader::{SavedState, gap, voxel_indices};
use crate::stream::{LogMessage, MessageStream};
use crate::topics::Topic;

/// Maximum number of readings in a tick: all that the sensors of a scene can have in flight, and those of the
/// tick.
const MOST_READINGS: usize = 2065;

const _: () = assert!(MOST_READINGS == messages::MAX_SENSORS * 258 + 1);

/// Messages of a tick whose state has not arrived yet.
#[derive(Default)]
pub(crate) struct Pending {
    pub latched: Option<Latched>,
    pub removals: Vec<(Removed, Vec<u32>)>,
    /// Voxels held so far; a message without voxels counts as one.
    pub held: u64,
    /// Number of removal messages so far; `None` after a gap, where the next number is unknown.
    pub removal_count: Option<u64>,
    pub readings: Vec<SensorReading>,
    /// Sequence number of the last reading; `None` after a gap.
    pub reading_count: Option<u64>,
    /// `removed_total` of the last state.
    pub removed_total: u64,
    /// The last keyframe, possibly still incomplete.
    pub keyframe: Option<(SavedState, usize)>,
    /// Number of keyframe parts so far; `None` after a gap.
    pub keyframe_parts: Option<u64>,
}

impl Pending {
    /// Accepts a message that follows state `last`; returns the state if it is one.
    pub fn take(
        &mut self,
        path: &Path,
        message: &LogMessage<'_>,
        last: Option<Tick>,
    ) -> Result<Option<State>, LogError> {
        match message.known {
            Some(Topic::Latched) => {
                let Ok(latched) = Latched::read_from_bytes(message.body) else { return Ok(None) };
                if let Some(previous) = &self.latched {
                    let found = format!("latched {} follows latched {}", latched.tick, previous.tick);
                    return Err(gap(path, Topic::State, Tick(previous.tick).saturating_add(1), &found));
                }
                let expected = last.unwrap_or(Tick::START);
                if Tick(latched.tick) != expected {
                    return Err(gap(path, Topic::Latched, expected, &format!("latched {}", latched.tick)));
                }
                self.latched = Some(latched);
            }
            Some(Topic::Removed) => {
                let Ok((removed, tail)) = Removed::read_from_prefix(message.body) else { return Ok(None) };
                let expected = self.removal_count.map_or(removed.sequence, |count| count.saturating_add(1));
                self.removal_count = Some(removed.sequence);
                if removed.sequence != expected {
                    let found = format!("message {}, expected {expected}", removed.sequence);
                    return Err(gap(path, Topic::Removed, Tick(removed.tick), &found));
                }
                let tick = last.map_or(Tick::START, |last| last.saturating_add(1));
                if Tick(removed.tick) != tick {
                    return Err(gap(
                        path,
                        Topic::State,
                        tick,
                        &format!("a removal of tick {}", removed.tick),
                    ));
                }
                let voxels = voxel_indices(tail);
                self.held += voxels.len().max(1) as u64;
                self.removals.push((removed, voxels));
            }
            Some(Topic::Sensor) => {
                let Ok(reading) = SensorReading::read_from_bytes(message.body) else { return Ok(None) };
                self.take_reading(path, reading, last)?;
            }
            Some(Topic::Keyframe) => self.take_keyframe_part(path, message.body, last)?,
            Some(Topic::State) => return Ok(State::read_from_bytes(message.body).ok()),
            _ => (),
        }
        Ok(None)
    }

    /// Accepts a reading that follows state `last`.
    fn take_reading(
        &mut self,
        path: &Path,
        reading: SensorReading,
        last: Option<Tick>,
    ) -> Result<(), LogError> {
        let missing = |found: String| gap(path, Topic::Sensor, Tick(reading.tick), &found);
        let expected = self.reading_count.map_or(reading.sequence, |count| count.saturating_add(1));
        self.reading_count = Some(reading.sequence);
        if reading.sequence != expected {
            return Err(missing(format!("reading {}, expected {expected}", reading.sequence)));
        }
        let tick = last.map_or(Tick::START, |last| last.saturating_add(1));
        if Tick(reading.tick) != tick {
            return Err(missing(format!("a reading of tick {} before state {tick}", reading.tick)));
        }
        if self.readings.len() >= MOST_READINGS {
            return Err(missing(format!("more than {MOST_READINGS} readings before state {tick}")));
        }
        self.readings.push(reading);
        Ok(())
    }

    /// Limits memory use for a log that keeps removing voxels without ever writing a state.
    pub fn check_size(&self, stream: &MessageStream, most: u64) -> Result<(), LogError> {
        // A reset without predrilled voxels writes one empty message.
        if self.held <= most.saturating_add(1) {
            return Ok(());
        }
        let cause = format!("removals of {} voxels in a tick, the volume has {most}", self.held);
        Err(LogError::Damaged { path: stream.path().into(), offset: stream.offset(), cause })
    }

    /// Accepts a part of the keyframe of state `last`. If an earlier part is missing, the keyframe is
    /// dropped: it is only a starting point for ticks, and the loss is counted elsewhere.
    pub fn take_keyframe_part(
        &mut self,
        path: &Path,
        body: &[u8],
        last: Option<Tick>,
    ) -> Result<(), LogError> {
        let Ok((head, data)) = Keyframe::read_from_prefix(body) else { return Ok(()) };
        let expected = self.keyframe_parts.map(|parts| parts.saturating_add(1));
        self.keyframe_parts = Some(head.sequence);
        let begun = match &self.keyframe {
            Some((saved, _)) if head.offset_bytes > 0 && saved.tick == Tick(head.tick) => {
                Some(saved.bytes.len())
            }
            _ => None,
        };
        let total = head.total_bytes as usize;
        let fits = begun.unwrap_or(0) == head.offset_bytes as usize
            && head.offset_bytes as usize + data.len() <= total
            && total <= MAX_KEYFRAME_BYTES;
        let is_lost = expected != Some(head.sequence) || (begun.is_none() && head.offset_bytes > 0);
        if Some(Tick(head.tick)) != last || (!fits && !is_lost) {
            let found = format!("part {} of tick {}, byte {}", head.sequence, head.tick, head.offset_bytes);
            return Err(gap(path, Topic::Keyframe, Tick(head.tick), &found));
        }
        if !fits {
            self.keyframe = None;
            return Ok(());
        }
        if begun.is_none() {
            let saved = SavedState { tick: Tick(head.tick), hash: head.hash, bytes: Vec::new() };
            self.keyframe = Some((saved, total));
        }
        if let Some((saved, _)) = &mut self.keyframe {
            saved.bytes.extend_from_slice(data);
        }
        Ok(())
    }

    /// Returns the last keyframe, if it is complete.
    pub fn whole_keyframe(&self) -> Option<&SavedState> {
        let (saved, total) = self.keyframe.as_ref()?;
        (saved.bytes.len() == *total).then_some(saved)
    }

    /// Returns the voxels removed according to a state, and those removed by a preceding reset. In the
    /// initial state, all are predrilled.
    pub fn removed_of(
        &mut self,
        path: &Path,
        state: &State,
        reset: Reset,
    ) -> Result<(Vec<u32>, Option<Vec<u32>>), LogError> {
        let missing = |found: String| gap(path, Topic::Removed, Tick(state.tick), &found);
        let removals = std::mem::take(&mut self.removals);
        self.held = 0;
        let total = removals.last().map_or(self.removed_total, |(removed, _)| removed.removed_total);
        if total != state.removed_total {
            return Err(missing(format!(
                "the messages add up to {total} voxels, the state counts {}",
                state.removed_total
            )));
        }
        self.removed_total = total;
        let restores = removals.iter().any(|(removed, _)| removed.restores() == Restores::Drilled);
        if restores != (reset == Reset::Yes) {
            let word =
                if restores { "voxels restored without a reset" } else { "a reset without restored voxels" };
            return Err(missing(word.to_string()));
        }
        let mut voxels: Vec<u32> = removals.into_iter().flat_map(|(_, voxels)| voxels).collect();
        if state.tick == 0 {
            return Ok((voxels, None));
        }
        let drilled = state.removed_in_tick as usize;
        match voxels.len().checked_sub(drilled) {
            Some(before) if reset == Reset::Yes => {
                let removed = voxels.split_off(before);
                Ok((removed, Some(voxels)))
            }
            Some(0) => Ok((voxels, None)),
            _ => Err(missing(format!("{} voxels, the state counts {drilled} in this tick", voxels.len()))),
        }
    }
}
