//! Schemas, channels and messages outside of chunks. Files of other programs may have no chunks (MCAP
//! specification, "File structure").

use std::collections::BTreeSet;

use mcap::records::{Record, op};

use crate::lengths::parse_record;
use crate::library::is_ours;

/// Returns whether a record type belongs in a chunk, or at file level in a file without chunks.
pub(crate) fn is_bare(opcode: u8) -> bool {
    matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE)
}

/// Distinguishes a legitimate record outside of chunks from one whose type byte has changed.
#[derive(Default)]
pub(crate) struct BareRecords {
    /// Whether the file's header names another program; our own files always have chunks.
    is_by_another: bool,
    has_chunks: bool,
    /// Channels declared so far.
    channels: BTreeSet<u16>,
}

impl BareRecords {
    /// Reads the file's header record.
    ///
    /// # Errors
    /// The record cannot be parsed.
    pub fn header(&mut self, record: &[u8]) -> Result<(), String> {
        if let Record::Header(header) = parse_record(op::HEADER, record)? {
            self.is_by_another = !is_ours(&header.library);
        }
        Ok(())
    }

    /// Notes that a chunk was found.
    pub fn chunk(&mut self) {
        self.has_chunks = true;
    }

    /// Whether the file's header names another program.
    pub fn is_by_another(&self) -> bool {
        self.is_by_another
    }

    /// Whether records outside of chunks are expected.
    fn are_expected(&self) -> bool {
        self.is_by_another && !self.has_chunks
    }

    /// Accepts a record outside of chunks.
    ///
    /// # Errors
    /// The file has chunks, or the message's channel is undeclared: the record's type must have changed.
    pub fn admit(&mut self, opcode: u8, record: &[u8]) -> Result<(), String> {
        if !self.are_expected() {
            return Err(format!("record type {opcode:#04x} outside of a chunk, in a chunked file"));
        }
        // Messages and channels both begin with the channel's number.
        let id = record.first_chunk::<2>().map(|id| u16::from_le_bytes(*id));
        match (opcode, id) {
            (op::CHANNEL, Some(id)) => _ = self.channels.insert(id),
            (op::MESSAGE, id) if id.is_none_or(|id| !self.channels.contains(&id)) => {
                return Err("message on an undeclared channel".to_string());
            }
            _ => {}
        }
        Ok(())
    }
}
