//! How much of a log is kept in memory while it is read.
//!
//! A chunk of a few kilobytes can unpack to a hundred megabytes of names. So what a reader keeps beyond the current record is
//! bounded here, by kind; our own logs need less than a hundredth of these limits.

use std::path::Path;

use mcap::records::{Channel, SchemaHeader};

use crate::error::LogError;

/// Longest name of a topic, a schema, an encoding, an attachment or a metadata record. Names of ROS have at most 255 bytes.
pub(crate) const MAX_NAME_BYTES: usize = 256;
/// Most schemas, and most channels, of a file.
pub(crate) const MAX_DECLARATIONS: usize = 4096;
/// Longest record of a schema or channel.
pub(crate) const MAX_DECLARATION_BYTES: usize = 1 << 20;
/// Bytes of all schemas and channels together, where their text is kept.
pub(crate) const MAX_DECLARED_BYTES: usize = 16 << 20;
/// Longest metadata record: the header, the end marker.
pub(crate) const MAX_METADATA_BYTES: usize = 1 << 20;
/// Longest scene or calibration.
pub(crate) const MAX_SCENE_BYTES: usize = 16 << 20;
/// Longest index that is used; with a longer one, every chunk is read.
pub(crate) const MAX_INDEX_BYTES: u64 = 64 << 20;
/// Most damaged pieces of a file, and most stretches of missing ticks, that a report lists.
pub(crate) const MAX_TOLD: usize = 64;

/// How much a reader keeps of the declarations so far.
#[derive(Debug, Default)]
pub(crate) struct Declared {
    schemas: usize,
    channels: usize,
    bytes: usize,
}

impl Declared {
    /// Counts a schema that will be kept, with so many bytes of its text.
    pub fn schema(&mut self, path: &Path, header: &SchemaHeader, text: usize) -> Result<(), LogError> {
        self.schemas += 1;
        check(path, "schemas", self.schemas, MAX_DECLARATIONS)?;
        check(path, "bytes of a schema's name", header.name.len(), MAX_NAME_BYTES)?;
        check(path, "bytes of a schema's encoding", header.encoding.len(), MAX_NAME_BYTES)?;
        self.keep(path, header.name.len() + header.encoding.len() + text)
    }

    /// Counts a channel that will be kept.
    pub fn channel(&mut self, path: &Path, channel: &Channel) -> Result<(), LogError> {
        self.channels += 1;
        check(path, "channels", self.channels, MAX_DECLARATIONS)?;
        check(path, "bytes of a topic's name", channel.topic.len(), MAX_NAME_BYTES)?;
        check(path, "bytes of a channel's encoding", channel.message_encoding.len(), MAX_NAME_BYTES)?;
        let facts: usize = channel.metadata.iter().map(|(key, value)| key.len() + value.len()).sum();
        self.keep(path, channel.topic.len() + channel.message_encoding.len() + facts)
    }

    fn keep(&mut self, path: &Path, bytes: usize) -> Result<(), LogError> {
        self.bytes += bytes;
        check(path, "bytes of schemas and channels", self.bytes, MAX_DECLARED_BYTES)
    }
}

/// Refuses what is more than `most`.
pub(crate) fn check(path: &Path, what: &'static str, found: usize, most: usize) -> Result<(), LogError> {
    if found <= most {
        return Ok(());
    }
    Err(LogError::TooMuch { path: path.into(), what, found, most })
}

/// The record of a schema or channel, before it is taken apart.
pub(crate) fn check_declaration(path: &Path, body: &[u8]) -> Result<(), LogError> {
    check(path, "bytes of a schema or channel", body.len(), MAX_DECLARATION_BYTES)
}
