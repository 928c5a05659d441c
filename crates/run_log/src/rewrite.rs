//! Copies records of existing logs into a new log, unchanged.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::path::{Path, PathBuf};

use mcap::records::{Channel, MessageHeader, Metadata, SchemaHeader, op};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};

use crate::error::LogError;
use crate::index::Summary;
use crate::limits::DeclarationCount;
use crate::records::AttachmentRecord;
use crate::sink::PROFILE;
use crate::walk::WalkItem;

/// How chunks are compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packing {
    /// Uncompressed.
    None,
    /// LZ4 at a level: 0 to 2 fast, 3 to 12 denser and slower. The recorder uses 0.
    Lz4(u32),
    /// Zstandard at a level, 1 to 22.
    Zstd(u32),
}

impl Packing {
    /// The recorder's setting.
    pub const RECORDED: Packing = Packing::Lz4(0);

    fn compression(self) -> (Option<Compression>, u32) {
        match self {
            Packing::None => (None, 0),
            Packing::Lz4(level) => (Some(Compression::Lz4), level),
            Packing::Zstd(level) => (Some(Compression::Zstd), level),
        }
    }
}

/// A new log assembled from records of other logs.
pub(crate) struct Rewriter<W: Write> {
    writer: Writer<NoSeek<W>>,
    path: PathBuf,
    /// Maps the current source's schema and channel ids to those of the new log.
    schemas: BTreeMap<u16, u16>,
    channels: BTreeMap<u16, u16>,
    /// Prefix of the current source's topics.
    prefix: String,
    /// Declarations for channels whose own declaration is lost.
    declared: Summary,
    /// Schemas and channels of the new log, and their memory use.
    written: BTreeSet<(u8, u16)>,
    counted: DeclarationCount,
}

impl<W: Write> Rewriter<W> {
    /// Writes the start of a log with this `library` field to `out`; errors name `path`.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn create(out: W, path: &Path, packing: Packing, library: &str) -> Result<Rewriter<W>, LogError> {
        let (compression, level) = packing.compression();
        // Only our own code decides where chunks end, so that the bytes depend on the calls alone.
        let options =
            WriteOptions::new().library(library).profile(PROFILE).chunk_size(None).disable_seeking(true);
        let options = options.compression(compression).compression_level(level).compression_threads(0);
        let writer = options.create(NoSeek::new(out));
        Ok(Rewriter {
            writer: writer.map_err(|error| encode_error(path, error))?,
            path: path.into(),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            prefix: String::new(),
            declared: Summary::default(),
            written: BTreeSet::new(),
            counted: DeclarationCount::default(),
        })
    }

    /// Starts another source, with its own ids; its topics get `prefix`.
    pub fn begin_source(&mut self, prefix: &str) {
        self.schemas.clear();
        self.channels.clear();
        self.prefix = prefix.to_owned();
    }

    /// Declares channels and schemas of the current source; each is written before the first record that
    /// needs it.
    pub fn declare(&mut self, declared: Summary) {
        self.declared = declared;
    }

    /// Returns whether a channel of the current source has been written.
    pub fn knows(&self, channel: u16) -> bool {
        self.channels.contains_key(&channel)
    }

    fn with<T>(
        &mut self,
        act: impl FnOnce(&mut Writer<NoSeek<W>>) -> mcap::McapResult<T>,
    ) -> Result<T, LogError> {
        act(&mut self.writer).map_err(|error| encode_error(&self.path, error))
    }

    /// Copies a record; the caller handles damage and the end of the source.
    pub fn piece(&mut self, piece: WalkItem<'_>) -> Result<(), LogError> {
        match piece {
            WalkItem::Attachment(found) => self.attachment(&found),
            WalkItem::Metadata { name, entries } => self.metadata(name, entries),
            WalkItem::Schema { header, data } => self.schema(&header, data),
            WalkItem::Channel(channel) => self.channel(channel),
            WalkItem::Message { header, data } => self.message(header, data),
            WalkItem::ChunkEnd => self.with(Writer::flush),
            WalkItem::ChunkBegin(_) | WalkItem::DataEnd(_) | WalkItem::Lost(_) | WalkItem::Cut { .. } => {
                Ok(())
            }
        }
    }

    pub fn attachment(&mut self, found: &AttachmentRecord) -> Result<(), LogError> {
        self.with(|writer| {
            writer.attach(&Attachment {
                log_time: found.log_time,
                create_time: found.create_time,
                name: found.name.clone(),
                media_type: found.media_type.clone(),
                data: Cow::Borrowed(&found.data),
            })
        })
    }

    pub fn metadata(&mut self, name: String, entries: BTreeMap<String, String>) -> Result<(), LogError> {
        self.with(|writer| writer.write_metadata(&Metadata { name, metadata: entries }))
    }

    fn schema(&mut self, header: &SchemaHeader, data: &[u8]) -> Result<(), LogError> {
        let id = self.with(|writer| writer.add_schema(&header.name, &header.encoding, data))?;
        self.schemas.insert(header.id, id);
        // The writer keeps each declaration once.
        if self.written.insert((op::SCHEMA, id)) {
            self.counted.schema(&self.path, header, data.len())?;
        }
        Ok(())
    }

    fn channel(&mut self, channel: Channel) -> Result<(), LogError> {
        if !self.schemas.contains_key(&channel.schema_id)
            && let Some((header, data)) = self.declared.schemas.remove(&channel.schema_id)
        {
            self.schema(&header, &data)?;
        }
        let schema = self.schemas.get(&channel.schema_id).copied().unwrap_or(0);
        let topic = format!("{}{}", self.prefix, channel.topic);
        let id = self.with(|writer| {
            writer.add_channel(schema, &topic, &channel.message_encoding, &channel.metadata)
        })?;
        self.channels.insert(channel.id, id);
        if self.written.insert((op::CHANNEL, id)) {
            self.counted.channel(&self.path, &channel)?;
        }
        Ok(())
    }

    fn message(&mut self, header: MessageHeader, data: &[u8]) -> Result<(), LogError> {
        if !self.knows(header.channel_id)
            && let Some(channel) = self.declared.channels.remove(&header.channel_id)
        {
            self.channel(channel)?;
        }
        let Some(&channel_id) = self.channels.get(&header.channel_id) else { return Ok(()) };
        let header = MessageHeader { channel_id, ..header };
        self.with(|writer| writer.write_to_known_channel(&header, data))
    }

    /// Writes the index and the footer, flushes, and returns the output.
    pub fn finish(mut self) -> Result<W, LogError> {
        self.with(|writer| writer.finish().map(|_| ()))?;
        let mut written = self.writer.into_inner().into_inner();
        written.flush().map_err(|source| LogError::Write { path: self.path, source })?;
        Ok(written)
    }
}

fn encode_error(path: &Path, error: McapError) -> LogError {
    match error {
        McapError::Io(source) => LogError::Write { path: path.into(), source },
        source => LogError::Encode { path: path.into(), source },
    }
}
