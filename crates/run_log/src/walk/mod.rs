//! Walks the records of a file that may be damaged anywhere: which parts are intact, and what lies between.
//!
//! [`Records`](crate::records::Records) stops at the first damage, because its readers promise ticks without
//! a gap. This walk continues: if a chunk's checksum is wrong but its length leads to a record, it resumes at
//! that record; if a length is wrong, at the next byte that begins a chunk, header or end marker with a
//! correct checksum.

use std::collections::BTreeMap;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::{Channel, MessageHeader, Record, SchemaHeader, op};

use crate::bare::{BareRecords, is_bare};
use crate::error::LogError;
use crate::lengths::parse_record;
use crate::limits::check_declaration;
use crate::records::{AttachmentRecord, RECORD_HEADER, attachment, check_magic, chunk_record, metadata};
use crate::seal::is_unbroken;
use crate::unpack::unpack;

use signs::{begins_attachment, begins_chunk, begins_metadata, is_sought, plausible};

mod signs;

/// Window of a search for the next chunk, in bytes.
const WINDOW: usize = 1 << 20;
/// Budget for unpacking and copying over all searches: a multiple of the file's length plus a constant.
/// Without it, a file full of fake chunk starts would be read again for each of them.
const SEARCH_BUDGET_FACTOR: u64 = 8;
const SEARCH_BUDGET_BYTES: u64 = 1 << 28;
/// A file still counts as a log with at most this many wrong bytes in its magic number.
const WRONG_MAGIC_BYTES: usize = 2;
/// Size of the part of a record that the search must see: header, chunk fields and the longest compression
/// name.
const LOOKAHEAD_BYTES: usize = RECORD_HEADER + 8 + 8 + 8 + 4 + 4 + 4 + 8;

const _: () = assert!(LOOKAHEAD_BYTES < WINDOW);

/// An item found by a walk, in file order.
pub(crate) enum WalkItem<'a> {
    Attachment(AttachmentRecord),
    Metadata {
        name: String,
        entries: BTreeMap<String, String>,
    },
    Schema {
        header: SchemaHeader,
        data: &'a [u8],
    },
    Channel(Channel),
    Message {
        header: MessageHeader,
        data: &'a [u8],
    },
    /// A chunk's records follow; offset of the chunk.
    ChunkBegin(u64),
    ChunkEnd,
    /// End of the data section; offset of the summary.
    DataEnd(u64),
    /// Not a record, or a record whose checksum is wrong.
    Lost(DamagedPiece),
    /// The file ends here, inside a record or before the end that the format requires; size of the incomplete
    /// record.
    Cut {
        offset: u64,
        incomplete_bytes: u64,
    },
}

/// A damaged piece of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DamagedPiece {
    /// First byte.
    pub offset: u64,
    /// Bytes.
    pub bytes: u64,
    /// The fault.
    pub cause: String,
}

/// Calls `visit` for every piece.
///
/// # Errors
/// The file cannot be read or is not an MCAP file; any error of `visit`.
pub(crate) fn walk<R: Read + Seek>(
    source: R,
    path: &Path,
    visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
) -> Result<(), LogError> {
    let source = BufReader::with_capacity(BUFFER_BYTES, source);
    let mut walker = Walker {
        source,
        at: 0,
        position: 0,
        length: 0,
        budget: 0,
        record: Vec::new(),
        chunk: Vec::new(),
        in_data: true,
        bare: BareRecords::default(),
        bare_bytes: None,
    };
    let read_error = |at: u64, source| LogError::Read { path: path.into(), offset: at, source };
    walker.open().map_err(|source| read_error(0, source))?;
    let wrong = walker.record.iter().zip(MAGIC).filter(|(found, magic)| found != magic).count();
    if walker.record.len() < MAGIC.len() || wrong > WRONG_MAGIC_BYTES {
        check_magic(&walker.record, path)?;
    }
    if wrong > 0 {
        let cause = "wrong magic number".to_string();
        visit(WalkItem::Lost(DamagedPiece { offset: 0, bytes: MAGIC.len() as u64, cause }))?;
    }
    loop {
        let at = walker.at;
        let (opcode, next) = match walker.load().map_err(|source| read_error(at, source))? {
            Loaded::Record(opcode, next) => (opcode, next),
            Loaded::End => return walker.end_bare_chunk(visit),
            Loaded::Incomplete | Loaded::Implausible => {
                walker.end_bare_chunk(visit)?;
                let found = walker.search(at + 1).map_err(|source| read_error(at, source))?;
                let Some(found) = found else {
                    return visit(WalkItem::Cut { offset: at, incomplete_bytes: walker.length - at });
                };
                let cause = "not the start of a record".to_string();
                visit(WalkItem::Lost(DamagedPiece { offset: at, bytes: found - at, cause }))?;
                walker.at = found;
                continue;
            }
        };
        if !is_bare(opcode) || walker.bare_bytes.is_some_and(|bytes| bytes >= BARE_CHUNK_BYTES) {
            walker.end_bare_chunk(visit)?;
        }
        match walker.pieces(path, opcode, next, visit)? {
            Ok(()) => {
                if opcode == op::DATA_END {
                    walker.in_data = false;
                    visit(WalkItem::DataEnd(next))?;
                }
                walker.at = next;
            }
            Err(cause) => {
                let next = walker.behind(at, next).map_err(|source| read_error(next, source))?;
                visit(WalkItem::Lost(DamagedPiece { offset: at, bytes: next - at, cause }))?;
                walker.at = next;
            }
        }
    }
}

/// Bytes per read.
const BUFFER_BYTES: usize = 1 << 18;

struct Walker<R> {
    source: BufReader<R>,
    /// Start of the next record.
    at: u64,
    /// Current position in the source.
    position: u64,
    length: u64,
    /// Bytes that searches may still unpack or copy.
    budget: u64,
    record: Vec<u8>,
    chunk: Vec<u8>,
    /// Before the end of the data section; after it, schemas and channels are repeated.
    in_data: bool,
    bare: BareRecords,
    /// Bytes of the records outside of chunks passed on as one chunk so far; `None` while there is no such
    /// chunk.
    bare_bytes: Option<u64>,
}

/// Records outside of chunks are passed on as chunks of about this many bytes.
const BARE_CHUNK_BYTES: u64 = 1 << 20;

enum Loaded {
    /// The record's type and the start of the next one.
    Record(u8, u64),
    /// The file ends inside the record.
    Incomplete,
    Implausible,
    End,
}

impl<R: Read + Seek> Walker<R> {
    fn open(&mut self) -> io::Result<()> {
        self.length = self.source.seek(SeekFrom::End(0))?;
        self.position = self.length;
        self.budget = self.length.saturating_mul(SEARCH_BUDGET_FACTOR).saturating_add(SEARCH_BUDGET_BYTES);
        self.read(0, MAGIC.len() as u64)?;
        self.at = MAGIC.len() as u64;
        Ok(())
    }

    /// Reads up to `count` bytes into `record`.
    fn read(&mut self, at: u64, count: u64) -> io::Result<()> {
        self.record.clear();
        self.go_to(at)?;
        self.position += self.source.by_ref().take(count).read_to_end(&mut self.record)? as u64;
        Ok(())
    }

    /// Seeks within the buffer if possible; otherwise every record would refill a whole buffer.
    fn go_to(&mut self, at: u64) -> io::Result<()> {
        match i64::try_from(i128::from(at) - i128::from(self.position)) {
            Ok(distance) => self.source.seek_relative(distance)?,
            Err(_) => _ = self.source.seek(SeekFrom::Start(at))?,
        }
        self.position = at;
        Ok(())
    }

    /// Returns where to resume after a bad record at `at`: where its length leads, or what the search finds.
    fn behind(&mut self, at: u64, next: u64) -> io::Result<u64> {
        if self.begins_record(next)? {
            return Ok(next);
        }
        Ok(self.search(at + 1)?.unwrap_or(self.length))
    }

    /// Returns the type and length of a possible record.
    fn header(&mut self, at: u64) -> io::Result<Option<(u8, u64)>> {
        self.read(at, RECORD_HEADER as u64)?;
        let mut length = [0; 8];
        let Some(bytes) = self.record.get(1..RECORD_HEADER) else { return Ok(None) };
        length.copy_from_slice(bytes);
        Ok(Some((self.record[0], u64::from_le_bytes(length))))
    }

    fn load(&mut self) -> io::Result<Loaded> {
        if self.at == self.length {
            return Ok(Loaded::Incomplete);
        }
        let Some((opcode, length)) = self.header(self.at)? else { return Ok(Loaded::Incomplete) };
        if !plausible(opcode, length) {
            return Ok(Loaded::Implausible);
        }
        let body = self.at + RECORD_HEADER as u64;
        if length > self.length - body {
            return Ok(Loaded::Incomplete);
        }
        self.read(body, length)?;
        let next = body + length;
        if opcode == op::FOOTER {
            self.read(next, MAGIC.len() as u64 + 1)?;
            return Ok(if self.record == MAGIC { Loaded::End } else { Loaded::Incomplete });
        }
        Ok(Loaded::Record(opcode, next))
    }

    fn begins_record(&mut self, at: u64) -> io::Result<bool> {
        let header = self.header(at)?;
        Ok(header.is_some_and(|(opcode, length)| {
            plausible(opcode, length) && length <= self.length - at - RECORD_HEADER as u64
        }))
    }

    /// Returns whether a length that leads here is plausible: here is a record, part of one, or the end of a
    /// truncated log.
    fn leads_on(&mut self, at: u64) -> io::Result<bool> {
        Ok(self
            .header(at)?
            .is_none_or(|(opcode, length)| (opcode, length) == (0, 0) || plausible(opcode, length)))
    }

    /// Passes on the loaded record, which ends at `next`; the inner error describes what is wrong with it.
    fn pieces(
        &mut self,
        path: &Path,
        opcode: u8,
        next: u64,
        visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
    ) -> Result<Result<(), String>, LogError> {
        match opcode {
            op::CHUNK => match parse_record(opcode, &self.record) {
                Ok(Record::Chunk { header, data }) => {
                    if let Err(cause) = unpack(&header, &data, &mut self.chunk) {
                        return Ok(Err(cause));
                    }
                    self.bare.chunk();
                    visit(WalkItem::ChunkBegin(self.at))?;
                    of_chunk(path, &self.chunk, visit)
                }
                _ => Ok(Err("malformed chunk".to_string())),
            },
            op::METADATA => match metadata(&self.record) {
                Ok((name, entries)) if is_unbroken(&entries) => {
                    visit(WalkItem::Metadata { name, entries }).map(Ok)
                }
                Ok((name, _)) => Ok(Err(format!("wrong checksum in metadata record '{name}'"))),
                Err(cause) => Ok(Err(cause)),
            },
            op::ATTACHMENT => match attachment(&self.record) {
                Ok(attached) => visit(WalkItem::Attachment(attached)).map(Ok),
                Err(cause) => Ok(Err(cause)),
            },
            // If the header cannot be parsed, nothing is known about what follows.
            op::HEADER if self.bare.header(&self.record).is_err() => Ok(Err("malformed header".to_string())),
            // These records have no checksum, and a wrong length would skip whole chunks.
            _ => match self.leads_on(next) {
                Ok(true) if self.in_data && is_bare(opcode) => self.bare(path, opcode, next, visit),
                Ok(true) => Ok(Ok(())),
                Ok(false) => Ok(Err("invalid record length: no record follows it".to_string())),
                Err(source) => Err(LogError::Read { path: path.into(), offset: next, source }),
            },
        }
    }

    /// Passes on a record outside of chunks as part of a chunk.
    fn bare(
        &mut self,
        path: &Path,
        opcode: u8,
        next: u64,
        visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
    ) -> Result<Result<(), String>, LogError> {
        let body = self.at + RECORD_HEADER as u64;
        // Checking where the length leads has overwritten the record.
        self.read(body, next - body).map_err(|source| LogError::Read {
            path: path.into(),
            offset: body,
            source,
        })?;
        if let Err(cause) = self.bare.admit(opcode, &self.record) {
            return Ok(Err(cause));
        }
        if self.bare_bytes.is_none() {
            visit(WalkItem::ChunkBegin(self.at))?;
        }
        *self.bare_bytes.get_or_insert(0) += next - self.at;
        of_record(path, opcode, &self.record, visit)
    }

    fn end_bare_chunk(
        &mut self,
        visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
    ) -> Result<(), LogError> {
        if self.bare_bytes.take().is_some() { visit(WalkItem::ChunkEnd) } else { Ok(()) }
    }

    /// Returns the first byte at or after `from` that begins a chunk with a correct checksum, or the end
    /// marker.
    fn search(&mut self, from: u64) -> io::Result<Option<u64>> {
        let mut start = from;
        let mut window = Vec::new();
        while start < self.length {
            window.clear();
            self.go_to(start)?;
            let looked = (WINDOW + LOOKAHEAD_BYTES) as u64;
            self.position += self.source.by_ref().take(looked).read_to_end(&mut window)? as u64;
            for i in 0..window.len().min(WINDOW) {
                let rest = &window[i..];
                let candidate = begins_chunk(rest) || begins_metadata(rest) || begins_attachment(rest);
                if candidate && self.is_whole(start + i as u64)? {
                    return Ok(Some(start + i as u64));
                }
                if self.budget == 0 {
                    return Ok(None);
                }
            }
            start += WINDOW as u64;
        }
        Ok(None)
    }

    fn is_whole(&mut self, at: u64) -> io::Result<bool> {
        let before = std::mem::replace(&mut self.at, at);
        let loaded = self.load();
        self.at = before;
        let Loaded::Record(opcode, _) = loaded? else { return Ok(false) };
        let mut cost = self.record.len() as u64;
        let whole = match opcode {
            op::CHUNK => match parse_record(opcode, &self.record) {
                Ok(Record::Chunk { header, data }) => {
                    // Without a checksum (0) the records must at least follow each other to the end.
                    let whole = unpack(&header, &data, &mut self.chunk).is_ok()
                        && (header.uncompressed_crc != 0 || is_chain(&self.chunk));
                    cost += self.chunk.len() as u64;
                    whole
                }
                _ => false,
            },
            op::METADATA => metadata(&self.record)
                .is_ok_and(|(name, entries)| is_sought(name.as_bytes()) && is_unbroken(&entries)),
            op::ATTACHMENT => attachment(&self.record).is_ok(),
            _ => false,
        };
        self.budget = self.budget.saturating_sub(cost);
        Ok(whole)
    }
}

/// Passes on the records of a chunk whose checksum is correct.
fn of_chunk(
    path: &Path,
    mut rest: &[u8],
    visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
) -> Result<Result<(), String>, LogError> {
    while !rest.is_empty() {
        let Some((opcode, body, length)) = chunk_record(rest) else {
            return Ok(Err("record extends beyond its chunk".to_string()));
        };
        rest = &rest[length..];
        if let Err(cause) = of_record(path, opcode, body, visit)? {
            return Ok(Err(cause));
        }
    }
    visit(WalkItem::ChunkEnd).map(Ok)
}

/// Passes on a schema, a channel or a message; other records carry nothing worth keeping.
fn of_record(
    path: &Path,
    opcode: u8,
    body: &[u8],
    visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
) -> Result<Result<(), String>, LogError> {
    match opcode {
        op::SCHEMA | op::CHANNEL => check_declaration(path, body)?,
        op::MESSAGE => {}
        _ => return Ok(Ok(())),
    }
    match parse_record(opcode, body) {
        Ok(Record::Schema { header, data }) => visit(WalkItem::Schema { header, data: &data })?,
        Ok(Record::Channel(channel)) => visit(WalkItem::Channel(channel))?,
        Ok(Record::Message { header, data }) => visit(WalkItem::Message { header, data: &data })?,
        Ok(_) => {}
        Err(cause) => return Ok(Err(cause)),
    }
    Ok(Ok(()))
}

/// Returns whether a sequence of records fills these bytes to the end.
fn is_chain(mut rest: &[u8]) -> bool {
    while !rest.is_empty() {
        let Some((opcode, _, length)) = chunk_record(rest) else { return false };
        if !matches!(opcode, 1..=0x0f | 0x80..) {
            return false;
        }
        rest = &rest[length..];
    }
    true
}
