//! Schemas, channels and messages outside of chunks: a file of another program may have no chunks (MCAP
//! specification, "File structure").

use std::collections::BTreeSet;

use mcap::records::{Record, op};

use crate::lengths::parse_record;
use crate::library::is_ours;

/// Types of records that stand in chunks, or, in a file without chunks, beside each other.
pub(crate) fn is_bare(opcode: u8) -> bool {
    matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE)
}

/// What tells a record outside of chunks from one whose type has changed.
#[derive(Default)]
pub(crate) struct BareRecords {
    /// Whether the file says that another program than ours wrote it; ours always writes chunks.
    is_by_another: bool,
    has_chunks: bool,
    /// Channels declared so far.
    channels: BTreeSet<u16>,
}

impl BareRecords {
    /// Takes the file's header record.
    ///
    /// # Errors
    /// It cannot be parsed.
    pub fn header(&mut self, record: &[u8]) -> Result<(), String> {
        if let Record::Header(header) = parse_record(op::HEADER, record)? {
            self.is_by_another = !is_ours(&header.library);
        }
        Ok(())
    }

    /// A chunk was found.
    pub fn chunk(&mut self) {
        self.has_chunks = true;
    }

    /// Whether the file says that another program than ours wrote it.
    pub fn is_by_another(&self) -> bool {
        self.is_by_another
    }

    /// Whether records may stand outside of chunks.
    fn are_expected(&self) -> bool {
        self.is_by_another && !self.has_chunks
    }

    /// Takes a record outside of chunks.
    ///
    /// # Errors
    /// The file has chunks, or nothing has declared the message's channel: then the record's type has
    /// changed.
    pub fn admit(&mut self, opcode: u8, record: &[u8]) -> Result<(), String> {
        if !self.are_expected() {
            return Err(format!("record type {opcode:#04x} outside of a chunk, in a file of chunks"));
        }
        // Both kinds begin with the channel's number.
        let id = record.first_chunk::<2>().map(|id| u16::from_le_bytes(*id));
        match (opcode, id) {
            (op::CHANNEL, Some(id)) => _ = self.channels.insert(id),
            (op::MESSAGE, id) if id.is_none_or(|id| !self.channels.contains(&id)) => {
                return Err("a message of a channel that nothing has declared".to_string());
            }
            _ => {}
        }
        Ok(())
    }
}
