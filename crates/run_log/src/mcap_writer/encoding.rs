//! Encodes records as bytes and counts the bytes written.

use std::io::{Cursor, Result, Write};

use binrw::BinWrite;
use mcap::records::SchemaHeader;

/// An output that counts its bytes and computes their checksum.
pub(super) struct Counted<W> {
    pub inner: W,
    pub position: u64,
    pub crc: crc32fast::Hasher,
}

impl<W: Write> Counted<W> {
    pub fn write_all(&mut self, bytes: &[u8]) -> Result<()> {
        self.inner.write_all(bytes)?;
        self.crc.update(bytes);
        self.position += bytes.len() as u64;
        Ok(())
    }

    pub fn begin(&mut self, opcode: u8, length: u64) -> Result<()> {
        self.write_all(&start_of(opcode, length))
    }
}

pub(super) fn begin(out: &mut impl Write, opcode: u8, length: u64) -> Result<()> {
    out.write_all(&start_of(opcode, length))
}

/// Returns the bytes before a record's body: type and length.
pub(super) fn start_of(opcode: u8, length: u64) -> [u8; 9] {
    let mut start = [opcode; 9];
    start[1..].copy_from_slice(&length.to_le_bytes());
    start
}

/// Encodes a record's body in the `mcap` crate's layout.
pub(super) fn encode<R>(record: &R, body: &mut Vec<u8>) -> Result<()>
where
    R: for<'a> BinWrite<Args<'a> = ()>,
{
    body.clear();
    record.write_le(&mut Cursor::new(body)).map_err(std::io::Error::other)
}

pub(super) fn encode_schema(header: &SchemaHeader, data: &[u8], body: &mut Vec<u8>) -> Result<()> {
    encode(header, body)?;
    body.extend_from_slice(&(data.len() as u32).to_le_bytes());
    body.extend_from_slice(data);
    Ok(())
}
