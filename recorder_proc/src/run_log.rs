//! The writer of `run.mcap`, the deterministic lane.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use ipc_types::layout::Message;
use ipc_types::messages::{DrrReply, Frame, ImagePrefix, Latched, Removed, State};
use zerocopy::{FromBytes, IntoBytes};

use crate::end::{EndMarker, EndReason};
use crate::error::LogError;
use crate::header::LogHeader;
use crate::order::{Ordered, TickOrder};
use crate::sink::{Sink, create_file};
use crate::topics;

/// The deterministic lane of a run, being written.
///
/// `latched`, `removed` and `state` may be called in any interleaving, each in its own order: a tick is written once
/// its three messages are there, as `Latched` k, `Removed` k+1, `State` k+1. Frames and replies are written when they
/// come. The file's bytes are a function of that sequence alone.
///
/// Time: `log_time` is tick × dt. When a run is reset, its ticks begin again and its log time goes on.
pub struct RunLog<W: Write> {
    sink: Sink<W>,
    order: TickOrder,
    channels: Channels,
    /// Log tick of the current `State.tick` 0.
    base_tick: u64,
    /// Ticks made since then.
    made: u64,
    last: Option<State>,
    expected: Expected,
    lost: BTreeMap<&'static str, u64>,
}

struct Channels {
    latched: usize,
    state: usize,
    removed: usize,
    reply: usize,
    frame: usize,
    image: usize,
}

/// Numbers that the next messages should carry.
#[derive(Default)]
struct Expected {
    latched_tick: u64,
    state_tick: u64,
    removed_sequence: u64,
    frame_sequence: u64,
}

impl RunLog<BufWriter<File>> {
    /// Creates the file and writes the header.
    pub fn create_file(path: &Path, header: &LogHeader) -> Result<RunLog<BufWriter<File>>, LogError> {
        RunLog::create_named(create_file(path)?, path, header)
    }
}

impl<W: Write> RunLog<W> {
    /// Writes the header to `w`.
    pub fn create(w: W, header: &LogHeader) -> Result<RunLog<W>, LogError> {
        RunLog::create_named(w, Path::new("run.mcap"), header)
    }

    /// Writes the header to `w`; errors will name `path`.
    pub fn create_named(w: W, path: &Path, header: &LogHeader) -> Result<RunLog<W>, LogError> {
        let mut sink = Sink::create(w, path, header, "run")?;
        let mut channel = |i: usize| sink.channel(topics::RUN[i].0, topics::RUN[i].1);
        let channels = Channels {
            latched: channel(0)?,
            state: channel(1)?,
            removed: channel(2)?,
            reply: channel(3)?,
            frame: channel(4)?,
            image: channel(5)?,
        };
        let expected = Expected { removed_sequence: 1, frame_sequence: 1, ..Expected::default() };
        let order = TickOrder::default();
        Ok(RunLog {
            sink,
            order,
            channels,
            base_tick: 0,
            made: 0,
            last: None,
            expected,
            lost: BTreeMap::new(),
        })
    }

    /// Takes u_k.
    pub fn latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        self.order.latched(latched);
        self.drain(false)
    }

    /// Takes a state.
    pub fn state(&mut self, state: &State) -> Result<(), LogError> {
        self.order.state(state);
        self.drain(false)
    }

    /// Takes the bytes of a `Removed` message: struct and voxel indices.
    pub fn removed(&mut self, message: &[u8]) -> Result<(), LogError> {
        let size = Removed::DESCRIPTION.size;
        let expected = match Removed::read_from_prefix(message) {
            Ok((removed, tail)) if tail.len() == removed.voxel_index_length as usize * 4 => None,
            Ok((removed, _)) => Some(size + removed.voxel_index_length as usize * 4),
            Err(_) => Some(size),
        };
        if let Some(expected) = expected {
            return Err(self.wrong_size(topics::REMOVED, message.len(), expected));
        }
        self.order.removed(message);
        self.drain(false)
    }

    /// Writes a reply.
    pub fn drr_reply(&mut self, reply: &DrrReply) -> Result<(), LogError> {
        self.sink.message(self.channels.reply, self.base_tick.saturating_add(reply.tick), &[reply.as_bytes()])
    }

    /// Writes a frame, given as on the wire: `Frame`, `ImagePrefix`, pixels. The image lies in a chunk of its own, so
    /// that whoever asks for states does not read pixels.
    pub fn frame(&mut self, payload: &[u8]) -> Result<(), LogError> {
        let smallest = Frame::DESCRIPTION.size + ImagePrefix::DESCRIPTION.size;
        let Ok((frame, image)) = Frame::read_from_prefix(payload) else {
            return Err(self.wrong_size(topics::DRR_FRAME, payload.len(), smallest));
        };
        let Ok((prefix, pixels)) = ImagePrefix::read_from_prefix(image) else {
            return Err(self.wrong_size(topics::DRR_FRAME, payload.len(), smallest));
        };
        if pixels.len() != prefix.data_length as usize {
            let expected = smallest + prefix.data_length as usize;
            return Err(self.wrong_size(topics::DRR_FRAME, payload.len(), expected));
        }
        let missed = frame.sequence.saturating_sub(self.expected.frame_sequence);
        self.count_lost(topics::DRR_FRAME, missed);
        self.expected.frame_sequence = frame.sequence.saturating_add(1);
        let log_tick = self.base_tick.saturating_add(frame.tick);
        self.sink.message(self.channels.frame, log_tick, &[frame.as_bytes()])?;
        self.sink.close_chunk()?;
        self.sink.message(self.channels.image, log_tick, &[image])?;
        self.sink.close_chunk()
    }

    /// Ticks since the start of the log at which the current `State.tick` 0 lies: 0 until the run is reset. What is
    /// written to the timing lane at tick k belongs to log tick `base_tick() + k`.
    pub fn base_tick(&self) -> u64 {
        self.base_tick
    }

    /// The last state written.
    pub fn last_state(&self) -> Option<&State> {
        self.last.as_ref()
    }

    /// Messages missed so far, by topic, as their numbers show.
    pub fn lost(&self) -> &BTreeMap<&'static str, u64> {
        &self.lost
    }

    /// Writes what waits, the end marker, the index and the footer. `lost` adds what the owner counted itself.
    pub fn finish(
        mut self,
        reason: EndReason,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(EndMarker, W), LogError> {
        self.drain(true)?;
        let mut all: BTreeMap<String, u64> = self.lost.iter().map(|(k, n)| (k.to_string(), *n)).collect();
        for (topic, &count) in lost.iter().filter(|(_, count)| **count > 0) {
            let entry = all.entry(topic.clone()).or_default();
            *entry = count.max(*entry);
        }
        let last_tick = self.last.as_ref().map(|state| state.tick);
        let hash = self.last.as_ref().map(|state| state.hash);
        let marker = EndMarker { reason, last_tick, hash, counts: self.sink.counts(), lost: all };
        let w = self.sink.finish(&marker)?;
        Ok((marker, w))
    }

    fn drain(&mut self, last: bool) -> Result<(), LogError> {
        loop {
            let messages = self.order.next(last);
            if messages.is_empty() {
                return Ok(());
            }
            for message in messages {
                match message {
                    Ordered::Latched(latched) => self.write_latched(&latched)?,
                    Ordered::Removed(bytes) => self.write_removed(&bytes)?,
                    Ordered::State(state) => self.write_state(&state)?,
                }
            }
        }
    }

    fn write_latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        if latched.reset != 0 {
            self.begin_again();
        }
        let missed = latched.tick.saturating_sub(self.expected.latched_tick);
        self.count_lost(topics::LATCHED, missed);
        self.expected.latched_tick = latched.tick.saturating_add(1);
        let log_tick = self.base_tick.saturating_add(latched.tick);
        self.sink.message(self.channels.latched, log_tick, &[latched.as_bytes()])
    }

    fn write_removed(&mut self, message: &[u8]) -> Result<(), LogError> {
        let Ok((removed, _)) = Removed::read_from_prefix(message) else {
            return Err(self.wrong_size(topics::REMOVED, message.len(), Removed::DESCRIPTION.size));
        };
        let missed = removed.sequence.saturating_sub(self.expected.removed_sequence);
        self.count_lost(topics::REMOVED, missed);
        self.expected.removed_sequence = removed.sequence.saturating_add(1);
        let log_tick = self.base_tick.saturating_add(removed.tick);
        self.sink.message(self.channels.removed, log_tick, &[message])
    }

    fn write_state(&mut self, state: &State) -> Result<(), LogError> {
        // The reset of these ticks was lost if they begin again without one.
        if state.tick < self.made {
            self.begin_again();
        }
        let missed = state.tick.saturating_sub(self.expected.state_tick);
        self.count_lost(topics::STATE, missed);
        self.expected.state_tick = state.tick.saturating_add(1);
        let log_tick = self.base_tick.saturating_add(state.tick);
        self.sink.message(self.channels.state, log_tick, &[state.as_bytes()])?;
        let first = self.last.is_none();
        self.made = state.tick;
        self.last = Some(*state);
        // Whoever opens the file of a paused run finds its initial state.
        if first { self.sink.close_chunk() } else { Ok(()) }
    }

    /// Ticks count from 0 again; the log's time goes on.
    fn begin_again(&mut self) {
        self.base_tick = self.base_tick.saturating_add(self.made);
        self.made = 0;
        self.expected.latched_tick = 0;
        self.expected.state_tick = 1;
    }

    fn count_lost(&mut self, topic: &'static str, count: u64) {
        if count > 0 {
            *self.lost.entry(topic).or_default() += count;
        }
    }

    fn wrong_size(&self, topic: &str, given: usize, expected: usize) -> LogError {
        LogError::Message {
            path: self.sink.path().into(),
            topic: topic.to_string(),
            given: format!("{given} bytes"),
            expected: format!("{expected} bytes"),
        }
    }
}
