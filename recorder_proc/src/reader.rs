//! The ticks of a log.

use std::path::{Path, PathBuf};

use ipc_types::messages::{Keyframe, Latched, Removed, State};
use zerocopy::FromBytes;

use crate::end::Ending;
use crate::error::LogError;
use crate::header::LogHeader;
pub use crate::stream::ReadOptions;
use crate::stream::{LogMessage, MessageStream};
use crate::topics;

/// Most voxels of a volume that this build reads (`volume_io::MAX_VOXELS`), whatever a header says.
const MAX_VOXELS: u64 = 1 << 29;

/// One complete tick.
#[derive(Debug, Clone, PartialEq)]
pub struct TickRecord {
    /// u_k.
    pub latched: Latched,
    /// The state that it led to.
    pub state: State,
    /// Linear indices of the voxels that this tick drilled away.
    pub removed: Vec<u32>,
    /// After a reset: all voxels were put back and these removed again (the predrilled ones) before `removed`.
    pub restored: Option<Vec<u32>>,
}

/// A whole keyframe of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SavedState {
    /// `State.tick` of the state that it saves.
    pub tick: u64,
    /// `State.hash` of that state, low word first.
    pub hash: [u64; 2],
    /// The physics' own bytes.
    pub bytes: Vec<u8>,
}

/// The ticks of a `run.mcap`, in order and without a gap, from a complete log or one cut at any byte.
///
/// Iterates over complete ticks only. An error (a gap, damage) is the last item.
pub struct LogReader {
    stream: MessageStream,
    initial: State,
    predrilled: Vec<u32>,
    last: u64,
    pending: Pending,
    /// Most voxels that a tick can remove.
    voxels: u64,
    done: bool,
}

/// Messages of the tick whose state has not come.
#[derive(Default)]
struct Pending {
    latched: Option<Latched>,
    removals: Vec<(Removed, Vec<u32>)>,
    /// Their voxels; a message without any counts as one.
    held: u64,
    /// Number of removal messages so far.
    removal_count: u64,
    /// `removed_total` of the last state.
    removed_total: u64,
    /// The last keyframe, or what has come of it.
    keyframe: Option<(SavedState, usize)>,
    /// Number of keyframe parts so far.
    keyframe_parts: u64,
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
        let mut pending = Pending::default();
        let voxels = voxels_of(stream.header());
        let initial = loop {
            let Some(message) = stream.next_message()? else { return Err(LogError::NoInitialState { path }) };
            if message.topic == topics::LATCHED {
                return Err(gap(&path, topics::STATE, 0, "a command comes first"));
            }
            match pending.take(&path, &message, None)? {
                Some(state) if state.tick == 0 => break state,
                Some(state) => {
                    return Err(gap(&path, topics::STATE, 0, &format!("state {} comes first", state.tick)));
                }
                None => pending.check_size(&stream, voxels)?,
            }
        };
        let (predrilled, _) = pending.removed_of(&path, &initial, false)?;
        Ok(LogReader { stream, initial, predrilled, last: 0, pending, voxels, done: false })
    }

    /// What the log is about.
    pub fn header(&self) -> &LogHeader {
        self.stream.header()
    }

    /// The initial state, tick 0.
    pub fn initial(&self) -> &State {
        &self.initial
    }

    /// Linear indices of the voxels that are gone in the initial state.
    pub fn predrilled(&self) -> &[u32] {
        &self.predrilled
    }

    /// The stream below, for its metadata and counts.
    pub fn stream(&self) -> &MessageStream {
        &self.stream
    }

    /// The keyframe behind the tick before the last one that was read, if there is one: of the state in which the last
    /// tick began. At the end of the log, that of the last state. Taken only once.
    pub fn take_keyframe(&mut self) -> Option<SavedState> {
        let whole = |(saved, total): &(SavedState, usize)| saved.bytes.len() == *total;
        self.pending.keyframe.take_if(|keyframe| whole(keyframe)).map(|(saved, _)| saved)
    }

    /// `State.tick` of the last complete tick so far.
    pub fn last_complete_tick(&self) -> u64 {
        self.last
    }

    /// How the file ends. Known once the iteration has ended without an error.
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
            let tick = state.tick;
            let Some(latched) = self.pending.latched.take() else {
                return Err(gap(
                    &path,
                    topics::LATCHED,
                    self.last,
                    &format!("state {tick} follows without it"),
                ));
            };
            if self.last.checked_add(1) != Some(tick) {
                return Err(gap(&path, topics::STATE, self.last.saturating_add(1), &format!("state {tick}")));
            }
            let (removed, restored) = self.pending.removed_of(&path, &state, latched.reset != 0)?;
            self.last = tick;
            return Ok(Some(TickRecord { latched, state, removed, restored }));
        }
        Ok(None)
    }
}

impl Pending {
    /// Takes a message behind state `last`; returns the state if it is one.
    fn take(
        &mut self,
        path: &Path,
        message: &LogMessage<'_>,
        last: Option<u64>,
    ) -> Result<Option<State>, LogError> {
        match message.topic {
            topics::LATCHED => {
                let Ok(latched) = Latched::read_from_bytes(message.body) else { return Ok(None) };
                if let Some(previous) = &self.latched {
                    let found = format!("latched {} follows latched {}", latched.tick, previous.tick);
                    return Err(gap(path, topics::STATE, previous.tick.saturating_add(1), &found));
                }
                let expected = last.unwrap_or(0);
                if latched.tick != expected {
                    return Err(gap(path, topics::LATCHED, expected, &format!("latched {}", latched.tick)));
                }
                self.latched = Some(latched);
            }
            topics::REMOVED => {
                let Ok((removed, tail)) = Removed::read_from_prefix(message.body) else { return Ok(None) };
                self.removal_count += 1;
                if removed.sequence != self.removal_count {
                    let found = format!("message {}, expected {}", removed.sequence, self.removal_count);
                    return Err(gap(path, topics::REMOVED, removed.tick, &found));
                }
                let tick = last.map_or(0, |last| last.saturating_add(1));
                if removed.tick != tick {
                    return Err(gap(
                        path,
                        topics::STATE,
                        tick,
                        &format!("a removal of tick {}", removed.tick),
                    ));
                }
                let voxels = voxel_indices(tail);
                self.held += voxels.len().max(1) as u64;
                self.removals.push((removed, voxels));
            }
            topics::KEYFRAME => self.take_keyframe_part(path, message.body, last)?,
            topics::STATE => return Ok(State::read_from_bytes(message.body).ok()),
            _ => (),
        }
        Ok(None)
    }

    /// A log that removes without end and never says a state would fill the memory.
    fn check_size(&self, stream: &MessageStream, most: u64) -> Result<(), LogError> {
        // After a reset without predrilled voxels there is a message that holds none.
        if self.held <= most.saturating_add(1) {
            return Ok(());
        }
        let cause = format!("removals of {} voxels in a tick, the volume has {most}", self.held);
        Err(LogError::Damaged { path: stream.path().into(), offset: stream.offset(), cause })
    }

    fn take_keyframe_part(&mut self, path: &Path, body: &[u8], last: Option<u64>) -> Result<(), LogError> {
        let Ok((head, data)) = Keyframe::read_from_prefix(body) else { return Ok(()) };
        self.keyframe_parts += 1;
        let begun = match &self.keyframe {
            Some((saved, _)) if head.offset_bytes > 0 && saved.tick == head.tick => saved.bytes.len(),
            _ => 0,
        };
        let fits = begun as u64 == u64::from(head.offset_bytes)
            && u64::from(head.offset_bytes) + data.len() as u64 <= u64::from(head.total_bytes);
        if head.sequence != self.keyframe_parts || !fits || Some(head.tick) != last {
            let found = format!("part {} of tick {}, byte {}", head.sequence, head.tick, head.offset_bytes);
            return Err(gap(path, topics::KEYFRAME, head.tick, &found));
        }
        if begun == 0 {
            let saved = SavedState { tick: head.tick, hash: head.hash, bytes: Vec::new() };
            self.keyframe = Some((saved, head.total_bytes as usize));
        }
        if let Some((saved, _)) = &mut self.keyframe {
            saved.bytes.extend_from_slice(data);
        }
        Ok(())
    }

    /// The voxels that a state says were removed, and those that a reset removed before. In the initial state, all
    /// are predrilled.
    fn removed_of(
        &mut self,
        path: &Path,
        state: &State,
        reset: bool,
    ) -> Result<(Vec<u32>, Option<Vec<u32>>), LogError> {
        let missing = |found: String| gap(path, topics::REMOVED, state.tick, &found);
        let removals = std::mem::take(&mut self.removals);
        self.held = 0;
        let total = removals.last().map_or(self.removed_total, |(removed, _)| removed.removed_total);
        if total != state.removed_total {
            return Err(missing(format!(
                "messages up to {total} voxels, the state counts {}",
                state.removed_total
            )));
        }
        self.removed_total = total;
        let restores = removals.iter().any(|(removed, _)| removed.restore_first != 0);
        if restores != reset {
            let word =
                if restores { "voxels put back without a reset" } else { "a reset without voxels put back" };
            return Err(missing(word.to_string()));
        }
        let mut voxels: Vec<u32> = removals.into_iter().flat_map(|(_, voxels)| voxels).collect();
        if state.tick == 0 {
            return Ok((voxels, None));
        }
        let drilled = state.removed_in_tick as usize;
        match voxels.len().checked_sub(drilled) {
            Some(before) if reset => {
                let removed = voxels.split_off(before);
                Ok((removed, Some(voxels)))
            }
            Some(0) => Ok((voxels, None)),
            _ => Err(missing(format!("{} voxels, the state counts {drilled} in this tick", voxels.len()))),
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

/// Voxels of the log's volume.
pub fn voxels_of(header: &LogHeader) -> u64 {
    header
        .volume_dimensions
        .iter()
        .fold(1_u64, |count, n| count.saturating_mul(u64::from(*n)))
        .min(MAX_VOXELS)
}

/// The voxel indices behind a `Removed`.
pub fn voxel_indices(tail: &[u8]) -> Vec<u32> {
    tail.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

fn gap(path: &Path, topic: &'static str, tick: u64, found: &str) -> LogError {
    LogError::Gap { path: path.into(), topic, tick, found: found.to_string() }
}
