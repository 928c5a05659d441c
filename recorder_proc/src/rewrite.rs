//! Writing the records of logs into a new file, as they are.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::{Channel, MessageHeader, Metadata, SchemaHeader};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, WriteOptions, Writer};

use crate::error::LogError;
use crate::sink::{PROFILE, encode_error};
use crate::walk::Piece;

/// How chunks are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packing {
    /// Not at all.
    None,
    /// LZ4 at a level: 0 to 2 fast, 3 to 12 denser and slower. The recorder's is 0.
    Lz4(u32),
    /// Zstandard at a level, 1 to 22.
    Zstd(u32),
}

impl Packing {
    /// The recorder's own.
    pub const RECORDED: Packing = Packing::Lz4(0);

    fn compression(self) -> (Option<Compression>, u32) {
        match self {
            Packing::None => (None, 0),
            Packing::Lz4(level) => (Some(Compression::Lz4), level),
            Packing::Zstd(level) => (Some(Compression::Zstd), level),
        }
    }
}

/// A new file made of others' records. A file that is not finished is removed.
pub(crate) struct Rewriter {
    writer: Option<Writer<NoSeek<BufWriter<File>>>>,
    path: PathBuf,
    /// New identifiers of the present source's schemas and channels.
    schemas: BTreeMap<u16, u16>,
    channels: BTreeMap<u16, u16>,
    /// What stands before the topics of the present source.
    prefix: String,
}

impl Rewriter {
    /// Creates the file.
    ///
    /// # Errors
    /// [`LogError::Exists`], [`LogError::Create`], or the header cannot be written.
    pub fn create(path: &Path, packing: Packing) -> Result<Rewriter, LogError> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => LogError::Exists { path: path.into() },
            _ => LogError::Create { path: path.into(), source },
        })?;
        let (compression, level) = packing.compression();
        let options = WriteOptions::new()
            .library(concat!("trabecula ", env!("CARGO_PKG_VERSION")))
            .profile(PROFILE)
            .compression(compression)
            .compression_level(level)
            .compression_threads(0)
            .chunk_size(None)
            .disable_seeking(true);
        let writer = options.create(NoSeek::new(BufWriter::with_capacity(1 << 20, file)));
        let mut rewriter = Rewriter {
            writer: None,
            path: path.into(),
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            prefix: String::new(),
        };
        rewriter.writer = Some(writer.map_err(|error| encode_error(path, error))?);
        Ok(rewriter)
    }

    /// The records of another source follow: its identifiers are its own, its topics begin with `prefix`.
    pub fn begin_source(&mut self, prefix: &str) {
        self.schemas.clear();
        self.channels.clear();
        self.prefix = prefix.to_owned();
    }

    /// Whether a channel of the present source is written.
    pub fn knows(&self, channel: u16) -> bool {
        self.channels.contains_key(&channel)
    }

    fn with<T>(
        &mut self,
        act: impl FnOnce(&mut Writer<NoSeek<BufWriter<File>>>) -> mcap::McapResult<T>,
    ) -> Result<T, LogError> {
        let gone = || mcap::McapError::Io(std::io::Error::other("the file is finished"));
        let result = self.writer.as_mut().ok_or_else(gone).and_then(act);
        result.map_err(|error| encode_error(&self.path, error))
    }

    /// Writes a piece as it is; losses and the end are the caller's.
    pub fn piece(&mut self, piece: Piece<'_>) -> Result<(), LogError> {
        match piece {
            Piece::Attachment(found) => self.with(|writer| {
                writer.attach(&Attachment {
                    log_time: found.log_time,
                    create_time: found.create_time,
                    name: found.name,
                    media_type: found.media_type,
                    data: found.data.into(),
                })
            }),
            Piece::Metadata { name, entries } => self.metadata(name, entries),
            Piece::Schema { header, data } => self.schema(&header, data),
            Piece::Channel(channel) => self.channel(channel),
            Piece::Message { header, data } => self.message(header, data),
            Piece::ChunkEnd => self.with(Writer::flush),
            Piece::Lost(_) | Piece::Cut { .. } => Ok(()),
        }
    }

    pub fn metadata(&mut self, name: String, entries: BTreeMap<String, String>) -> Result<(), LogError> {
        self.with(|writer| writer.write_metadata(&Metadata { name, metadata: entries }))
    }

    fn schema(&mut self, header: &SchemaHeader, data: &[u8]) -> Result<(), LogError> {
        let id = self.with(|writer| writer.add_schema(&header.name, &header.encoding, data))?;
        self.schemas.insert(header.id, id);
        Ok(())
    }

    fn channel(&mut self, channel: Channel) -> Result<(), LogError> {
        let schema = self.schemas.get(&channel.schema_id).copied().unwrap_or(0);
        let topic = format!("{}{}", self.prefix, channel.topic);
        let id = self.with(|writer| {
            writer.add_channel(schema, &topic, &channel.message_encoding, &channel.metadata)
        })?;
        self.channels.insert(channel.id, id);
        Ok(())
    }

    fn message(&mut self, header: MessageHeader, data: &[u8]) -> Result<(), LogError> {
        let Some(&channel_id) = self.channels.get(&header.channel_id) else { return Ok(()) };
        let header = MessageHeader { channel_id, ..header };
        self.with(|writer| writer.write_to_known_channel(&header, data))
    }

    /// Writes the index and the footer.
    pub fn finish(mut self) -> Result<(), LogError> {
        self.with(|writer| writer.finish().map(|_| ()))?;
        if let Some(writer) = self.writer.take() {
            let mut file = writer.into_inner().into_inner();
            let flushed = std::io::Write::flush(&mut file);
            if let Err(source) = flushed {
                let _ = std::fs::remove_file(&self.path);
                return Err(LogError::Write { path: self.path.clone(), source });
            }
        }
        Ok(())
    }
}

impl Drop for Rewriter {
    fn drop(&mut self) {
        if self.writer.take().is_some() {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}
