//! A worker thread that replays one segment after the other.

use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Mutex, PoisonError};

use messages::services::MAX_KEYFRAME_BYTES;
use messages::{Latched, Plant, State, Tick};

use crate::difference::Divergence;
use crate::reader::{RecordedFailure, SavedState, TickRecord};
use crate::verify::{compare_keyframe, compare_state, compare_tick};

pub const PANICKED: &str = "the simulation panicked (its message is above)";

/// Where a segment begins.
pub(super) struct Start {
    pub state: Box<State>,
    pub keyframe: Option<SavedState>,
}

/// A segment whose ticks are still being read.
pub(super) struct Segment {
    pub start: Start,
    pub blocks: Receiver<Block>,
}

pub(super) enum Block {
    Ticks(Vec<TickRecord>),
    /// Ticks that are only stepped, not compared.
    Commands(Vec<Latched>),
    /// The last block: the keyframe of the last tick.
    Keyframe(SavedState),
    /// The last block of the log: the tick that the simulation failed to compute.
    Failure(RecordedFailure),
}

/// The result of replaying a segment.
pub(super) struct Outcome {
    pub start_tick: Tick,
    pub identical_ticks: u64,
    pub keyframes: u64,
    pub last_tick: Tick,
    pub hash: [u64; 2],
    /// Set if the simulation failed as it had in the run.
    pub failure: Option<String>,
    pub problem: Option<Problem>,
}

pub(super) enum Problem {
    Differs(Divergence),
    Cannot(Tick, String),
}

/// Replays segments until the queue ends.
pub(super) fn work<S: Plant>(
    make: &impl Fn() -> Result<S, String>,
    segments: &Mutex<Receiver<Segment>>,
    bound: &AtomicU64,
) -> Vec<Outcome> {
    // If a worker panicked, its segments would wait forever.
    let make =
        || std::panic::catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|_| Err(PANICKED.to_owned()));
    // Built only once there is something to replay: a log without keyframes needs a single simulation on any
    // number of threads.
    let mut built = None;
    let mut outcomes = Vec::new();
    loop {
        let segment = segments.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok(segment) = segment else { return outcomes };
        if segment.start.state.tick >= bound.load(Ordering::Relaxed) {
            continue;
        }
        // A segment from the initial state needs a fresh simulation; this one has already run.
        if segment.start.keyframe.is_none() && !outcomes.is_empty() {
            built = None;
        }
        let mut outcome = Outcome::new(&segment.start);
        let simulation = built.get_or_insert_with(make);
        match simulation {
            Ok(it) => {
                // Restoring a tampered keyframe may panic inside the simulation.
                let replayed = AssertUnwindSafe(|| outcome.replay(it, segment));
                if std::panic::catch_unwind(replayed).is_err() {
                    outcome.problem =
                        Some(Problem::Cannot(outcome.last_tick.saturating_add(1), PANICKED.to_owned()));
                    *simulation = Err(PANICKED.to_owned());
                }
            }
            Err(cause) => outcome.problem = Some(Problem::Cannot(outcome.start_tick, cause.clone())),
        }
        if let Some(problem) = &outcome.problem {
            bound.fetch_min(problem.tick().0, Ordering::Relaxed);
        }
        outcomes.push(outcome);
    }
}

impl Outcome {
    fn new(start: &Start) -> Outcome {
        Outcome {
            start_tick: Tick(start.state.tick),
            identical_ticks: 0,
            keyframes: 0,
            last_tick: Tick(start.state.tick),
            hash: start.state.hash,
            failure: None,
            problem: None,
        }
    }

    /// Returns the outcome of a worker that died, or of none that could be started: nothing is proven.
    pub fn without_worker(start_tick: Tick, cause: String) -> Outcome {
        Outcome {
            start_tick,
            identical_ticks: 0,
            keyframes: 0,
            last_tick: start_tick,
            hash: [0; 2],
            failure: None,
            problem: Some(Problem::Cannot(start_tick, cause)),
        }
    }

    fn replay<S: Plant>(&mut self, simulation: &mut S, segment: Segment) {
        let Segment { start, blocks } = segment;
        let resumed = start.keyframe.map_or(Ok(()), |saved| simulation.restore_keyframe(&saved.bytes));
        self.problem = match resumed {
            Ok(()) => compare_state(&start.state, simulation.state()).map(Problem::Differs),
            Err(cause) => Some(Problem::Cannot(self.start_tick, cause.to_string())),
        };
        while self.problem.is_none() {
            let Ok(block) = blocks.recv() else { return };
            self.problem = match block {
                Block::Ticks(ticks) => ticks.iter().find_map(|tick| self.tick(simulation, tick)),
                Block::Commands(all) => all.iter().find_map(|latched| self.step(simulation, latched)),
                Block::Keyframe(saved) => self.keyframe(simulation, &saved),
                Block::Failure(failure) => self.failure(simulation, failure),
            };
        }
    }

    fn tick<S: Plant>(&mut self, simulation: &mut S, recorded: &TickRecord) -> Option<Problem> {
        if let Err(cause) = simulation.step(&recorded.latched) {
            return Some(Problem::Cannot(Tick(recorded.state.tick), cause.to_string()));
        }
        if let Some(divergence) = compare_tick(recorded, simulation) {
            return Some(Problem::Differs(divergence));
        }
        self.identical_ticks += 1;
        self.last_tick = Tick(recorded.state.tick);
        self.hash = recorded.state.hash;
        None
    }

    fn step<S: Plant>(&mut self, simulation: &mut S, latched: &Latched) -> Option<Problem> {
        if let Err(cause) = simulation.step(latched) {
            return Some(Problem::Cannot(Tick(latched.tick).saturating_add(1), cause.to_string()));
        }
        self.identical_ticks += 1;
        (self.last_tick, self.hash) = (Tick(simulation.state().tick), simulation.state().hash);
        None
    }

    fn failure<S: Plant>(&mut self, simulation: &mut S, recorded: RecordedFailure) -> Option<Problem> {
        match recorded.reproduce(simulation) {
            Ok(()) => {
                self.failure = Some(recorded.text);
                None
            }
            Err(other) => Some(Problem::Cannot(Tick(recorded.latched.tick), other)),
        }
    }

    fn keyframe<S: Plant>(&mut self, simulation: &mut S, recorded: &SavedState) -> Option<Problem> {
        let mut buffer = vec![0; MAX_KEYFRAME_BYTES];
        match simulation.write_keyframe(&mut buffer) {
            Err(cause) => Some(Problem::Cannot(recorded.tick, cause.to_string())),
            Ok(length) => {
                let bytes = buffer[..length].to_vec();
                let replayed =
                    SavedState { tick: Tick(simulation.state().tick), hash: simulation.state().hash, bytes };
                self.keyframes += u64::from(replayed == *recorded);
                compare_keyframe(recorded, &replayed).map(Problem::Differs)
            }
        }
    }
}

impl Problem {
    fn tick(&self) -> Tick {
        match self {
            Problem::Differs(divergence) => divergence.tick,
            Problem::Cannot(tick, _) => *tick,
        }
    }
}
