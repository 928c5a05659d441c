//! Limits on how much of a log a reader keeps in memory.
//!
//! A chunk of a few kilobytes can unpack to a hundred megabytes of names. Everything that a reader keeps
//! beyond the current record is therefore limited here, by kind; our own logs use less than a hundredth of
//! these limits.

use std::path::Path;

use mcap::records::{Channel, SchemaHeader};

use crate::error::LogError;
use crate::records::MAX_RECORD_BYTES;

/// Longest name of a topic, schema, encoding, attachment or metadata record. ROS names have at most 255
/// bytes.
pub(crate) const MAX_NAME_BYTES: usize = 256;
/// Maximum number of schemas, and of channels, in a file.
pub(crate) const MAX_DECLARATIONS: usize = 4096;
/// Longest schema or channel record.
pub(crate) const MAX_DECLARATION_BYTES: usize = 1 << 20;
/// Total bytes of all schemas and channels whose text is kept.
pub(crate) const MAX_DECLARED_BYTES: usize = 16 << 20;
/// Longest metadata record, such as the header or the end marker.
pub(crate) const MAX_METADATA_BYTES: usize = 1 << 20;
/// Longest scene or calibration.
pub(crate) const MAX_SCENE_BYTES: usize = 16 << 20;
/// Longest index that is used; above that, every chunk is read.
pub(crate) const MAX_INDEX_BYTES: u64 = 64 << 20;
/// Maximum number of damaged pieces, and of stretches of missing ticks, that a report lists.
pub(crate) const MAX_REPORTED: usize = 64;

const _: () = assert!(MAX_NAME_BYTES > 255, "every ROS name fits");
const _: () = assert!(MAX_DECLARATION_BYTES <= MAX_DECLARED_BYTES);
const _: () =
    assert!(MAX_SCENE_BYTES as u64 <= MAX_RECORD_BYTES && MAX_METADATA_BYTES as u64 <= MAX_RECORD_BYTES);

/// Counts the declarations that a reader has kept.
#[derive(Debug, Default)]
pub(crate) struct DeclarationCount {
    schemas: usize,
    channels: usize,
    bytes: usize,
}

impl DeclarationCount {
    /// Counts a schema to be kept, with this many bytes of text.
    pub fn schema(&mut self, path: &Path, header: &SchemaHeader, text: usize) -> Result<(), LogError> {
        self.schemas += 1;
        check(path, "schemas", self.schemas, MAX_DECLARATIONS)?;
        check(path, "bytes of a schema's name", header.name.len(), MAX_NAME_BYTES)?;
        check(path, "bytes of a schema's encoding", header.encoding.len(), MAX_NAME_BYTES)?;
        self.keep(path, header.name.len() + header.encoding.len() + text)
    }

    /// Counts a channel to be kept.
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

/// Returns an error if `found` exceeds `most`.
pub(crate) fn check(path: &Path, what: &'static str, found: usize, most: usize) -> Result<(), LogError> {
    if found <= most {
        return Ok(());
    }
    Err(LogError::TooMuch { path: path.into(), what, found, most })
}

/// Checks a schema or channel record before it is parsed.
pub(crate) fn check_declaration(path: &Path, body: &[u8]) -> Result<(), LogError> {
    check(path, "bytes of a schema or channel", body.len(), MAX_DECLARATION_BYTES)
}
