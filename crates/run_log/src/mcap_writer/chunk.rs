//! A chunk being filled. Records are compressed with LZ4 as they arrive.

use std::collections::BTreeMap;
use std::io::{Cursor, Result, Write};

use binrw::BinWrite;
use mcap::records::{ChunkHeader, MessageHeader, MessageIndexEntry, op};

use super::encoding::start_of;

const COMPRESSION: &str = "lz4";
/// Bytes of a message's fields before its data.
const MESSAGE_FIELDS: u64 = 2 + 4 + 8 + 8;

/// Offsets of a chunk's messages, by channel.
pub(super) type Messages = BTreeMap<u16, Vec<MessageIndexEntry>>;

/// A chunk being filled.
pub(super) struct Chunk {
    packed: lz4::Encoder<Vec<u8>>,
    size: u64,
    crc: crc32fast::Hasher,
    bounds: Option<(u64, u64)>,
    messages: Messages,
}

/// Returns the open chunk; opens one if necessary.
pub(super) fn open(chunk: &mut Option<Chunk>) -> Result<&mut Chunk> {
    match chunk {
        Some(chunk) => Ok(chunk),
        none => Ok(none.insert(Chunk::new()?)),
    }
}

impl Chunk {
    fn new() -> Result<Chunk> {
        // The chunk's own checksum makes LZ4's block checksums redundant.
        let no_block_checksum = lz4::liblz4::BlockChecksum::NoBlockChecksum;
        let packed =
            lz4::EncoderBuilder::new().level(0).block_checksum(no_block_checksum).build(Vec::new())?;
        Ok(Chunk { packed, size: 0, crc: crc32fast::Hasher::new(), bounds: None, messages: BTreeMap::new() })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.crc.update(bytes);
        self.size += bytes.len() as u64;
        self.packed.write_all(bytes)
    }

    pub(super) fn record(&mut self, opcode: u8, body: &[u8]) -> Result<()> {
        self.write(&start_of(opcode, body.len() as u64))?;
        self.write(body)
    }

    pub(super) fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<()> {
        let log_time = header.log_time;
        let (first, last) = self.bounds.unwrap_or((log_time, log_time));
        self.bounds = Some((first.min(log_time), last.max(log_time)));
        let entry = MessageIndexEntry { log_time, offset: self.size };
        self.messages.entry(header.channel_id).or_default().push(entry);
        self.write(&start_of(op::MESSAGE, MESSAGE_FIELDS + data.len() as u64))?;
        let mut fields = [0; MESSAGE_FIELDS as usize];
        let mut place = Cursor::new(&mut fields[..]);
        header.write_le(&mut place).map_err(std::io::Error::other)?;
        self.write(&fields)?;
        self.write(data)
    }

    /// Completes the chunk: returns its header, its compressed bytes and the offsets of its messages.
    pub(super) fn finish(self) -> Result<(ChunkHeader, Vec<u8>, Messages)> {
        let (data, ended) = self.packed.finish();
        ended?;
        let (message_start_time, message_end_time) = self.bounds.unwrap_or((0, 0));
        let header = ChunkHeader {
            message_start_time,
            message_end_time,
            uncompressed_size: self.size,
            uncompressed_crc: self.crc.finalize(),
            compression: COMPRESSION.to_owned(),
            compressed_size: data.len() as u64,
        };
        Ok((header, data, self.messages))
    }
}
