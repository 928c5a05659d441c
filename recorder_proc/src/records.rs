//! MCAP records of a file, one after the other, with every length checked before it is believed.
//!
//! The framing is done here and not by `mcap`'s readers because a log may be cut or damaged anywhere: their attachment
//! parser panics on short records, and they do not say at which byte a file stops.
//! Format: <https://mcap.dev/spec>, "Records", "Chunk", "Attachment", "Data End".

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::MAGIC;
use mcap::records::{ChunkHeader, Record, op};

use crate::end::Cut;
use crate::error::LogError;
use crate::sink::MAX_MESSAGE_BYTES;

/// Longest record or unpacked chunk: the longest message with some room for its neighbours.
const MAX_RECORD_BYTES: u64 = MAX_MESSAGE_BYTES as u64 + (16 << 20);
const RECORD_HEADER: usize = 9;

/// What a file-level record is, as far as a log needs it.
pub(crate) enum FileRecord {
    /// A chunk, checked and unpacked: see [`Records::chunk`].
    Chunk,
    /// A metadata record.
    Metadata { name: String, entries: BTreeMap<String, String> },
    /// An attachment.
    Attachment { name: String, data: Vec<u8> },
    /// The file is whole.
    End,
    /// The file stops in the middle.
    Cut(Cut),
}

/// The records of a file.
pub(crate) struct Records {
    source: Box<dyn Read + Send>,
    path: PathBuf,
    /// Start of the next record.
    offset: u64,
    /// CRC of everything before it; none once the data section is over.
    data_crc: Option<crc32fast::Hasher>,
    record: Vec<u8>,
    chunk: Vec<u8>,
    finished: bool,
}

impl Records {
    /// Checks the magic number.
    pub fn new(mut source: Box<dyn Read + Send>, path: &Path) -> Result<Records, LogError> {
        let mut magic = Vec::new();
        let read = source.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic);
        read.map_err(|source| LogError::Read { path: path.into(), offset: 0, source })?;
        if magic != MAGIC {
            let found = magic.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ");
            let found = if found.is_empty() { "nothing".to_string() } else { found };
            return Err(LogError::NotMcap { path: path.into(), found });
        }
        let mut crc = crc32fast::Hasher::new();
        crc.update(MAGIC);
        Ok(Records {
            source,
            path: path.into(),
            offset: MAGIC.len() as u64,
            data_crc: Some(crc),
            record: Vec::new(),
            chunk: Vec::new(),
            finished: false,
        })
    }

    /// The file, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Start of the next record in bytes.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// The last chunk's records.
    pub fn chunk(&self) -> &[u8] {
        &self.chunk
    }

    /// The next record that a log needs.
    pub fn next_record(&mut self) -> Result<FileRecord, LogError> {
        loop {
            if self.finished {
                return Ok(FileRecord::End);
            }
            let start = self.offset;
            let opcode = match self.load()? {
                Ok(opcode) => opcode,
                Err(incomplete_bytes) => {
                    self.finished = true;
                    return Ok(FileRecord::Cut(Cut { offset: start, incomplete_bytes }));
                }
            };
            let found = self.interpret(opcode);
            let found =
                found.map_err(|cause| LogError::Damaged { path: self.path.clone(), offset: start, cause })?;
            self.offset = start + (RECORD_HEADER + self.record.len()) as u64;
            if opcode == op::FOOTER {
                return self.end_magic();
            }
            if let Some(found) = found {
                return Ok(found);
            }
        }
    }

    /// Reads a record; `Err` holds the number of bytes that the file still had of it.
    fn load(&mut self) -> Result<Result<u8, u64>, LogError> {
        let mut header = Vec::with_capacity(RECORD_HEADER);
        self.read_up_to(RECORD_HEADER as u64, |bytes| std::mem::swap(bytes, &mut header))?;
        let Ok(fixed) = <[u8; RECORD_HEADER]>::try_from(header.as_slice()) else {
            return Ok(Err(header.len() as u64));
        };
        let mut length = [0u8; 8];
        length.copy_from_slice(&fixed[1..]);
        let length = u64::from_le_bytes(length);
        if length > MAX_RECORD_BYTES {
            let cause = format!("a record of {length} bytes, expected at most {MAX_RECORD_BYTES}");
            return Err(LogError::Damaged { path: self.path.clone(), offset: self.offset, cause });
        }
        self.read_up_to(length, |_| ())?;
        if (self.record.len() as u64) < length {
            return Ok(Err((RECORD_HEADER + self.record.len()) as u64));
        }
        if fixed[0] != op::DATA_END
            && let Some(crc) = &mut self.data_crc
        {
            crc.update(&fixed);
            crc.update(&self.record);
        }
        Ok(Ok(fixed[0]))
    }

    fn read_up_to(&mut self, count: u64, then: impl FnOnce(&mut Vec<u8>)) -> Result<(), LogError> {
        self.record.clear();
        let read = self.source.by_ref().take(count).read_to_end(&mut self.record);
        read.map_err(|source| LogError::Read { path: self.path.clone(), offset: self.offset, source })?;
        then(&mut self.record);
        Ok(())
    }

    fn interpret(&mut self, opcode: u8) -> Result<Option<FileRecord>, String> {
        match opcode {
            op::CHUNK => {
                match mcap::parse_record(opcode, &self.record).map_err(|error| error.to_string())? {
                    Record::Chunk { header, data } => unpack(&header, &data, &mut self.chunk)?,
                    _ => return Err("a chunk that is none".to_string()),
                }
                Ok(Some(FileRecord::Chunk))
            }
            op::METADATA => match mcap::parse_record(opcode, &self.record)
                .map_err(|error| error.to_string())?
            {
                Record::Metadata(m) => Ok(Some(FileRecord::Metadata { name: m.name, entries: m.metadata })),
                _ => Err("a metadata record that is none".to_string()),
            },
            op::ATTACHMENT => attachment(&self.record).map(Some),
            op::DATA_END => {
                let calculated = self.data_crc.take().map(crc32fast::Hasher::finalize);
                match mcap::parse_record(opcode, &self.record).map_err(|error| error.to_string())? {
                    Record::DataEnd(end) if end.data_section_crc == 0 => Ok(None),
                    Record::DataEnd(end) if calculated.is_none_or(|crc| crc == end.data_section_crc) => {
                        Ok(None)
                    }
                    _ => Err("the CRC of the data section is wrong: a record before this one has changed"
                        .to_string()),
                }
            }
            op::MESSAGE | op::SCHEMA | op::CHANNEL if self.data_crc.is_some() => {
                Err(format!("record type {opcode:#04x} outside of a chunk"))
            }
            0 => Err("record type 0".to_string()),
            _ => Ok(None),
        }
    }

    fn end_magic(&mut self) -> Result<FileRecord, LogError> {
        let mut magic = Vec::new();
        self.read_up_to(MAGIC.len() as u64 + 1, |bytes| std::mem::swap(bytes, &mut magic))?;
        self.finished = true;
        if magic == MAGIC {
            Ok(FileRecord::End)
        } else if MAGIC.starts_with(&magic) {
            Ok(FileRecord::Cut(Cut { offset: self.offset, incomplete_bytes: magic.len() as u64 }))
        } else {
            let cause = "bytes behind the footer that are not the end of an MCAP file".to_string();
            Err(LogError::Damaged { path: self.path.clone(), offset: self.offset, cause })
        }
    }
}

/// Unpacks a chunk and checks its CRC before anyone sees a record of it.
fn unpack(header: &ChunkHeader, data: &[u8], out: &mut Vec<u8>) -> Result<(), String> {
    let size = header.uncompressed_size;
    if size > MAX_RECORD_BYTES {
        return Err(format!("a chunk of {size} bytes unpacked, expected at most {MAX_RECORD_BYTES}"));
    }
    out.clear();
    match header.compression.as_str() {
        "" => out.extend_from_slice(data),
        "lz4" => {
            let decoder =
                lz4::Decoder::new(data).map_err(|error| format!("cannot unpack a chunk: {error}"))?;
            let unpacked = decoder.take(size + 1).read_to_end(out);
            unpacked.map_err(|error| format!("cannot unpack a chunk: {error}"))?;
        }
        other => return Err(format!("a chunk packed with '{other}', expected lz4 or nothing")),
    }
    if out.len() as u64 != size {
        return Err(format!("a chunk of {} bytes unpacked, its header says {size}", out.len()));
    }
    let calculated = crc32fast::hash(out);
    if calculated != header.uncompressed_crc {
        return Err(format!(
            "CRC of a chunk is {calculated:08x}, its header says {:08x}",
            header.uncompressed_crc
        ));
    }
    Ok(())
}

/// Parses an attachment. Layout: log time, create time (8 bytes each), name, media type (4 bytes of length each),
/// 8 bytes of data length, data, CRC of all before it.
fn attachment(record: &[u8]) -> Result<FileRecord, String> {
    let parse = || -> Option<(String, &[u8], u32)> {
        let (body, crc) = record.split_at_checked(record.len().checked_sub(4)?)?;
        let rest = body.get(16..)?;
        let (name, rest) = string(rest)?;
        let (_, rest) = string(rest)?;
        let (length, data) = rest.split_at_checked(8)?;
        let length = u64::from_le_bytes(length.try_into().ok()?);
        let crc = u32::from_le_bytes(crc.try_into().ok()?);
        (length == data.len() as u64).then(|| (String::from_utf8_lossy(name).into_owned(), data, crc))
    };
    let (name, data, crc) = parse().ok_or("an attachment whose lengths do not fit")?;
    if crc32fast::hash(&record[..record.len() - 4]) != crc {
        return Err(format!("CRC of the attachment '{name}' is wrong"));
    }
    Ok(FileRecord::Attachment { name, data: data.to_vec() })
}

fn string(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_at_checked(4)?;
    rest.split_at_checked(u32::from_le_bytes(length.try_into().ok()?) as usize)
}

/// Splits the first record off a chunk's records: type, body, number of bytes.
pub(crate) fn chunk_record(bytes: &[u8]) -> Option<(u8, &[u8], usize)> {
    let (header, rest) = bytes.split_at_checked(RECORD_HEADER)?;
    let length = u64::from_le_bytes(header[1..].try_into().ok()?);
    let length = usize::try_from(length).ok()?;
    Some((header[0], rest.get(..length)?, RECORD_HEADER + length))
}
