//! The writer of `run.mcap`, the deterministic lane.

use std::collections::{BTreeMap, VecDeque};
use std::io::{Cursor, Write};
use std::path::Path;

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
pub struct RunLog<W: Write> {
    sink: Sink<W>,
    ticks: TickOrder,
    frames: FrameOrder,
    keyframes: VecDeque<(Tick, Vec<u8>)>,
    /// Readings of states that are not written yet.
    readings: VecDeque<SensorReading>,
    places: WriteOrder,
    channels: Channels,
    last: Option<State>,
    expected: Expected,
    lost: BTreeMap<&'static str, u64>,
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

struct Channels {
    latched: usize,
    state: usize,
    removed: usize,
    reply: usize,
    frame: usize,
    image: usize,
    keyframe: usize,
}

/// Sequence numbers expected of the next messages.
#[derive(Default)]
struct Expected {
    latched_tick: Tick,
    state_tick: Tick,
    removed_sequence: u64,
    frame_sequence: u64,
    keyframe_sequence: u64,
    reading_sequence: u64,
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
        let mut sink = Sink::create(w, path, index, header, "run")?;
        let mut channel =
            |i: usize| sink.channel(topics::RUN_TOPICS[i].name(), topics::RUN_TOPICS[i].description());
        let channels = Channels {
            latched: channel(0)?,
            state: channel(1)?,
            removed: channel(2)?,
            reply: channel(3)?,
            frame: channel(4)?,
            image: channel(5)?,
            keyframe: channel(6)?,
        };
        Ok(RunLog {
            sink,
            ticks: TickOrder::default(),
            frames: FrameOrder::new(header),
            keyframes: VecDeque::new(),
            readings: VecDeque::new(),
            places: WriteOrder::ByTick,
            channels,
            last: None,
            expected: Expected {
                removed_sequence: 1,
                frame_sequence: 1,
                keyframe_sequence: 1,
                reading_sequence: 1,
                ..Expected::default()
            },
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
        self.sink.close_chunk()
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

    /// The file's name for error messages.
    pub fn path(&self) -> &Path {
        self.sink.path()
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
        self.write_ticks(Supply::Ended)?;
        self.write_keyframes(Tick(u64::MAX))?;
        self.write_frames(WriteScope::All)?;
        let mut all: BTreeMap<String, u64> = self.lost.iter().map(|(k, n)| (k.to_string(), *n)).collect();
        for (topic, &count) in lost.iter().filter(|(_, count)| **count > 0) {
            let entry = all.entry(topic.clone()).or_default();
            *entry = count.max(*entry);
        }
        let last_tick = self.last.as_ref().map(|state| Tick(state.tick));
        let hash = self.last.as_ref().map(|state| state.hash);
        let marker = EndMarker {
            reason,
            last_tick,
            hash,
            counts: self.sink.counts(),
            lost: all,
            damaged: BTreeMap::new(),
        };
        let w = self.sink.finish(&marker)?;
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
    /// read keyframes.
    fn write_keyframes(&mut self, tick: Tick) -> Result<(), LogError> {
        if self.keyframes.front().is_none_or(|(of, _)| *of > tick) {
            return Ok(());
        }
        // A copy ends its chunks where the original does.
        if self.places == WriteOrder::ByTick {
            self.sink.close_chunk()?;
        }
        while self.keyframes.front().is_some_and(|(of, _)| *of <= tick)
            && let Some((of, message)) = self.keyframes.pop_front()
        {
            if let Ok((head, _)) = Keyframe::read_from_prefix(&message) {
                let missed = head.sequence.saturating_sub(self.expected.keyframe_sequence);
                self.count_lost(Topic::Keyframe, missed);
                self.expected.keyframe_sequence = head.sequence.saturating_add(1);
            }
            self.sink.message(self.channels.keyframe, of, &[&message])?;
        }
        if self.places == WriteOrder::ByTick { self.sink.close_chunk() } else { Ok(()) }
    }

    fn write_latched(&mut self, latched: &Latched) -> Result<(), LogError> {
        let tick = Tick(latched.tick);
        self.write_keyframes(tick)?;
        self.count_lost(Topic::Latched, tick.since(self.expected.latched_tick));
        self.expected.latched_tick = tick.saturating_add(1);
        self.sink.message(self.channels.latched, tick, &[latched.as_bytes()])
    }

    fn write_removed(&mut self, message: &[u8]) -> Result<(), LogError> {
        let Ok((removed, _)) = Removed::read_from_prefix(message) else {
            return Err(self.wrong_size(Topic::Removed, message.len(), Removed::DESCRIPTION.size));
        };
        let missed = removed.sequence.saturating_sub(self.expected.removed_sequence);
        self.count_lost(Topic::Removed, missed);
        self.expected.removed_sequence = removed.sequence.saturating_add(1);
        self.sink.message(self.channels.removed, Tick(removed.tick), &[message])
    }

    fn write_state(&mut self, state: &State) -> Result<(), LogError> {
        let tick = Tick(state.tick);
        self.count_lost(Topic::State, tick.since(self.expected.state_tick));
        self.expected.state_tick = tick.saturating_add(1);
        self.write_readings(tick)?;
        self.sink.message(self.channels.state, tick, &[state.as_bytes()])?;
        let is_first = self.last.is_none();
        self.last = Some(*state);
        self.frames.tick(tick);
        self.write_frames(WriteScope::AtItsTick)?;
        // Closing the chunk here puts the initial state on disk even if the run starts paused.
        match self.places {
            WriteOrder::AsGiven => Ok(()),
            WriteOrder::ByTick if is_first => self.sink.close_chunk(),
            WriteOrder::ByTick => self.sink.end_tick(tick),
        }
    }

    /// Writes the readings of states up to this one. Their channel is declared with the first reading, so a
    /// log without sensors has no such channel.
    fn write_readings(&mut self, tick: Tick) -> Result<(), LogError> {
        while self.readings.front().is_some_and(|reading| reading.tick <= tick.0)
            && let Some(reading) = self.readings.pop_front()
        {
            let missed = reading.sequence.saturating_sub(self.expected.reading_sequence);
            self.count_lost(Topic::Sensor, missed);
            self.expected.reading_sequence = reading.sequence.saturating_add(1);
            let channel = self.sink.channel(Topic::Sensor.name(), SensorReading::DESCRIPTION)?;
            self.sink.message(channel, Tick(reading.tick), &[reading.as_bytes()])?;
        }
        Ok(())
    }

    fn write_frames(&mut self, due: WriteScope) -> Result<(), LogError> {
        while let Some(PlacedReply { tick, reply }) = self.frames.next_reply(due) {
            self.sink.message(self.channels.reply, tick, &[reply.as_bytes()])?;
        }
        while let Some(FrameWithImage { frame, image }) = self.frames.next_frame(due) {
            let missed = frame.sequence.saturating_sub(self.expected.frame_sequence);
            self.count_lost(Topic::DrrFrame, missed);
            self.expected.frame_sequence = frame.sequence.saturating_add(1);
            self.sink.message(self.channels.frame, Tick(frame.tick), &[frame.as_bytes()])?;
            let Some(image) = image else { continue };
            // Images get separate chunks, so that reading states does not read pixels.
            self.sink.close_chunk()?;
            self.sink.message(self.channels.image, Tick(frame.tick), &[&image])?;
            self.sink.close_chunk()?;
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
            path: self.sink.path().into(),
            topic: topic.to_string(),
            given: format!("{given} bytes"),
            expected: format!("{expected} bytes"),
        }
    }
}
