//! Parallel verification: a segment is the ticks between two keyframes, and every segment is replayed from its own
//! keyframe.
//!
//! A segment that begins at the recorded keyframe, reproduces every recorded tick and ends in the bytes of the next
//! recorded keyframe proves that stretch. All segments together prove the run, just as one pass from the start would.
//! A segment that fails names its first differing tick and field; the earliest of these is the log's first difference.
//! Segments after a known difference are skipped.

use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};

use messages::layout::Message;
use messages::services::MAX_KEYFRAME_BYTES;
use messages::{Keyframe, Plant, State, Tick};
use zerocopy::IntoBytes;

use crate::difference::{Divergence, compare};
use crate::end::Ending;
use crate::error::LogError;
use crate::reader::{LogReader, RecordedFailure, SavedState, TickRecord};
use crate::topics::Topic;
use crate::verify::{ReplayReport, compare_state, compare_tick};

/// Ticks handed to a worker at once.
const BLOCK_TICKS: usize = 64;
/// Blocks of a segment that may wait: the default interval of 2 s plus a margin.
const SEGMENT_BLOCKS: usize = 40;

const PANICKED: &str = "the simulation panicked (its message is above)";

/// What to verify, and how.
#[derive(Debug, Clone)]
pub struct SegmentOptions {
    /// Keyframe of this log to begin at ([`keyframe_before`]); none for the start.
    pub start: Option<SavedState>,
    /// Last tick (`State.tick`) to replay; none for all.
    pub to_tick: Option<Tick>,
    /// Number of segments replayed in parallel, at least 1.
    pub threads: usize,
}

/// What a parallel replay found.
#[derive(Debug)]
pub struct SegmentReport {
    /// The same report as a replay in one pass; its ticks are those after `first_tick`.
    pub replay: ReplayReport,
    /// `State.tick` at which the replay began.
    pub first_tick: Tick,
    /// Keyframes whose bytes are identical.
    pub identical_keyframes: u64,
    /// Gaps in the log, up to the last tick replayed.
    pub gaps: Vec<Passed>,
}

/// A gap in a log that a replay skipped, or stopped at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Passed {
    /// Last complete tick before the gap; none if the start of the log is missing.
    pub after: Option<Tick>,
    /// Tick of the next keyframe, where the replay resumed; none if there is none.
    pub resumed: Option<Tick>,
}

impl std::fmt::Display for Passed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let first = self.after.map_or(Tick::START, |after| after.saturating_add(1));
        match self.resumed {
            Some(tick) => {
                write!(f, "not replayed: ticks {first} to {tick}; continued at the keyframe of tick {tick}")
            }
            None => {
                write!(
                    f,
                    "not replayed: everything after tick {}, because no keyframe follows",
                    self.after.unwrap_or(Tick::START)
                )
            }
        }
    }
}

/// The last keyframe of a log at or before a tick. Consumes the reader. If the log cannot be read beyond that point, the replay
/// reports why.
pub fn keyframe_before(mut reader: LogReader, tick: Tick) -> Option<SavedState> {
    let mut found = None;
    loop {
        let record = reader.next();
        found = reader.take_keyframe().filter(|saved| saved.tick <= tick).or(found);
        match record {
            Some(Ok(record)) if Tick(record.state.tick) <= tick => (),
            Some(Err(LogError::Gap { .. })) => match reader.go_on() {
                // The keyframe comes with the next tick.
                Ok(Some(behind)) if Tick(behind.state.tick) <= tick => (),
                _ => return found,
            },
            _ => return found,
        }
    }
}

/// Where a segment begins.
struct Start {
    state: Box<State>,
    keyframe: Option<SavedState>,
}

/// A segment whose ticks are still being read.
struct Segment {
    start: Start,
    blocks: Receiver<Block>,
}

enum Block {
    Ticks(Vec<TickRecord>),
    /// The last block: the keyframe of the last tick.
    Keyframe(SavedState),
    /// The last block of the log: the tick that the simulation could not compute.
    Failure(RecordedFailure),
}

/// What reading the log came to.
struct Read {
    /// Tick at which the replay began.
    first_tick: Tick,
    /// Why the log could not be read further.
    log_error: Option<LogError>,
    gaps: Vec<Passed>,
}

/// The result of replaying a segment.
struct Outcome {
    start_tick: Tick,
    identical_ticks: u64,
    keyframes: u64,
    last_tick: Tick,
    hash: [u64; 2],
    /// The simulation failed as it had in the run.
    failure: Option<String>,
    problem: Option<Problem>,
}

enum Problem {
    Differs(Divergence),
    Cannot(Tick, String),
}

/// Replays a log from its start or a keyframe on several threads. Compares the hash, every byte of the state and the
/// removed voxels at every tick, and every byte of each keyframe. `make` builds the simulation of the log's scene;
/// each thread gets its own.
pub fn verify_segments<S: Plant>(
    reader: &mut LogReader,
    make: &(impl Fn() -> Result<S, String> + Sync),
    options: &SegmentOptions,
) -> SegmentReport {
    let bound = AtomicU64::new(options.to_tick.map_or(u64::MAX, |to| to.0));
    let first_tick = options.start.as_ref().or(reader.beginning()).map_or(Tick::START, |start| start.tick);
    let mut gaps = Vec::new();
    let (queue, segments) = sync_channel::<Segment>(1);
    let segments = Mutex::new(segments);
    let (read, outcomes) = std::thread::scope(|scope| {
        let work = || work(make, &segments, &bound);
        let workers: Vec<_> = (0..options.threads.max(1)).map(|_| scope.spawn(work)).collect();
        let read = feed(reader, options, queue, &bound, &mut gaps);
        let outcomes = workers.into_iter().flat_map(|worker| {
            worker.join().unwrap_or_else(|_| vec![Outcome::without_worker(first_tick)]) //
        });
        (read, outcomes.collect())
    });
    let read = Read { first_tick, log_error: read, gaps };
    merge(reader, options, read, outcomes)
}

/// Reads the log and queues its segments, resuming after gaps; returns why the log could not be read further.
fn feed(
    reader: &mut LogReader,
    options: &SegmentOptions,
    queue: SyncSender<Segment>,
    bound: &AtomicU64,
    gaps: &mut Vec<Passed>,
) -> Option<LogError> {
    let mut last = Box::new(*reader.initial());
    let begin = |start: Start| {
        let (blocks, receiver) = sync_channel(SEGMENT_BLOCKS);
        // Sending fails only once every worker has ended, and workers end only when the queue does.
        queue.send(Segment { start, blocks: receiver }).ok().map(|()| blocks)
    };
    let mut blocks = match &options.start {
        None if reader.beginning().is_none() => begin(Start { state: last.clone(), keyframe: None }),
        _ => None,
    };
    // Whether the replay has begun, and the keyframe at which it resumes after a gap.
    let mut has_begun = options.start.is_none();
    let mut resumed = None;
    if let Some(beginning) = reader.beginning() {
        gaps.push(Passed { after: None, resumed: Some(beginning.tick) });
        resumed = Some(beginning.tick);
    }
    let mut waiting = Vec::with_capacity(BLOCK_TICKS);
    loop {
        // A worker that has found a difference stops receiving its segment.
        let hand_over = |blocks: &Option<SyncSender<Block>>, block| {
            if let Some(blocks) = blocks {
                let _ = blocks.send(block);
            }
        };
        let record = if last.tick < bound.load(Ordering::Relaxed) { reader.next() } else { None };
        let keyframe = reader.take_keyframe().filter(|saved| saved.tick.0 == last.tick);
        let starts_here = options.start.as_ref().is_some_and(|start| start.tick.0 == last.tick);
        has_begun |= starts_here;
        let begins_here = starts_here || (has_begun && resumed == Some(Tick(last.tick)));
        if let Some(saved) = keyframe
            && (blocks.is_some() || begins_here)
        {
            hand_over(&blocks, Block::Ticks(std::mem::take(&mut waiting)));
            hand_over(&blocks, Block::Keyframe(saved.clone()));
            let goes_on = matches!(record, Some(Ok(_))) || reader.failure().is_some();
            blocks = goes_on.then(|| begin(Start { state: last.clone(), keyframe: Some(saved) })).flatten();
        }
        match record {
            Some(Ok(record)) => {
                *last = record.state;
                if blocks.is_some() {
                    waiting.push(record);
                }
                if waiting.len() == BLOCK_TICKS {
                    hand_over(&blocks, Block::Ticks(std::mem::take(&mut waiting)));
                }
            }
            Some(Err(LogError::Gap { .. })) => {
                hand_over(&blocks, Block::Ticks(std::mem::take(&mut waiting)));
                blocks = None;
                let after = Some(Tick(last.tick));
                match reader.go_on() {
                    Ok(behind) => {
                        resumed = behind.as_ref().map(|behind| Tick(behind.state.tick));
                        if has_begun {
                            gaps.push(Passed { after, resumed });
                        }
                        last = behind?.state;
                    }
                    Err(error) => return Some(error),
                }
            }
            ended => {
                hand_over(&blocks, Block::Ticks(waiting));
                if let Some(failure) = reader.failure() {
                    hand_over(&blocks, Block::Failure(failure));
                }
                return ended.and_then(Result::err);
            }
        }
    }
}

/// Replays segments until the queue ends.
fn work<S: Plant>(
    make: &impl Fn() -> Result<S, String>,
    segments: &Mutex<Receiver<Segment>>,
    bound: &AtomicU64,
) -> Vec<Outcome> {
    // A panicking worker would leave its segments waiting forever.
    let make =
        || std::panic::catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|_| Err(PANICKED.to_owned()));
    let mut simulation = make();
    let mut outcomes = Vec::new();
    loop {
        let segment = segments.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok(segment) = segment else { return outcomes };
        if segment.start.state.tick >= bound.load(Ordering::Relaxed) {
            continue;
        }
        // A segment from the initial state needs a fresh simulation; this one has already run.
        if segment.start.keyframe.is_none() && !outcomes.is_empty() {
            simulation = make();
        }
        let mut outcome = Outcome::new(&segment.start);
        match &mut simulation {
            Ok(it) => {
                // Restoring a tampered keyframe may panic inside the simulation.
                let replayed = AssertUnwindSafe(|| outcome.replay(it, segment));
                if std::panic::catch_unwind(replayed).is_err() {
                    outcome.problem =
                        Some(Problem::Cannot(outcome.last_tick.saturating_add(1), PANICKED.to_owned()));
                    simulation = Err(PANICKED.to_owned());
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

    /// The outcome of a worker that died: nothing it replayed is proven.
    fn without_worker(start_tick: Tick) -> Outcome {
        Outcome {
            start_tick,
            identical_ticks: 0,
            keyframes: 0,
            last_tick: start_tick,
            hash: [0; 2],
            failure: None,
            problem: Some(Problem::Cannot(start_tick, PANICKED.to_owned())),
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

/// Merges the segments in order, up to the first problem.
fn merge(
    reader: &LogReader,
    options: &SegmentOptions,
    read: Read,
    mut outcomes: Vec<Outcome>,
) -> SegmentReport {
    let Read { first_tick, log_error, gaps } = read;
    outcomes.sort_by_key(|outcome| outcome.start_tick);
    let mut report = SegmentReport {
        replay: ReplayReport {
            identical_ticks: 0,
            last_tick: first_tick,
            simulated_ns: 0,
            hash: options.start.as_ref().map_or(reader.initial().hash, |start| start.hash),
            divergence: None,
            simulation_error: None,
            failure: None,
            log_error,
            ending: Ending::default(),
        },
        first_tick,
        identical_keyframes: 0,
        gaps,
    };
    let replay = &mut report.replay;
    for outcome in outcomes {
        replay.identical_ticks += outcome.identical_ticks;
        replay.last_tick = outcome.last_tick;
        replay.hash = outcome.hash;
        replay.failure = outcome.failure;
        report.identical_keyframes += outcome.keyframes;
        if let Some(problem) = outcome.problem {
            // Problems after it do not matter.
            replay.log_error = None;
            match problem {
                Problem::Differs(divergence) => replay.divergence = Some(divergence),
                Problem::Cannot(tick, cause) => replay.simulation_error = Some((tick, cause)),
            }
            break;
        }
    }
    let last_tick = replay.last_tick;
    report.gaps.retain(|gap| gap.after.is_none_or(|after| after <= last_tick));
    if replay.is_identical() {
        replay.ending = reader.ending().clone();
    }
    replay.simulated_ns = replay.identical_ticks.saturating_mul(reader.header().dt_ns);
    report
}
