//! Schemas, channels and messages outside of chunks: an MCAP file may have no chunks (MCAP specification, "File structure").

use std::collections::BTreeSet;

use mcap::records::op;

/// Types of records that stand in chunks, or, in a file without chunks, beside each other.
pub(crate) fn is_bare(opcode: u8) -> bool {
    matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE)
}

/// Channels declared outside of chunks so far.
#[derive(Default)]
pub(crate) struct BareChannels(BTreeSet<u16>);

impl BareChannels {
    /// Remembers a channel; refuses a message of one that nothing has declared, because then the record's type has changed.
    pub fn admit(&mut self, opcode: u8, record: &[u8]) -> Result<(), String> {
        // Both kinds begin with the channel's number.
        let id = record.first_chunk::<2>().map(|id| u16::from_le_bytes(*id));
        match (opcode, id) {
            (op::CHANNEL, Some(id)) => _ = self.0.insert(id),
            (op::MESSAGE, id) if id.is_none_or(|id| !self.0.contains(&id)) => {
                return Err("a message of a channel that nothing has declared".to_string());
            }
            _ => {}
        }
        Ok(())
    }
}
