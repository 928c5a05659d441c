//! The writer of `run.mcap`, the deterministic lane.

use std::collections::{BTreeMap, VecDeque};
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use messages::layout::Message;
use messages::{DrrReply, Frame, ImagePrefix, Keyframe, Latched, Removed, SensorReading, State, Tick};
use zerocopy::{FromBytes, IntoBytes};

use crate::end::{EndMarker, EndReason};
use crate::error::LogError;
use crate::frame_order::{FrameOrder, FrameWithImage, PlacedReply, WriteScope};
use crate::header::LogHeader;
use crate::mcap_writer::IndexStore;
use crate::order::{OrderedMessage, Supply, TickOrder};
use crate::sink::Sink;
use crate::topics::{self, Topic};

/// The deterministic lane of a run, being written.
///
/// Calls may be interleaved in any way, as long as each topic stays in order, the removals of tick 0 precede
/// its state, and the readings of a state precede that state. A tick is written as `Latched` k, `Removed`
/// k+1, `SensorReading`s k+1, `State` k+1 once all of them have arrived. The arrival of frames and replies
/// depends on the renderer, so they are held and written a fixed number of ticks after the tick that they
/// show (`frame_lag_ticks`): two runs with the same messages produce the same bytes. Only a frame that
/// arrives even later is written on arrival. A keyframe must be passed before the next tick's state; it is
/// written directly after its own state and the frames due there.
///
/// `log_time` is tick × dt; for a frame, the tick that it shows.
///
/// Further logs of the same run can begin at its keyframes ([`RunLog::begin_another`]) and end before it
/// ([`RunLog::end`]); each is complete and replays by itself.
pub struct RunLog<W: Write> {
    header: LogHeader,
    outputs: Vec<Output<W>>,
    /// The log that begins next.
    next: Option<NextLog<W>>,
    ticks: TickOrder,
    frames: FrameOrder,
    keyframes: VecDeque<(Tick, Vec<u8>)>,
    /// Readings of states that are not written yet.
    readings: VecDeque<SensorReading>,
    places: WriteOrder,
    last: Option<State>,
    expected: Expected,
    lost: BTreeMap<&'static str, u64>,
}

/// A log being written.
struct Output<W: Write> {
    sink: Sink<W>,
    /// Tick of its first state.
    first_tick: Tick,
    /// The messages missed before it began.
    lost_before: BTreeMap<&'static str, u64>,
}

/// A log that begins at the first complete keyframe of a state of tick `from` or later.
struct NextLog<W> {
    from: Tick,
    out: W,
    path: PathBuf,
    index: Box<dyn IndexStore>,
}

/// Decides where replies, frames and keyframes go, and where chunks end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum WriteOrder {
    /// They go by the tick that they belong to.
    ByTick,
    /// The caller decides, when copying a log.
    AsGiven,
}

impl WriteOrder {
    fn due(self) -> WriteScope {
        match self {
            WriteOrder::ByTick => WriteScope::AtItsTick,
            WriteOrder::AsGiven => WriteScope::All,
        }
    }
}

/// Sequence numbers expected of the next messages; 0: any number.
struct Expected {
    latched_tick: Tick,
    state_tick: Tick,
    removed_sequence: u64,
    frame_sequence: u64,
    keyframe_sequence: u64,
    reading_sequence: u64,
}

impl Expected {
    /// The first numbers of a log.
    fn of(header: &LogHeader) -> Expected {
        let first = u64::from(header.first_tick == Tick::START);
        Expected {
            latched_tick: header.first_tick,
            state_tick: header.first_tick,
            removed_sequence: first,
            frame_sequence: first,
            keyframe_sequence: first,
            reading_sequence: first,
        }
    }
}

/// Accepts a message's number; returns how many messages are missing before it.
fn missed(expected: &mut u64, number: u64) -> u64 {
    match std::mem::replace(expected, number.saturating_add(1)) {
        0 => 0,
        expected => number.saturating_sub(expected),
    }
}

/// Writes the header, and declares the channels of [`topics::RUN_TOPICS`].
fn create_sink<W: Write>(
    w: W,
    path: &Path,
    index: Box<dyn IndexStore>,
    header: &LogHeader,
) -> Result<Sink<W>, LogError> {
    let mut sink = Sink::create(w, path, index, header, "run")?;
    topics::RUN_TOPICS
        .iter()
        .try_for_each(|topic| sink.channel(topic.name(), topic.description()).map(drop))?;
    Ok(sink)
}

impl<W: Write> RunLog<W> {
    /// Writes the header to `w`; errors name `run.mcap`, and the index is kept in memory.
    pub fn create(w: W, header: &LogHeader) -> Result<RunLog<W>, LogError> {
        RunLog::create_named(w, Path::new("run.mcap"), Box::new(Cursor::new(Vec::new())), header)
    }

    /// Writes the header to `w`; errors name `path`, and the index is kept in `index` until the end.
    pub fn create_named(
        w: W,
        path: &Path,
        index: Box<dyn IndexStore>,
        header: &LogHeader,
    ) -> Result<RunLog<W>, LogError> {
        let sink = create_sink(w, path, index, header)?;
        Ok(RunLog {
            header: header.clone(),
            outputs: vec![Output { sink, first_tick: header.first_tick, lost_before: BTreeMap::new() }],
            next: None,
            ticks: TickOrder::default(),
            frames: FrameOrder::new(header),
            keyframes: VecDeque::new(),
            readings: VecDeque::new(),
            places: WriteOrder::ByTick,
            last: None,
            expected: Expected::of(header),
            lost: BTreeMap::new(),
        })
    }

    /// From now on writes replies, frames and keyframes in call order and closes chunks only on
    /// [`RunLog::close_chunk`]. Used to copy a log message by message.
    pub fn keep_places(&mut self) {
        self.places = WriteOrder::AsGiven;
    }

    /// Closes the open chunk.
    pub fn close_chunk(&mut self) -> Result<(), LogError> {
        self.outputs.iter_mut().try_for_each(|output| output.sink.close_chunk())
    }

    /// Begins another log of this run in `out`, at the first complete keyframe of a state of tick `from` or
    /// later; errors name `path`. From there on, every message goes to all open logs, except that this one
    /// gets no frame or reply of an earlier tick. Replaces a log that has not begun.
    pub fn begin_another(&mut self, from: Tick, out: W, path: &Path, index: Box<dyn IndexStore>) {
        self.next = Some(NextLog { from, out, path: path.into(), index });
    }

    /// Returns whether a log is still to begin.
    pub fn has_next(&self) -> bool {
        self.next.is_some()
    }

    /// The first tick of each open log, oldest first.
    pub fn first_ticks(&self) -> impl Iterator<Item = Tick> {
        self.outputs.iter().map(|output| output.first_tick)
    }

    /// Ends the log at this place among the open ones with what has been written so far.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn end(&mut self, place: usize, reason: EndReason) -> Result<(EndMarker, W), LogError> {
        self.end_with(place, reason, &BTreeMap::new())
    }

    /// Drops the log at this place among the open ones and returns its output, which has no end.
    pub fn discard(&mut self, place: usize) -> W {
        self.outputs.remove(place).sink.into_output()
    }

    /// Writes all waiting messages to the open logs. No log begins any more.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn drain(&mut self) -> Result<(), LogError> {
        self.next = None;
        self.write_ticks(Supply::Ended)?;
        self.write_keyframes(Tick(u64::MAX))?;
        self.write_frames(WriteScope::All)
    }

    /// Accepts u_k.
    pub fn latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        self.ticks.latched(latched);
        self.write_ticks(Supply::Open)
    }

    /// Accepts a state.
    pub fn state(&mut self, state: &State) -> Result<(), LogError> {
        self.ticks.state(state);
        self.write_ticks(Supply::Open)
    }

    /// Accepts the bytes of a `Removed` message: struct and voxel indices.
    pub fn removed(&mut self, message: &[u8]) -> Result<(), LogError> {
        let size = Removed::DESCRIPTION.size;
        let expected = match Removed::read_from_prefix(message) {
            Ok((removed, tail)) if tail.len() == removed.voxel_index_length as usize * 4 => None,
            Ok((removed, _)) => Some(size + removed.voxel_index_length as usize * 4),
            Err(_) => Some(size),
        };
        if let Some(expected) = expected {
            return Err(self.wrong_size(Topic::Removed, message.len(), expected));
        }
        self.ticks.removed(message);
        self.write_ticks(Supply::Open)
    }

    /// Accepts a sensor's reading, before the state with which it arrives.
    pub fn reading(&mut self, reading: &SensorReading) -> Result<(), LogError> {
        self.readings.push_back(*reading);
        Ok(())
    }

    /// Accepts the bytes of a `Keyframe` message: struct and data.
    pub fn keyframe(&mut self, message: &[u8]) -> Result<(), LogError> {
        let size = Keyframe::DESCRIPTION.size;
        match Keyframe::read_from_prefix(message) {
            Ok((head, data)) if data.len() == head.data_length as usize => {
                self.keyframes.push_back((Tick(head.tick), message.to_vec()));
                if self.places == WriteOrder::AsGiven {
                    self.write_keyframes(Tick(head.tick))
                } else {
                    Ok(())
                }
            }
            Ok((head, _)) => {
                let expected = size + head.data_length as usize;
                Err(self.wrong_size(Topic::Keyframe, message.len(), expected))
            }
            Err(_) => Err(self.wrong_size(Topic::Keyframe, message.len(), size)),
        }
    }

    /// Accepts a reply.
    pub fn drr_reply(&mut self, reply: &DrrReply) -> Result<(), LogError> {
        self.frames.reply(reply);
        self.write_frames(self.places.due())
    }

    /// Accepts a frame as sent on the wire: `Frame`, `ImagePrefix`, pixels.
    pub fn frame(&mut self, payload: &[u8]) -> Result<(), LogError> {
        let smallest = Frame::DESCRIPTION.size + ImagePrefix::DESCRIPTION.size;
        let Ok((frame, image)) = Frame::read_from_prefix(payload) else {
            return Err(self.wrong_size(Topic::DrrFrame, payload.len(), smallest));
        };
        let Ok((prefix, pixels)) = ImagePrefix::read_from_prefix(image) else {
            return Err(self.wrong_size(Topic::DrrFrame, payload.len(), smallest));
        };
        if pixels.len() != prefix.data_length as usize {
            let expected = smallest + prefix.data_length as usize;
            return Err(self.wrong_size(Topic::DrrFrame, payload.len(), expected));
        }
        self.frames.frame(&frame, Some(image));
        self.write_frames(self.places.due())
    }

    /// Accepts a frame whose image is not logged; its `pixel_hash` replaces the pixels.
    pub fn frame_without_image(&mut self, frame: &Frame) -> Result<(), LogError> {
        self.frames.frame(frame, None);
        self.write_frames(self.places.due())
    }

    /// The name of the oldest open log for error messages.
    pub fn path(&self) -> &Path {
        self.outputs.first().map_or(Path::new(""), |output| output.sink.path())
    }

    /// The last state written.
    pub fn last_state(&self) -> Option<&State> {
        self.last.as_ref()
    }

    /// Returns the messages missed so far, by topic, according to their numbers.
    pub fn lost(&self) -> &BTreeMap<&'static str, u64> {
        &self.lost
    }

    /// Writes all waiting messages, the end marker, the index and the footer. `lost` is the owner's count;
    /// the marker records the greater of the two counts per topic.
    pub fn finish(
        mut self,
        reason: EndReason,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(EndMarker, W), LogError> {
        self.drain()?;
        self.end_with(0, reason, lost)
    }

    fn end_with(
        &mut self,
        place: usize,
        reason: EndReason,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(EndMarker, W), LogError> {
        let Output { sink, lost_before, .. } = self.outputs.remove(place);
        let since = |(topic, count): (&&'static str, &u64)| {
            let count = count.saturating_sub(*lost_before.get(topic).unwrap_or(&0));
            (count > 0).then(|| (topic.to_string(), count))
        };
        let mut all: BTreeMap<String, u64> = self.lost.iter().filter_map(since).collect();
        for (topic, &count) in lost.iter().filter(|(_, count)| **count > 0) {
            let entry = all.entry(topic.clone()).or_default();
            *entry = count.max(*entry);
        }
        let last_tick = self.last.as_ref().map(|state| Tick(state.tick));
        let hash = self.last.as_ref().map(|state| state.hash);
        let marker =
            EndMarker { reason, last_tick, hash, counts: sink.counts(), lost: all, damaged: BTreeMap::new() };
        let w = sink.finish(&marker)?;
        Ok((marker, w))
    }

    fn write_ticks(&mut self, supply: Supply) -> Result<(), LogError> {
        loop {
            let messages = self.ticks.next(supply);
            if messages.is_empty() {
                return Ok(());
            }
            for message in messages {
                match message {
                    OrderedMessage::Latched(latched) => self.write_latched(&latched)?,
                    OrderedMessage::Removed(bytes) => self.write_removed(&bytes)?,
                    OrderedMessage::State(state) => self.write_state(&state)?,
                }
            }
        }
    }

    /// Writes the keyframes of states up to this one in a separate chunk, so that reading states does not
    /// read keyframes. The next log begins here if it is due.
    fn write_keyframes(&mut self, tick: Tick) -> Result<(), LogError> {
        if self.keyframes.front().is_none_or(|(of, _)| *of > tick) {
            return Ok(());
        }
        // A copy ends its chunks where the original does.
        if self.places == WriteOrder::ByTick {
            self.close_chunk()?;
        }
        let mut parts = Vec::new();
        while self.keyframes.front().is_some_and(|(of, _)| *of <= tick)
            && let Some((of, message)) = self.keyframes.pop_front()
        {
            if let Ok((head, _)) = Keyframe::read_from_prefix(&message) {
                let missed = missed(&mut self.expected.keyframe_sequence, head.sequence);
                self.count_lost(Topic::Keyframe, missed);
            }
            self.write(Topic::Keyframe, of, &[&message])?;
            parts.push(message);
        }
        if self.places == WriteOrder::ByTick {
            self.close_chunk()?;
        }
        self.begin_next(&parts)
    }

    /// Begins the next log if these are the keyframe of the last state.
    fn begin_next(&mut self, parts: &[Vec<u8>]) -> Result<(), LogError> {
        let Some(state) = self.last.filter(|state| is_keyframe_of(state, parts)) else { return Ok(()) };
        let first_tick = Tick(state.tick);
        let Some(next) = self.next.take_if(|next| first_tick >= next.from && first_tick > Tick::START) else {
            return Ok(());
        };
        let header = LogHeader { first_tick, ..self.header.clone() };
        let mut sink = create_sink(next.out, &next.path, next.index, &header)?;
        sink.message(place_of(Topic::State), first_tick, &[state.as_bytes()])?;
        sink.close_chunk()?;
        for part in parts {
            sink.message(place_of(Topic::Keyframe), first_tick, &[part])?;
        }
        sink.close_chunk()?;
        self.outputs.push(Output { sink, first_tick, lost_before: self.lost.clone() });
        Ok(())
    }

    /// Writes a message of [`topics::RUN_TOPICS`] to all open logs.
    fn write(&mut self, topic: Topic, tick: Tick, parts: &[&[u8]]) -> Result<(), LogError> {
        self.outputs.iter_mut().try_for_each(|output| output.sink.message(place_of(topic), tick, parts))
    }

    fn write_latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        let tick = Tick(latched.tick);
        self.write_keyframes(tick)?;
        self.count_lost(Topic::Latched, tick.since(self.expected.latched_tick));
        self.expected.latched_tick = tick.saturating_add(1);
        self.write(Topic::Latched, tick, &[latched.as_bytes()])
    }

    fn write_removed(&mut self, message: &[u8]) -> Result<(), LogError> {
        let Ok((removed, _)) = Removed::read_from_prefix(message) else {
            return Err(self.wrong_size(Topic::Removed, message.len(), Removed::DESCRIPTION.size));
        };
        let missed = missed(&mut self.expected.removed_sequence, removed.sequence);
        self.count_lost(Topic::Removed, missed);
        self.write(Topic::Removed, Tick(removed.tick), &[message])
    }

    fn write_state(&mut self, state: &State) -> Result<(), LogError> {
        let tick = Tick(state.tick);
        self.count_lost(Topic::State, tick.since(self.expected.state_tick));
        self.expected.state_tick = tick.saturating_add(1);
        self.write_readings(tick)?;
        self.write(Topic::State, tick, &[state.as_bytes()])?;
        let is_first = self.last.is_none();
        self.last = Some(*state);
        self.frames.tick(tick);
        self.write_frames(WriteScope::AtItsTick)?;
        // Closing the chunk here puts the initial state on disk even if the run starts paused.
        match self.places {
            WriteOrder::AsGiven => Ok(()),
            WriteOrder::ByTick if is_first => self.close_chunk(),
            WriteOrder::ByTick => self.outputs.iter_mut().try_for_each(|output| output.sink.end_tick(tick)),
        }
    }

    /// Writes the readings of states up to this one. Their channel is declared with the first reading, so a
    /// log without sensors has no such channel.
    fn write_readings(&mut self, tick: Tick) -> Result<(), LogError> {
        while self.readings.front().is_some_and(|reading| reading.tick <= tick.0)
            && let Some(reading) = self.readings.pop_front()
        {
            let missed = missed(&mut self.expected.reading_sequence, reading.sequence);
            self.count_lost(Topic::Sensor, missed);
            for Output { sink, .. } in &mut self.outputs {
                let channel = sink.channel(Topic::Sensor.name(), SensorReading::DESCRIPTION)?;
                sink.message(channel, Tick(reading.tick), &[reading.as_bytes()])?;
            }
        }
        Ok(())
    }

    fn write_frames(&mut self, due: WriteScope) -> Result<(), LogError> {
        while let Some(PlacedReply { tick, reply }) = self.frames.next_reply(due) {
            for Output { sink, .. } in self.outputs.iter_mut().filter(|output| output.first_tick <= tick) {
                sink.message(place_of(Topic::DrrReply), tick, &[reply.as_bytes()])?;
            }
        }
        while let Some(FrameWithImage { frame, image }) = self.frames.next_frame(due) {
            let missed = missed(&mut self.expected.frame_sequence, frame.sequence);
            self.count_lost(Topic::DrrFrame, missed);
            let tick = Tick(frame.tick);
            for Output { sink, .. } in self.outputs.iter_mut().filter(|output| output.first_tick <= tick) {
                sink.message(place_of(Topic::DrrFrame), tick, &[frame.as_bytes()])?;
                let Some(image) = &image else { continue };
                // Images get separate chunks, so that reading states does not read pixels.
                sink.close_chunk()?;
                sink.message(place_of(Topic::DrrImage), tick, &[image])?;
                sink.close_chunk()?;
            }
        }
        Ok(())
    }

    fn count_lost(&mut self, topic: Topic, count: u64) {
        if count > 0 {
            *self.lost.entry(topic.name()).or_default() += count;
        }
    }

    fn wrong_size(&self, topic: Topic, given: usize, expected: usize) -> LogError {
        LogError::Message {
            path: self.path().into(),
            topic: topic.to_string(),
            given: format!("{given} bytes"),
            expected: format!("{expected} bytes"),
        }
    }
}

/// Returns the channel of a topic of [`topics::RUN_TOPICS`].
fn place_of(topic: Topic) -> usize {
    topics::RUN_TOPICS.iter().position(|known| *known == topic).unwrap_or(0)
}

/// Returns whether messages are all parts, in order, of the keyframe of a state.
fn is_keyframe_of(state: &State, parts: &[Vec<u8>]) -> bool {
    let mut bytes = 0;
    let fits = parts.iter().all(|part| {
        let Ok((head, data)) = Keyframe::read_from_prefix(part) else { return false };
        let follows = head.tick == state.tick && head.hash == state.hash && head.offset_bytes == bytes;
        bytes = bytes.saturating_add(data.len() as u32);
        follows
    });
    let total = parts.last().and_then(|part| Keyframe::read_from_prefix(part).ok());
    fits && total.is_some_and(|(head, _)| bytes == head.total_bytes)
}
