//! The writer of `timing.mcap`, the wall-clock lane.

use std::collections::BTreeMap;
use std::io::{Cursor, Write};
use std::path::Path;

use messages::layout::{Description, Message};
use messages::{Command, Tick};

use crate::end::{EndMarker, EndReason};
use crate::error::LogError;
use crate::fields::message_size;
use crate::header::LogHeader;
use crate::mcap_writer::IndexStore;
use crate::sink::Sink;
use crate::topics::Topic;

/// The wall-clock lane of a run, being written. Its log times are simulated time too, so that both files
/// share an axis; its contents are not reproducible.
///
/// As [`RunLog`](crate::RunLog), it can write several logs of one run.
pub struct TimingLog<W: Write> {
    header: LogHeader,
    outputs: Vec<Output<W>>,
    last_tick: Option<Tick>,
}

/// A log being written.
struct Output<W: Write> {
    sink: Sink<W>,
    /// The owner's count of lost messages when it began.
    lost_before: BTreeMap<String, u64>,
}

impl<W: Write> TimingLog<W> {
    /// Writes the header to `w`; errors name `timing.mcap`, and the index is kept in memory.
    pub fn create(w: W, header: &LogHeader) -> Result<TimingLog<W>, LogError> {
        TimingLog::create_named(w, Path::new("timing.mcap"), Box::new(Cursor::new(Vec::new())), header)
    }

    /// Writes the header to `w`; errors name `path`, and the index is kept in `index` until the end.
    pub fn create_named(
        w: W,
        path: &Path,
        index: Box<dyn IndexStore>,
        header: &LogHeader,
    ) -> Result<TimingLog<W>, LogError> {
        let sink = Sink::create(w, path, index, header, "timing")?;
        let outputs = vec![Output { sink, lost_before: BTreeMap::new() }];
        Ok(TimingLog { header: header.clone(), outputs, last_tick: None })
    }

    /// Begins another log of this run in `w`, which belongs to the run lane's log from this tick on; errors
    /// name `path`. From now on, every message goes to all open logs. `lost` is the owner's count so far.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn begin_another(
        &mut self,
        first_tick: Tick,
        w: W,
        path: &Path,
        index: Box<dyn IndexStore>,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(), LogError> {
        let header = LogHeader { first_tick, ..self.header.clone() };
        let sink = Sink::create(w, path, index, &header, "timing")?;
        self.outputs.push(Output { sink, lost_before: lost.clone() });
        Ok(())
    }

    /// Drops the log at this place among the open ones and returns its output, which has no end.
    pub fn discard(&mut self, place: usize) -> W {
        self.outputs.remove(place).sink.into_output()
    }

    /// Writes a message's bytes, struct and tail. `tick` is `State.tick` of the newest state when the message
    /// arrived.
    pub fn message(&mut self, topic: Topic, tick: Tick, message: &[u8]) -> Result<(), LogError> {
        self.write(topic.name(), topic.description(), tick, message)
    }

    /// Like [`message`](Self::message), for a command on its controller's topic
    /// ([`command_topic`](crate::command_topic)).
    pub fn command(&mut self, topic: &str, tick: Tick, message: &[u8]) -> Result<(), LogError> {
        self.write(topic, Command::DESCRIPTION, tick, message)
    }

    fn write(
        &mut self,
        topic: &str,
        description: &'static Description,
        tick: Tick,
        message: &[u8],
    ) -> Result<(), LogError> {
        let expected = message_size(description, message);
        if expected != Some(message.len()) {
            let expected =
                expected.map_or(format!("at least {} bytes", description.size), |n| format!("{n} bytes"));
            return Err(LogError::Message {
                path: self.path().into(),
                topic: topic.to_string(),
                given: format!("{} bytes", message.len()),
                expected: format!("{expected} of {}", description.short_name()),
            });
        }
        self.last_tick = self.last_tick.max(Some(tick));
        for Output { sink, .. } in &mut self.outputs {
            let channel = sink.channel(topic, description)?;
            sink.message(channel, tick, &[message])?;
            sink.end_tick(tick)?;
        }
        Ok(())
    }

    /// The name of the oldest open log for error messages.
    pub fn path(&self) -> &Path {
        self.outputs.first().map_or(Path::new(""), |output| output.sink.path())
    }

    /// Flushes everything so far to the operating system. The owner calls it when no tick will follow for a
    /// while (pause).
    pub fn flush(&mut self) -> Result<(), LogError> {
        self.outputs.iter_mut().try_for_each(|output| output.sink.close_chunk())
    }

    /// Writes the end marker, the index and the footer. `lost` is the owner's count.
    pub fn finish(
        mut self,
        reason: EndReason,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(EndMarker, W), LogError> {
        self.end(0, reason, lost)
    }

    /// Ends the log at this place among the open ones as [`finish`](Self::finish) does.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn end(
        &mut self,
        place: usize,
        reason: EndReason,
        lost: &BTreeMap<String, u64>,
    ) -> Result<(EndMarker, W), LogError> {
        let Output { sink, lost_before } = self.outputs.remove(place);
        let since = |(topic, count): (&String, &u64)| {
            let count = count.saturating_sub(*lost_before.get(topic).unwrap_or(&0));
            (count > 0).then(|| (topic.clone(), count))
        };
        let lost = lost.iter().filter_map(since).collect();
        let counts = sink.counts();
        let marker = EndMarker {
            reason,
            last_tick: self.last_tick,
            hash: None,
            counts,
            lost,
            damaged: BTreeMap::new(),
        };
        let w = sink.finish(&marker)?;
        Ok((marker, w))
    }
}
