//! Parallel verification: a segment is the ticks between two keyframes, and every segment is replayed from
//! its own keyframe.
//!
//! A segment that begins at the recorded keyframe, reproduces every recorded tick and ends in the bytes of
//! the next recorded keyframe proves that part of the run. All segments together prove the run, as one pass
//! from the start would. A segment that fails names its first differing tick and field; the earliest of these
//! is the log's first difference. Segments after a known difference are skipped.
//!
//! [`step_segments`] only steps the ticks, with the same proof at a coarser grain: a segment that ends in the
//! bytes of the next keyframe has reached the state in which the next segment began, as one pass from the
//! start would have.

mod work;

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};

use messages::{Latched, Plant, Tick};

use crate::end::Ending;
use crate::error::LogError;
use crate::reader::{LogReader, SavedState, TickRecord};
use crate::verify::ReplayReport;
use work::{Block, Outcome, PANICKED, Problem, Segment, Start, work};

/// Ticks handed to a worker at once.
const BLOCK_TICKS: usize = 64;
/// Blocks of a segment that may wait: the default interval of 2 s plus a margin.
const SEGMENT_BLOCKS: usize = 40;

/// What to verify, and how.
#[derive(Debug, Clone)]
pub struct SegmentOptions {
    /// Keyframe of this log to begin at ([`keyframe_before`]); `None` for the start.
    pub start: Option<SavedState>,
    /// Last tick (`State.tick`) to replay; `None` for all.
    pub to_tick: Option<Tick>,
    /// Number of segments replayed in parallel, at least 1.
    pub threads: usize,
}

/// Result of a parallel replay.
#[derive(Debug)]
pub struct SegmentReport {
    /// The same report as a replay in one pass; its ticks are those after `first_tick`.
    pub replay: ReplayReport,
    /// `State.tick` at which the replay began.
    pub first_tick: Tick,
    /// Keyframes whose bytes are identical.
    pub identical_keyframes: u64,
    /// Gaps in the log, up to the last tick replayed.
    pub gaps: Vec<SkippedGap>,
}

/// A gap in a log that a replay skipped, or stopped at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SkippedGap {
    /// Last complete tick before the gap; `None` if the start of the log is missing.
    pub after: Option<Tick>,
    /// Tick of the next keyframe, where the replay resumed; `None` if no keyframe follows.
    pub resumed: Option<Tick>,
}

impl SkippedGap {
    /// Returns the gap at the start of a log that begins later than its header says.
    pub fn before_first(reader: &LogReader) -> Option<SkippedGap> {
        let beginning = reader.beginning().filter(|saved| saved.tick != reader.header().first_tick)?;
        Some(SkippedGap { after: None, resumed: Some(beginning.tick) })
    }
}

impl std::fmt::Display for SkippedGap {
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

/// Returns the last keyframe of a log at or before a tick. Consumes the reader. If the log cannot be read
/// beyond that point, the replay reports why.
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

/// Extent of the comparison with the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ComparisonScope {
    Ticks,
    /// Only the state in which a segment begins, and the keyframe in which it ends.
    Keyframes,
}

/// Ticks that have been read but not handed to a worker.
struct Waiting {
    compared: ComparisonScope,
    ticks: Vec<TickRecord>,
    commands: Vec<Latched>,
}

impl Waiting {
    fn new(compared: ComparisonScope) -> Waiting {
        Waiting { compared, ticks: Vec::new(), commands: Vec::new() }
    }

    /// Stores a tick; returns a block once there are enough.
    fn keep(&mut self, record: TickRecord) -> Option<Block> {
        // Grown block by block: a block that was handed over has taken its memory along.
        match self.compared {
            ComparisonScope::Ticks => {
                self.ticks.reserve_exact(BLOCK_TICKS - self.ticks.len());
                self.ticks.push(record);
            }
            ComparisonScope::Keyframes => {
                self.commands.reserve_exact(BLOCK_TICKS - self.commands.len());
                self.commands.push(record.latched);
            }
        }
        (self.ticks.len().max(self.commands.len()) == BLOCK_TICKS).then(|| self.take())
    }

    fn take(&mut self) -> Block {
        match self.compared {
            ComparisonScope::Ticks => Block::Ticks(std::mem::take(&mut self.ticks)),
            ComparisonScope::Keyframes => Block::Commands(std::mem::take(&mut self.commands)),
        }
    }
}

/// Result of reading the log.
struct Read {
    /// Tick at which the replay began.
    first_tick: Tick,
    /// Why the log could not be read further.
    log_error: Option<LogError>,
    gaps: Vec<SkippedGap>,
}

/// Replays a log from its start or a keyframe on several threads. Compares the hash, every byte of the state
/// and the removed voxels at every tick, and every byte of each keyframe. `make` builds the simulation of the
/// log's scene; each thread gets its own.
pub fn verify_segments<S: Plant>(
    reader: &mut LogReader,
    make: &(impl Fn() -> Result<S, String> + Sync),
    options: &SegmentOptions,
) -> SegmentReport {
    replay_segments(reader, make, options, ComparisonScope::Ticks)
}

/// Steps a log on several threads without comparing its ticks, and returns the result of stepping it in one
/// pass. Returns `None` if the result is uncertain: the log has a gap or damage, the simulation fails
/// differently from the run, or a segment does not end in the keyframe that the next one began with. The
/// caller then steps the log in one pass.
pub fn step_segments<S: Plant>(
    reader: &mut LogReader,
    make: &(impl Fn() -> Result<S, String> + Sync),
    options: &SegmentOptions,
) -> Option<SegmentReport> {
    let mut report = replay_segments(reader, make, options, ComparisonScope::Keyframes);
    report.identical_keyframes = 0;
    (report.replay.is_identical() && report.gaps.is_empty()).then_some(report)
}

fn replay_segments<S: Plant>(
    reader: &mut LogReader,
    make: &(impl Fn() -> Result<S, String> + Sync),
    options: &SegmentOptions,
    compared: ComparisonScope,
) -> SegmentReport {
    let bound = AtomicU64::new(options.to_tick.map_or(u64::MAX, |to| to.0));
    let first_tick = options.start.as_ref().or(reader.beginning()).map_or(Tick::START, |start| start.tick);
    let mut gaps = Vec::new();
    let (queue, segments) = sync_channel::<Segment>(1);
    let segments = Mutex::new(segments);
    let (read, outcomes) = std::thread::scope(|scope| {
        let work = || work(make, &segments, &bound);
        let mut workers = Vec::new();
        for number in 0..options.threads.max(1) {
            let thread = std::thread::Builder::new().name(format!("replay-{number}"));
            match thread.spawn_scoped(scope, work) {
                Ok(worker) => workers.push(worker),
                // Fewer threads take longer, and find the same.
                Err(_) if number > 0 => break,
                Err(cause) => {
                    let cause = format!("no thread can be started: {cause}");
                    return (None, vec![Outcome::without_worker(first_tick, cause)]);
                }
            }
        }
        let read = feed(reader, options, queue, &bound, (Waiting::new(compared), &mut gaps));
        let died = || vec![Outcome::without_worker(first_tick, PANICKED.to_owned())];
        let outcomes = workers.into_iter().flat_map(|worker| worker.join().unwrap_or_else(|_| died()));
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
    (mut waiting, gaps): (Waiting, &mut Vec<SkippedGap>),
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
        gaps.extend(SkippedGap::before_first(reader));
        resumed = Some(beginning.tick);
    }
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
            hand_over(&blocks, waiting.take());
            hand_over(&blocks, Block::Keyframe(saved.clone()));
            let goes_on = matches!(record, Some(Ok(_))) || reader.failure().is_some();
            blocks = goes_on.then(|| begin(Start { state: last.clone(), keyframe: Some(saved) })).flatten();
        }
        match record {
            Some(Ok(record)) => {
                *last = record.state;
                if blocks.is_some()
                    && let Some(block) = waiting.keep(record)
                {
                    hand_over(&blocks, block);
                }
            }
            Some(Err(LogError::Gap { .. })) => {
                hand_over(&blocks, waiting.take());
                blocks = None;
                let after = Some(Tick(last.tick));
                match reader.go_on() {
                    Ok(behind) => {
                        resumed = behind.as_ref().map(|behind| Tick(behind.state.tick));
                        if has_begun {
                            gaps.push(SkippedGap { after, resumed });
                        }
                        last = behind?.state;
                    }
                    Err(error) => return Some(error),
                }
            }
            ended => {
                hand_over(&blocks, waiting.take());
                if let Some(failure) = reader.failure() {
                    hand_over(&blocks, Block::Failure(failure));
                }
                return ended.and_then(Result::err);
            }
        }
    }
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
