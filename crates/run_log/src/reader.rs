//! Reads a log tick by tick.

use std::path::{Path, PathBuf};

use messages::{Latched, Plant, Reset, SensorReading, State, Tick};
use zerocopy::FromBytes;

use crate::end::{EndReason, Ending};
use crate::error::LogError;
use crate::header::LogHeader;
use crate::pending::Pending;
use crate::source::LogSource;
use crate::stream::{MessageStream, ReadOptions};
use crate::topics::Topic;

/// One complete tick.
#[derive(Debug, Clone, PartialEq)]
pub struct TickRecord {
    /// u_k.
    pub latched: Latched,
    /// The state after u_k.
    pub state: State,
    /// Linear indices of the voxels drilled away in this tick.
    pub removed: Vec<u32>,
    /// After a reset, which restores all voxels: the predrilled voxels, removed again before `removed`.
    pub restored: Option<Vec<u32>>,
    /// Sensor readings that arrived with the state.
    pub readings: Vec<SensorReading>,
}

/// The tick that a run's simulation failed to compute.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedFailure {
    /// The tick's commands, the log's last.
    pub latched: Box<Latched>,
    /// The log's end reason: the tick and the cause.
    pub text: String,
}

impl RecordedFailure {
    /// Applies these commands to a plant in the last state and checks that it fails as recorded.
    ///
    /// # Errors
    /// The plant does not fail, or fails for another reason.
    pub fn reproduce(&self, plant: &mut impl Plant) -> Result<(), String> {
        let Err(cause) = plant.step(&self.latched) else {
            return Err(format!("the simulation does not fail here; the log says: {}", self.text));
        };
        match format!("tick {}: {cause}", self.latched.tick) {
            told if told == self.text => Ok(()),
            told => Err(format!("{told}; the log says: {}", self.text)),
        }
    }
}

/// A complete keyframe.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SavedState {
    /// `State.tick` of the saved state.
    pub tick: Tick,
    /// `State.hash` of that state, low word first.
    pub hash: [u64; 2],
    /// The physics' serialized state, opaque to this crate.
    pub bytes: Vec<u8>,
}

/// Iterates over the ticks of a `run.mcap` in order, from a complete log or one truncated at any byte.
///
/// Returns complete ticks only. An error (a gap, damage) is the last item; after a gap, [`LogReader::go_on`]
/// seeks to the next keyframe and the iteration resumes there.
pub struct LogReader {
    stream: MessageStream,
    initial: State,
    predrilled: Vec<u32>,
    last: Tick,
    pending: Pending,
    /// Maximum number of voxels that a tick can remove.
    voxels: u64,
    /// Keyframe at which the ticks begin, for a log whose start is missing.
    beginning: Option<SavedState>,
    /// Whether the iteration stopped at a gap with possibly more ticks after it.
    at_gap: bool,
    done: bool,
}

/// The point at which a log's ticks resume after a gap.
#[derive(Debug, Clone, PartialEq)]
pub struct Resumption {
    /// The first state after the gap that has a keyframe.
    pub state: Box<State>,
    /// That keyframe.
    pub keyframe: SavedState,
}

impl LogReader {
    /// Opens a log with this build's layouts and reads up to the initial state.
    pub fn open(log: &dyn LogSource) -> Result<LogReader, LogError> {
        LogReader::open_with(log, ReadOptions::default())
    }

    /// Opens a log and reads up to the initial state.
    pub fn open_with(log: &dyn LogSource, options: ReadOptions) -> Result<LogReader, LogError> {
        LogReader::from_stream(MessageStream::open(log, options)?)
    }

    /// Reads the ticks of a stream from its start, or from its first keyframe if the log's start is missing
    /// ([`beginning`](Self::beginning)).
    pub fn from_stream(mut stream: MessageStream) -> Result<LogReader, LogError> {
        let mut pending = Pending {
            removal_count: Some(0),
            reading_count: Some(0),
            keyframe_parts: Some(0),
            ..Pending::default()
        };
        let voxels = voxels_of(stream.header());
        let started = match stream.header().first_tick {
            Tick::START => LogReader::start(&mut stream, &mut pending, voxels),
            // Its first messages are a state and its keyframe.
            _ => Err(LogError::NoInitialState { path: stream.path().into() }),
        };
        match started {
            Ok((initial, predrilled)) => Ok(LogReader {
                stream,
                initial,
                predrilled,
                last: Tick::START,
                pending,
                voxels,
                beginning: None,
                at_gap: false,
                done: false,
            }),
            Err(error @ (LogError::Gap { .. } | LogError::NoInitialState { .. })) => {
                let mut reader = LogReader {
                    stream,
                    initial: State::zeroed(),
                    predrilled: Vec::new(),
                    last: Tick::START,
                    pending: Pending::default(),
                    voxels,
                    beginning: None,
                    at_gap: true,
                    done: true,
                };
                let Some(found) = reader.go_on()? else { return Err(error) };
                reader.initial = *found.state;
                reader.beginning = Some(found.keyframe);
                Ok(reader)
            }
            Err(error) => Err(error),
        }
    }

    /// The initial state and its predrilled voxels.
    fn start(
        stream: &mut MessageStream,
        pending: &mut Pending,
        voxels: u64,
    ) -> Result<(State, Vec<u32>), LogError> {
        let path: PathBuf = stream.path().into();
        let initial = loop {
            let Some(message) = stream.next_message()? else {
                // The log may be of the other lane, for example.
                let is_whole = stream.ending().is_complete();
                return Err(if is_whole {
                    LogError::NoStates { path }
                } else {
                    LogError::NoInitialState { path }
                });
            };
            if message.known == Some(Topic::Latched) {
                return Err(gap(&path, Topic::State, Tick::START, "a command comes first"));
            }
            match pending.take(&path, &message, None)? {
                Some(state) if state.tick == 0 => break state,
                Some(state) => {
                    let found = format!("state {} comes first", state.tick);
                    return Err(gap(&path, Topic::State, Tick::START, &found));
                }
                None => pending.check_size(stream, voxels)?,
            }
        };
        let (predrilled, _) = pending.removed_of(&path, &initial, Reset::No)?;
        pending.readings.clear();
        Ok((initial, predrilled))
    }

    /// The keyframe at which the ticks begin if the log's start is missing, or the log begins later than its
    /// run.
    pub fn beginning(&self) -> Option<&SavedState> {
        self.beginning.as_ref()
    }

    /// Seeks to the next keyframe once the iteration has ended with [`LogError::Gap`]; the iteration resumes
    /// there. Returns `None` if the iteration ended for another reason, or the log has no further keyframe.
    ///
    /// # Errors
    /// The log cannot be read further.
    pub fn go_on(&mut self) -> Result<Option<Resumption>, LogError> {
        if !std::mem::take(&mut self.at_gap) {
            return Ok(None);
        }
        let path: PathBuf = self.stream.path().into();
        let mut state: Option<Box<State>> = None;
        let mut pending = Pending::default();
        while let Some(message) = self.stream.next_message()? {
            match message.known {
                Some(Topic::State) => state = State::read_from_bytes(message.body).ok().map(Box::new),
                Some(Topic::Keyframe) => {
                    let Some(state) = &state else { continue };
                    // Skip keyframes of other states.
                    let _ = pending.take_keyframe_part(&path, message.body, Some(Tick(state.tick)));
                    if let Some(keyframe) = pending.whole_keyframe()
                        && keyframe.hash == state.hash
                    {
                        let found = Resumption { state: state.clone(), keyframe: keyframe.clone() };
                        pending.removed_total = state.removed_total;
                        (self.pending, self.last, self.done) = (pending, Tick(state.tick), false);
                        return Ok(Some(found));
                    }
                }
                _ => {}
            }
        }
        Ok(None)
    }

    /// The log's header.
    pub fn header(&self) -> &LogHeader {
        self.stream.header()
    }

    /// The initial state, tick 0.
    pub fn initial(&self) -> &State {
        &self.initial
    }

    /// Linear indices of the voxels missing from the initial state.
    pub fn predrilled(&self) -> &[u32] {
        &self.predrilled
    }

    /// The underlying message stream, for its metadata and counts.
    pub fn stream(&self) -> &MessageStream {
        &self.stream
    }

    /// Returns the keyframe of the state in which the last-read tick began, if there is one; at the end of
    /// the log, the keyframe of the last state. Each keyframe is returned only once.
    pub fn take_keyframe(&mut self) -> Option<SavedState> {
        self.pending.whole_keyframe()?;
        self.pending.keyframe.take().map(|(saved, _)| saved)
    }

    /// Returns `State.tick` of the last complete tick so far.
    pub fn last_complete_tick(&self) -> Tick {
        self.last
    }

    /// Returns the commands of the tick that the simulation failed to compute, and the recorded cause, if
    /// that ended the run. Known once the iteration has ended without an error.
    pub fn failure(&self) -> Option<RecordedFailure> {
        if !self.done || self.at_gap {
            return None;
        }
        match &self.ending().marker.as_ref()?.reason {
            EndReason::SimulationFailed(text) => {
                Some(RecordedFailure { latched: Box::new(self.pending.latched?), text: text.clone() })
            }
            _ => None,
        }
    }

    /// Returns how the file ends. Known once the iteration has ended without an error.
    pub fn ending(&self) -> &Ending {
        self.stream.ending()
    }

    fn next_tick(&mut self) -> Result<Option<TickRecord>, LogError> {
        let path: PathBuf = self.stream.path().into();
        while let Some(message) = self.stream.next_message()? {
            let Some(state) = self.pending.take(&path, &message, Some(self.last))? else {
                self.pending.check_size(&self.stream, self.voxels)?;
                continue;
            };
            let tick = Tick(state.tick);
            let Some(latched) = self.pending.latched.take() else {
                return Err(gap(
                    &path,
                    Topic::Latched,
                    self.last,
                    &format!("state {tick} follows without it"),
                ));
            };
            if self.last.0.checked_add(1) != Some(tick.0) {
                return Err(gap(&path, Topic::State, self.last.saturating_add(1), &format!("state {tick}")));
            }
            let (removed, restored) = self.pending.removed_of(&path, &state, latched.reset())?;
            self.last = tick;
            let readings = std::mem::take(&mut self.pending.readings);
            return Ok(Some(TickRecord { latched, state, removed, restored, readings }));
        }
        Ok(None)
    }
}

impl Iterator for LogReader {
    type Item = Result<TickRecord, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let item = self.next_tick();
        self.done = !matches!(item, Ok(Some(_)));
        self.at_gap = matches!(item, Err(LogError::Gap { .. }));
        item.transpose()
    }
}

/// Returns the number of voxels in the log's volume.
pub fn voxels_of(header: &LogHeader) -> u64 {
    header
        .volume_dimensions
        .iter()
        .fold(1_u64, |count, n| count.saturating_mul(u64::from(*n)))
        .min(voxel_grid::MAX_VOXELS as u64)
}

/// Returns the voxel indices that follow a `Removed` struct.
pub fn voxel_indices(tail: &[u8]) -> Vec<u32> {
    tail.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

pub(crate) fn gap(path: &Path, topic: Topic, tick: Tick, found: &str) -> LogError {
    LogError::Gap { path: path.into(), topic, tick, found: found.to_string() }
}
