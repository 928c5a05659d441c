//! The ticks of a log.

use std::path::{Path, PathBuf};

use ipc_types::layout::Message;
use ipc_types::messages::{Latched, Removed, State};
use zerocopy::FromBytes;

use crate::end::Ending;
use crate::error::LogError;
use crate::header::LogHeader;
pub use crate::stream::ReadOptions;
use crate::stream::{LogMessage, MessageStream};
use crate::topics;

/// One complete tick.
#[derive(Debug, Clone, PartialEq)]
pub struct TickRecord {
    /// Ticks since the start of the log, the one that `state` ends included; other than `state.tick` only after a
    /// reset.
    pub log_tick: u64,
    /// u_k.
    pub latched: Latched,
    /// The state that it led to.
    pub state: State,
    /// Linear indices of the voxels that it removed.
    pub removed: Vec<u32>,
}

/// The ticks of a `run.mcap`, in order and without a gap, from a complete log or one cut at any byte.
///
/// Iterates over complete ticks only. An error (a gap, damage) is the last item.
pub struct LogReader {
    stream: MessageStream,
    initial: State,
    last: u64,
    ticks: u64,
    removed_sequence: u64,
    pending: Pending,
    done: bool,
}

#[derive(Default)]
struct Pending {
    latched: Option<Latched>,
    removed: Option<(u64, Vec<u32>)>,
}

impl LogReader {
    /// Opens a log of this build's layouts and reads up to the initial state.
    pub fn open(path: &Path) -> Result<LogReader, LogError> {
        LogReader::open_with(path, ReadOptions::default())
    }

    /// Opens a log and reads up to the initial state.
    pub fn open_with(path: &Path, options: ReadOptions) -> Result<LogReader, LogError> {
        LogReader::from_stream(MessageStream::open(path, options)?)
    }

    /// Reads the ticks of a stream from its start.
    pub fn from_stream(mut stream: MessageStream) -> Result<LogReader, LogError> {
        let path: PathBuf = stream.path().into();
        let initial = loop {
            let Some(message) = stream.next_message()? else { return Err(LogError::NoInitialState { path }) };
            match message.topic {
                topics::STATE => match State::read_from_bytes(message.body) {
                    Ok(state) if state.tick == 0 => break state,
                    Ok(state) => {
                        return Err(gap(
                            &path,
                            topics::STATE,
                            0,
                            &format!("state {} comes first", state.tick),
                        ));
                    }
                    Err(_) => return Err(LogError::NoInitialState { path }),
                },
                topics::LATCHED | topics::REMOVED => {
                    return Err(gap(&path, topics::STATE, 0, &format!("{} comes first", message.topic)));
                }
                _ => (),
            }
        };
        let pending = Pending::default();
        Ok(LogReader { stream, initial, last: 0, ticks: 0, removed_sequence: 1, pending, done: false })
    }

    /// What the log is about.
    pub fn header(&self) -> &LogHeader {
        self.stream.header()
    }

    /// The initial state, tick 0.
    pub fn initial(&self) -> &State {
        &self.initial
    }

    /// The stream below, for its metadata and counts.
    pub fn stream(&self) -> &MessageStream {
        &self.stream
    }

    /// `State.tick` of the last complete tick so far.
    pub fn last_complete_tick(&self) -> u64 {
        self.last
    }

    /// Complete ticks so far.
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// How the file ends. Known once the iteration has ended without an error.
    pub fn ending(&self) -> &Ending {
        self.stream.ending()
    }

    fn next_tick(&mut self) -> Result<Option<TickRecord>, LogError> {
        let path: PathBuf = self.stream.path().into();
        while let Some(message) = self.stream.next_message()? {
            let state = self.pending.take(&path, &message, self.last, &mut self.removed_sequence)?;
            let Some(state) = state else { continue };
            let tick = state.tick;
            let Some(latched) = self.pending.latched.take() else {
                let found = format!("state {tick} follows without it");
                return Err(gap(&path, topics::LATCHED, tick.saturating_sub(1), &found));
            };
            if latched.tick.checked_add(1) != Some(tick) {
                return Err(gap(
                    &path,
                    topics::STATE,
                    latched.tick.saturating_add(1),
                    &format!("state {tick}"),
                ));
            }
            let removed = self.pending.removed_of(&path, &state)?;
            self.last = tick;
            self.ticks += 1;
            return Ok(Some(TickRecord { log_tick: self.ticks, latched, state, removed }));
        }
        Ok(None)
    }
}

impl Pending {
    /// Takes a message; returns the state if it is one.
    fn take(
        &mut self,
        path: &Path,
        message: &LogMessage<'_>,
        last: u64,
        removed_sequence: &mut u64,
    ) -> Result<Option<State>, LogError> {
        match message.topic {
            topics::LATCHED => {
                let Ok(latched) = Latched::read_from_bytes(message.body) else { return Ok(None) };
                if let Some(previous) = &self.latched {
                    let found = format!("latched {} follows latched {}", latched.tick, previous.tick);
                    return Err(gap(path, topics::STATE, previous.tick.saturating_add(1), &found));
                }
                let expected = if latched.reset == 0 { last } else { 0 };
                if latched.tick != expected {
                    return Err(gap(path, topics::LATCHED, expected, &format!("latched {}", latched.tick)));
                }
                if latched.reset != 0 {
                    *removed_sequence = 0;
                }
                self.latched = Some(latched);
            }
            topics::REMOVED => {
                let Ok((removed, tail)) = Removed::read_from_prefix(message.body) else { return Ok(None) };
                // The numbers may begin again behind a reset.
                if *removed_sequence != 0 && removed.sequence != *removed_sequence {
                    let found = format!("message {}, expected {removed_sequence}", removed.sequence);
                    return Err(gap(path, topics::REMOVED, removed.tick, &found));
                }
                if let Some((tick, _)) = self.removed {
                    return Err(gap(path, topics::STATE, tick, "another removal follows"));
                }
                *removed_sequence = removed.sequence.saturating_add(1);
                let voxels =
                    tail.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
                self.removed = Some((removed.tick, voxels));
            }
            topics::STATE => return Ok(State::read_from_bytes(message.body).ok()),
            _ => (),
        }
        Ok(None)
    }

    /// The voxels that a state says were removed.
    fn removed_of(&mut self, path: &Path, state: &State) -> Result<Vec<u32>, LogError> {
        let count = state.removed_in_tick as usize;
        match self.removed.take() {
            None if count == 0 => Ok(Vec::new()),
            Some((tick, voxels)) if tick == state.tick && voxels.len() == count => Ok(voxels),
            None => Err(gap(
                path,
                topics::REMOVED,
                state.tick,
                &format!("the state counts {count} removed voxels"),
            )),
            Some((tick, voxels)) => {
                let found = format!("{} voxels of tick {tick}, the state counts {count}", voxels.len());
                Err(gap(path, topics::REMOVED, state.tick, &found))
            }
        }
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
        item.transpose()
    }
}

/// Checked by the stream: a message of a topic has its description's size.
const _: () = assert!(Removed::DESCRIPTION.size == 32 && State::DESCRIPTION.size % 8 == 0);

fn gap(path: &Path, topic: &'static str, tick: u64, found: &str) -> LogError {
    LogError::Gap { path: path.into(), topic, tick, found: found.to_string() }
}
