//! Result of a replay: where its ticks differ from the log's.

use messages::layout::Message;
use messages::{Keyframe, Plant, SensorReading, State, Tick};
use zerocopy::IntoBytes;

use crate::difference::{Divergence, compare, compare_removed};
use crate::end::Ending;
use crate::error::LogError;
use crate::reader::{SavedState, TickRecord};
use crate::topics::Topic;

/// Result of a replay.
#[derive(Debug)]
pub struct ReplayReport {
    /// Ticks whose hash, state bytes, removals and readings are identical.
    pub identical_ticks: u64,
    /// `State.tick` of the last identical tick.
    pub last_tick: Tick,
    /// Simulated time of the identical ticks.
    pub simulated_ns: u64,
    /// Chained hash of the last identical state, low word first.
    pub hash: [u64; 2],
    /// The first tick that differs.
    pub divergence: Option<Divergence>,
    /// Tick that the simulation failed to compute, and why.
    pub simulation_error: Option<(Tick, String)>,
    /// Set if the simulation failed after the last tick, as it had in the run: which tick, and why.
    pub failure: Option<String>,
    /// Why the log could not be read further (a gap, damage).
    pub log_error: Option<LogError>,
    /// How the file ends, if it was read to its end.
    pub ending: Ending,
}

impl ReplayReport {
    /// Returns true if nothing differs and no error stopped the replay.
    pub fn is_identical(&self) -> bool {
        self.divergence.is_none() && self.simulation_error.is_none() && self.log_error.is_none()
    }
}

/// Compares a simulation's last tick with the recorded one.
pub fn compare_tick(recorded: &TickRecord, replayed: &impl Plant) -> Option<Divergence> {
    compare_state(&recorded.state, replayed.state())
        .or_else(|| compare_removed(Tick(recorded.state.tick), &recorded.removed, replayed.removed()))
        .or_else(|| compare_readings(Tick(recorded.state.tick), &recorded.readings, replayed.readings()))
}

/// Compares the readings of a tick.
pub fn compare_readings(
    tick: Tick,
    recorded: &[SensorReading],
    replayed: &[SensorReading],
) -> Option<Divergence> {
    (0..recorded.len().max(replayed.len())).find_map(|i| {
        let bytes =
            |readings: &[SensorReading]| readings.get(i).map(|r| r.as_bytes().to_vec()).unwrap_or_default();
        compare(Topic::Sensor, tick, SensorReading::DESCRIPTION, &bytes(recorded), &bytes(replayed))
    })
}

/// Compares two states of a tick.
pub fn compare_state(recorded: &State, replayed: &State) -> Option<Divergence> {
    let (a, b) = (recorded.as_bytes(), replayed.as_bytes());
    compare(Topic::State, Tick(recorded.tick), State::DESCRIPTION, a, b)
}

/// Compares two keyframes.
pub fn compare_keyframe(recorded: &SavedState, replayed: &SavedState) -> Option<Divergence> {
    let message = |saved: &SavedState| {
        let head = Keyframe {
            tick: saved.tick.0,
            hash: saved.hash,
            total_bytes: saved.bytes.len() as u32,
            data_length: saved.bytes.len() as u32,
            ..Keyframe::zeroed()
        };
        [head.as_bytes(), &saved.bytes].concat()
    };
    let (a, b) = (message(recorded), message(replayed));
    compare(Topic::Keyframe, recorded.tick, Keyframe::DESCRIPTION, &a, &b)
}
