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
pub struct TimingLog<W: Write> {
    sink: Sink<W>,
    last_tick: Option<Tick>,
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
        Ok(TimingLog { sink: Sink::create(w, path, index, header, "timing")?, last_tick: None })
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
                path: self.sink.path().into(),
                topic: topic.to_string(),
                given: format!("{} bytes", message.len()),
                expected: format!("{expected} of {}", description.short_name()),
            });
        }
        let channel = self.sink.channel(topic, description)?;
        self.last_tick = self.last_tick.max(Some(tick));
        self.sink.message(channel, tick, &[message])?;
        self.sink.end_tick(tick)
    }

    /// The file's name for error messages.
    pub fn path(&self) -> &Path {
        self.sink.path()
    }

    /// Flushes everything so far to the operating system. The owner calls it when no tick will follow for a
    /// while (pause).
    pub fn flush(&mut self) -> Result<(), LogError> {
        self.sink.close_chunk()
    }

    /// Writes the end marker, the index and the footer. `lost` is the owner's count.
    pub fn finish(self, reason: EndReason, lost: &BTreeMap<String, u64>) -> Result<(EndMarker, W), LogError> {
        let lost = lost.iter().filter(|(_, n)| **n > 0).map(|(topic, n)| (topic.clone(), *n)).collect();
        let counts = self.sink.counts();
        let marker = EndMarker {
            reason,
            last_tick: self.last_tick,
            hash: None,
            counts,
            lost,
            damaged: BTreeMap::new(),
        };
        let w = self.sink.finish(&marker)?;
        Ok((marker, w))
    }
}
