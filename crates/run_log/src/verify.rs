//! Replay: steps a simulation through a log's latched commands and compares every tick.

use messages::layout::Message;
use messages::{Keyframe, Plant, SensorReading, State, Tick};
use zerocopy::IntoBytes;

use crate::difference::{Divergence, compare, compare_removed};
use crate::end::Ending;
use crate::error::LogError;
use crate::reader::{LogReader, SavedState, TickRecord};
use crate::topics::Topic;

/// How far to replay.
#[derive(Debug, Clone, Copy, Default)]
pub struct VerifyOptions {
    /// Maximum number of ticks to replay; none for all.
    pub max_ticks: Option<u64>,
}

/// What a replay found.
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
    /// The simulation failed behind the last tick, as it had in the run: which tick, and why.
    pub failure: Option<String>,
    /// Why the log could not be read further (a gap, damage).
    pub log_error: Option<LogError>,
    /// How the file ends, if it was read to its end.
    pub ending: Ending,
}

impl ReplayReport {
    /// True if nothing differs and no error stopped the replay.
    pub fn is_identical(&self) -> bool {
        self.divergence.is_none() && self.simulation_error.is_none() && self.log_error.is_none()
    }
}

/// Replays a log and compares the hash, every byte of the state, the removed voxels and the sensors' readings at every tick, up to the first
/// difference. Does no timing; that is the caller's job.
pub fn verify(reader: &mut LogReader, simulation: &mut impl Plant, options: VerifyOptions) -> ReplayReport {
    let mut report = ReplayReport {
        identical_ticks: 0,
        last_tick: Tick::START,
        simulated_ns: 0,
        hash: reader.initial().hash,
        divergence: compare_state(reader.initial(), simulation.state()),
        simulation_error: None,
        failure: None,
        log_error: None,
        ending: Ending::default(),
    };
    while report.divergence.is_none() && options.max_ticks.is_none_or(|most| report.identical_ticks < most) {
        match reader.next() {
            None => {
                report.ending = reader.ending().clone();
                if let Some(failure) = reader.failure() {
                    match failure.reproduce(simulation) {
                        Ok(()) => report.failure = Some(failure.text),
                        Err(other) => report.simulation_error = Some((Tick(failure.latched.tick), other)),
                    }
                }
                break;
            }
            Some(Err(error)) => {
                report.log_error = Some(error);
                break;
            }
            Some(Ok(tick)) => {
                if let Err(cause) = simulation.step(&tick.latched) {
                    report.simulation_error = Some((Tick(tick.state.tick), cause.to_string()));
                    break;
                }
                report.divergence = compare_tick(&tick, simulation);
                if report.divergence.is_none() {
                    report.identical_ticks += 1;
                    report.last_tick = Tick(tick.state.tick);
                    report.hash = tick.state.hash;
                }
            }
        }
    }
    report.simulated_ns = report.identical_ticks.saturating_mul(reader.header().dt_ns);
    report
}

/// Where a simulation's last tick differs from the recorded one.
pub fn compare_tick(recorded: &TickRecord, replayed: &impl Plant) -> Option<Divergence> {
    compare_state(&recorded.state, replayed.state())
        .or_else(|| compare_removed(Tick(recorded.state.tick), &recorded.removed, replayed.removed()))
        .or_else(|| compare_readings(Tick(recorded.state.tick), &recorded.readings, replayed.readings()))
}

/// Where the readings of a tick differ.
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

/// Where two states of a tick differ.
pub fn compare_state(recorded: &State, replayed: &State) -> Option<Divergence> {
    let (a, b) = (recorded.as_bytes(), replayed.as_bytes());
    compare(Topic::State, Tick(recorded.tick), State::DESCRIPTION, a, b)
}

/// Where two keyframes differ.
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
