//! One MCAP file being written: channels, counters, chunks.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use messages::Tick;
use messages::layout::{CDR_LITTLE_ENDIAN, Description};
use messages::services::{EVENT, KEYFRAME, REMOVED};

use crate::end::{END_RECORD, EndMarker};
use crate::error::LogError;
use crate::header::{CALIBRATION_ATTACHMENT, HEADER_RECORD, LogHeader, SCENE_ATTACHMENT};
use crate::library::LIBRARY;
use crate::mcap_writer::{IndexStore, McapWriter};
use crate::records::MAX_RECORD_BYTES;
use crate::topics;

/// Declares that all channels are `cdr` with `ros2msg` schemas; `rosbags` does not open a file without it.
pub(crate) const PROFILE: &str = "ros2";
/// A chunk is closed after this much simulated time, which bounds what is lost if the recorder is killed.
const CHUNK_NS: u64 = 100_000_000;
/// A chunk is also closed once it holds this many bytes.
const CHUNK_BYTES: usize = 4 << 20;
/// Longest message that is logged, in bytes. Readers reject longer records, so that a damaged length cannot
/// exhaust memory.
pub(crate) const MAX_MESSAGE_BYTES: usize = 128 << 20;

// Everything that a session can send is logged; a frame's size depends on its scene.
const _: () = assert!(
    REMOVED.max_bytes < MAX_MESSAGE_BYTES
        && KEYFRAME.max_bytes < MAX_MESSAGE_BYTES
        && EVENT.max_bytes < MAX_MESSAGE_BYTES
);
const _: () = assert!(
    MAX_RECORD_BYTES > (CHUNK_BYTES + MAX_MESSAGE_BYTES) as u64,
    "a chunk that is closed behind the longest message can be read"
);

struct Channel {
    topic: String,
    id: u16,
    count: u64,
}

/// An MCAP file being written. Its bytes depend on the calls alone.
pub(crate) struct Sink<W: Write> {
    writer: McapWriter<W>,
    path: PathBuf,
    /// The second copy of the header, until it is written after the first chunk, where damage to the first
    /// copy cannot reach it.
    second: Option<Header>,
    channels: Vec<Channel>,
    dt_ns: u64,
    /// Ticks per chunk.
    chunk_ticks: u64,
    /// `tick / chunk_ticks` at the last end of a tick.
    last_chunk: u64,
    chunk_bytes: usize,
    /// CDR header and message, contiguous.
    scratch: Vec<u8>,
}

/// The content written at the start of a log and again after its first chunk: scene and calibration as
/// attachments, everything else as metadata.
struct Header {
    header: LogHeader,
    entries: BTreeMap<String, String>,
}

impl Header {
    fn write<W: Write>(&self, writer: &mut McapWriter<W>) -> std::io::Result<()> {
        let attachments = [
            (SCENE_ATTACHMENT, "application/toml", Some(&self.header.scene_toml)),
            (CALIBRATION_ATTACHMENT, "application/json", self.header.calibration_json.as_ref()),
        ];
        for (name, media_type, text) in attachments {
            let Some(text) = text else { continue };
            writer.attach(name, media_type, text.as_bytes())?;
        }
        writer.metadata(HEADER_RECORD, self.entries.clone())
    }
}

impl<W: Write> Sink<W> {
    /// Writes and flushes the header.
    pub fn create(
        w: W,
        path: &Path,
        index: Box<dyn IndexStore>,
        header: &LogHeader,
        lane: &str,
    ) -> Result<Sink<W>, LogError> {
        let fail = |source| LogError::Write { path: path.into(), source };
        let mut writer = McapWriter::create(w, index, PROFILE, LIBRARY).map_err(fail)?;
        let second = Header { header: header.clone(), entries: header.to_metadata(lane) };
        second.write(&mut writer).map_err(fail)?;
        // A log is identifiable even if its writer is killed before the first chunk.
        writer.flush_output().map_err(fail)?;
        let dt_ns = header.dt_ns.max(1);
        Ok(Sink {
            writer,
            path: path.into(),
            second: Some(second),
            channels: Vec::new(),
            dt_ns,
            chunk_ticks: (CHUNK_NS / dt_ns).max(1),
            last_chunk: 0,
            chunk_bytes: 0,
            scratch: Vec::new(),
        })
    }

    /// The file's name for error messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The channel of a topic, declared on first use.
    pub fn channel(&mut self, topic: &str, description: &'static Description) -> Result<usize, LogError> {
        if let Some(index) = self.channels.iter().position(|channel| channel.topic == topic) {
            return Ok(index);
        }
        let (name, text) = topics::schema_of(description);
        let path = &self.path;
        let fail = |source| LogError::Write { path: path.clone(), source };
        let schema = self.writer.schema(name, "ros2msg", text.as_bytes()).map_err(fail)?;
        let facts = topics::channel_metadata(description);
        let id = self.writer.channel(schema, topic, "cdr", facts).map_err(fail)?;
        self.channels.push(Channel { topic: topic.to_string(), id, count: 0 });
        Ok(self.channels.len() - 1)
    }

    /// Writes a message, given as consecutive parts, at a tick's time.
    pub fn message(&mut self, channel: usize, tick: Tick, parts: &[&[u8]]) -> Result<(), LogError> {
        self.scratch.clear();
        self.scratch.extend_from_slice(&CDR_LITTLE_ENDIAN);
        parts.iter().for_each(|part| self.scratch.extend_from_slice(part));
        let channel = &mut self.channels[channel];
        if self.scratch.len() > MAX_MESSAGE_BYTES {
            let given = format!("{} bytes", self.scratch.len());
            let expected = format!("at most {MAX_MESSAGE_BYTES}");
            let topic = channel.topic.clone();
            return Err(LogError::Message { path: self.path.clone(), topic, given, expected });
        }
        let time = tick.0.saturating_mul(self.dt_ns);
        let sequence = channel.count as u32;
        let header = MessageHeader { channel_id: channel.id, sequence, log_time: time, publish_time: time };
        let written = self.writer.message(&header, &self.scratch);
        written.map_err(|source| LogError::Write { path: self.path.clone(), source })?;
        channel.count += 1;
        self.chunk_bytes += self.scratch.len();
        Ok(())
    }

    /// Ends a tick: closes the chunk every 100 ms and whenever it is large.
    pub fn end_tick(&mut self, tick: Tick) -> Result<(), LogError> {
        let chunk = tick.0 / self.chunk_ticks;
        if chunk <= self.last_chunk && self.chunk_bytes < CHUNK_BYTES {
            return Ok(());
        }
        self.last_chunk = chunk.max(self.last_chunk);
        self.close_chunk()
    }

    /// Closes the open chunk and flushes it to the operating system.
    pub fn close_chunk(&mut self) -> Result<(), LogError> {
        let has_messages = std::mem::take(&mut self.chunk_bytes) > 0;
        let fail = |source| LogError::Write { path: self.path.clone(), source };
        self.writer.flush().map_err(fail)?;
        match self.second.take_if(|_| has_messages) {
            Some(header) => {
                header.write(&mut self.writer).map_err(fail)?;
                self.writer.flush().map_err(fail)
            }
            None => Ok(()),
        }
    }

    /// Messages written, by topic.
    pub fn counts(&self) -> BTreeMap<String, u64> {
        self.channels.iter().map(|channel| (channel.topic.clone(), channel.count)).collect()
    }

    /// Returns the output without an end.
    pub fn into_output(self) -> W {
        self.writer.into_output()
    }

    /// Writes the end marker, the index and the footer.
    pub fn finish(mut self, marker: &EndMarker) -> Result<W, LogError> {
        self.close_chunk()?;
        let fail = |source| LogError::Write { path: self.path.clone(), source };
        if let Some(header) = self.second.take() {
            header.write(&mut self.writer).map_err(fail)?;
        }
        self.writer.metadata(END_RECORD, marker.to_metadata()).map_err(fail)?;
        self.writer.finish().map_err(fail)
    }
}
