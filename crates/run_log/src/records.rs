//! Reads a file's MCAP records in order, checking every length before trusting it.
//!
//! Records are framed here rather than by `mcap`'s readers because a log may be truncated or damaged
//! anywhere: their attachment parser panics on short records, and they do not report the offset at which a
//! file ends. Format: <https://mcap.dev/spec>, "Records", "Chunk", "Attachment", "Data End".

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::MAGIC;
use mcap::records::{Record, op};

use crate::bare::{BareRecords, is_bare};
use crate::end::TruncationPoint;
use crate::error::LogError;
use crate::lengths::parse_record;
use crate::limits::{MAX_METADATA_BYTES, MAX_NAME_BYTES};
use crate::sink::MAX_MESSAGE_BYTES;
use crate::source::ReadSeek;
use crate::unpack::{read_full, unpack};

/// Longest record or unpacked chunk in bytes: the longest message, plus room for its neighbours.
pub(crate) const MAX_RECORD_BYTES: u64 = MAX_MESSAGE_BYTES as u64 + (16 << 20);
pub(crate) const RECORD_HEADER: usize = 9;
/// Upper limit on the zeros at the end of a log that is still being written: one block of the recorder's file
/// (`recorder_proc::background`).
pub const PADDING_BYTES: u64 = 4096;
/// Longest record that is read in one piece; chunks of our own logs have a third of this size.
const READ_AT_ONCE: usize = 1 << 20;
/// Bytes of the footer's fields that its checksum covers.
const FOOTER_COVERED: usize = 8 + 8;

/// A file-level record relevant to a log.
pub(crate) enum FileRecord {
    /// A chunk, checked and unpacked, or a record outside of chunks; read it with [`Records::chunk`].
    Chunk,
    /// A metadata record.
    Metadata { name: String, entries: BTreeMap<String, String> },
    /// An attachment.
    Attachment(AttachmentRecord),
    /// The file is complete.
    End,
    /// The file is truncated.
    Cut(TruncationPoint),
}

/// An attachment whose checksum matched.
pub(crate) struct AttachmentRecord {
    pub log_time: u64,
    pub create_time: u64,
    pub name: String,
    pub media_type: String,
    pub data: Vec<u8>,
}

/// The byte source of a log.
pub(crate) type Source = BufReader<Box<dyn ReadSeek>>;

/// Result of loading a record.
enum Loaded {
    /// Loaded into `record`; holds its type.
    Record(u8),
    /// An unwanted chunk, skipped.
    Skipped,
    /// The file ends inside the record; number of the record's bytes present.
    Incomplete(u64),
}

/// Reads the records of a file.
pub(crate) struct Records {
    source: Source,
    path: PathBuf,
    /// Start of the next record.
    offset: u64,
    /// CRC of everything before it; `None` after the data section, or if parts of it are skipped.
    data_crc: Option<crc32fast::Hasher>,
    /// CRC of the summary so far, with the footer's fields.
    summary_crc: crc32fast::Hasher,
    /// Before the end of the data section.
    in_data: bool,
    record: Vec<u8>,
    chunk: Vec<u8>,
    finished: bool,
    /// Type of the last record.
    opcode: u8,
    /// Offsets of chunks to skip.
    unwanted: BTreeSet<u64>,
    bare: BareRecords,
}

impl Records {
    /// Checks the magic number.
    pub fn new(mut source: Source, path: &Path) -> Result<Records, LogError> {
        let read_error = |source| LogError::Read { path: path.into(), offset: 0, source };
        source.seek(SeekFrom::Start(0)).map_err(read_error)?;
        let mut magic = Vec::new();
        source.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(read_error)?;
        check_magic(&magic, path)?;
        let mut crc = crc32fast::Hasher::new();
        crc.update(MAGIC);
        Ok(Records::from(source, path, MAGIC.len() as u64, Some(crc)))
    }

    /// Reads the records from the given offset, which must be the start of one; `bare` is the state after the
    /// file's header. The whole-file checksum is not checked.
    pub fn at(mut source: Source, path: &Path, offset: u64, bare: BareRecords) -> Result<Records, LogError> {
        let moved = source.seek(SeekFrom::Start(offset));
        moved.map_err(|source| LogError::Read { path: path.into(), offset, source })?;
        Ok(Records { bare, ..Records::from(source, path, offset, None) })
    }

    fn from(source: Source, path: &Path, offset: u64, data_crc: Option<crc32fast::Hasher>) -> Records {
        Records {
            source,
            path: path.into(),
            offset,
            data_crc,
            summary_crc: crc32fast::Hasher::new(),
            in_data: true,
            record: Vec::new(),
            chunk: Vec::new(),
            finished: false,
            opcode: 0,
            unwanted: BTreeSet::new(),
            bare: BareRecords::default(),
        }
    }

    /// Returns the source and the state for records outside of chunks.
    pub fn into_source(self) -> (Source, BareRecords) {
        (self.source, self.bare)
    }

    /// The file's name for error messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Start of the next record in bytes.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// The last chunk's records, unpacked.
    pub fn chunk(&self) -> &[u8] {
        &self.chunk
    }

    /// Skips these chunks from now on. The whole-file checksum is then not checked; those of the chunks that
    /// are read still are.
    pub fn skip_chunks(&mut self, chunks: BTreeSet<u64>) {
        self.data_crc = self.data_crc.take().filter(|_| chunks.is_empty());
        self.unwanted = chunks;
    }

    /// Returns whether the last record was an attachment or metadata, so that losing it loses no message.
    pub fn is_beside_messages(&self) -> bool {
        matches!(self.opcode, op::ATTACHMENT | op::METADATA)
    }

    /// Returns whether the file's header names another program.
    pub fn is_written_by_another(&self) -> bool {
        self.bare.is_by_another()
    }

    /// Stops checking the whole-file checksum, because the reason for a mismatch is already known.
    pub fn ignore_checksum(&mut self) {
        self.data_crc = None;
    }

    /// Returns the next record that a log needs.
    pub fn next_record(&mut self) -> Result<FileRecord, LogError> {
        loop {
            if self.finished {
                return Ok(FileRecord::End);
            }
            let start = self.offset;
            let opcode = match self.load()? {
                Loaded::Record(opcode) => opcode,
                Loaded::Skipped => continue,
                Loaded::Incomplete(incomplete_bytes) => {
                    self.finished = true;
                    return Ok(FileRecord::Cut(TruncationPoint { offset: start, incomplete_bytes }));
                }
            };
            self.opcode = opcode;
            let found = self.interpret(opcode);
            // Advance first, so that a caller that can skip this record may request the next one.
            self.offset = start + (RECORD_HEADER + self.record.len()) as u64;
            let found =
                found.map_err(|cause| LogError::Damaged { path: self.path.clone(), offset: start, cause })?;
            if opcode == op::FOOTER {
                return self.end_magic();
            }
            if let Some(found) = found {
                return Ok(found);
            }
        }
    }

    /// Reads a record.
    fn load(&mut self) -> Result<Loaded, LogError> {
        let mut fixed = [0; RECORD_HEADER];
        let found = read_full(&mut self.source, &mut fixed).map_err(|source| self.read_error(source))?;
        if found < RECORD_HEADER {
            return Ok(Loaded::Incomplete(found as u64));
        }
        if fixed == [0; RECORD_HEADER]
            && let Some(zeros) = self.zeros_to_the_end()?
        {
            // The rest of the block that a killed recorder was writing.
            return Ok(Loaded::Incomplete(RECORD_HEADER as u64 + zeros));
        }
        let mut length = [0u8; 8];
        length.copy_from_slice(&fixed[1..]);
        let length = u64::from_le_bytes(length);
        if length > MAX_RECORD_BYTES {
            let cause = format!("a record of {length} bytes, expected at most {MAX_RECORD_BYTES}");
            return Err(LogError::Damaged { path: self.path.clone(), offset: self.offset, cause });
        }
        if fixed[0] == op::CHUNK && self.unwanted.contains(&self.offset) {
            self.record.clear();
            let skipped = self.source.seek_relative(i64::try_from(length).unwrap_or(i64::MAX));
            skipped.map_err(|source| self.read_error(source))?;
            self.offset += RECORD_HEADER as u64 + length;
            return Ok(Loaded::Skipped);
        }
        self.read_up_to(length)?;
        if (self.record.len() as u64) < length {
            return Ok(Loaded::Incomplete((RECORD_HEADER + self.record.len()) as u64));
        }
        self.sum(fixed);
        Ok(Loaded::Record(fixed[0]))
    }

    /// Adds a record to the checksum that covers it: the data section's or the summary's.
    fn sum(&mut self, fixed: [u8; RECORD_HEADER]) {
        let opcode = fixed[0];
        let crc = match self.in_data {
            true if opcode == op::DATA_END => return,
            true => self.data_crc.as_mut(),
            false => Some(&mut self.summary_crc),
        };
        let Some(crc) = crc else { return };
        // The footer's checksum does not cover itself.
        let covered = if opcode == op::FOOTER { FOOTER_COVERED } else { self.record.len() };
        crc.update(&fixed);
        crc.update(self.record.get(..covered).unwrap_or(&self.record));
    }

    /// Returns the number of zeros up to the end of the file; `None` if anything else follows, or if there is
    /// more than a block of zeros.
    fn zeros_to_the_end(&mut self) -> Result<Option<u64>, LogError> {
        self.read_up_to(PADDING_BYTES)?;
        let few = (self.record.len() as u64) < PADDING_BYTES;
        Ok((few && self.record.iter().all(|byte| *byte == 0)).then_some(self.record.len() as u64))
    }

    /// Reads this many bytes into `record`, or fewer at the end of the file.
    fn read_up_to(&mut self, count: u64) -> Result<(), LogError> {
        let read = match usize::try_from(count).ok().filter(|count| *count <= READ_AT_ONCE) {
            Some(count) => {
                self.record.resize(count, 0);
                read_full(&mut self.source, &mut self.record).inspect(|found| self.record.truncate(*found))
            }
            // Allocate for the bytes present, not for the claimed length.
            None => {
                self.record.clear();
                self.source.by_ref().take(count).read_to_end(&mut self.record)
            }
        };
        read.map(|_| ()).map_err(|source| self.read_error(source))
    }

    fn read_error(&self, source: std::io::Error) -> LogError {
        LogError::Read { path: self.path.clone(), offset: self.offset, source }
    }

    fn interpret(&mut self, opcode: u8) -> Result<Option<FileRecord>, String> {
        match opcode {
            op::CHUNK => {
                match parse_record(opcode, &self.record)? {
                    Record::Chunk { header, data } => unpack(&header, &data, &mut self.chunk)?,
                    _ => return Err("malformed chunk".to_string()),
                }
                self.bare.chunk();
                Ok(Some(FileRecord::Chunk))
            }
            op::METADATA => {
                metadata(&self.record).map(|(name, entries)| Some(FileRecord::Metadata { name, entries }))
            }
            op::ATTACHMENT => attachment(&self.record).map(|found| Some(FileRecord::Attachment(found))),
            op::DATA_END => {
                self.in_data = false;
                let calculated = self.data_crc.take().map(crc32fast::Hasher::finalize);
                match parse_record(opcode, &self.record)? {
                    Record::DataEnd(end) if end.data_section_crc == 0 => Ok(None),
                    Record::DataEnd(end) if calculated.is_none_or(|crc| crc == end.data_section_crc) => {
                        Ok(None)
                    }
                    _ => {
                        Err("wrong CRC of the data section: a record before this one has changed".to_string())
                    }
                }
            }
            op::HEADER => self.bare.header(&self.record).map(|()| None),
            op::FOOTER => self.check_summary().map(|()| None),
            // In a file without chunks each record is treated as a chunk.
            opcode if self.in_data && is_bare(opcode) => {
                self.bare.admit(opcode, &self.record)?;
                self.chunk.clear();
                self.chunk.push(opcode);
                self.chunk.extend_from_slice(&(self.record.len() as u64).to_le_bytes());
                self.chunk.extend_from_slice(&self.record);
                Ok(Some(FileRecord::Chunk))
            }
            0 => Err("record type 0".to_string()),
            _ => Ok(None),
        }
    }

    /// Checks the summary's checksum; 0 means "not computed" (MCAP specification, "Footer").
    fn check_summary(&mut self) -> Result<(), String> {
        let told = self.record.get(FOOTER_COVERED..).and_then(|bytes| <[u8; 4]>::try_from(bytes).ok());
        let Some(told) = told.map(u32::from_le_bytes) else {
            return Err(format!("a footer of {} bytes, expected {}", self.record.len(), FOOTER_COVERED + 4));
        };
        let calculated = std::mem::take(&mut self.summary_crc).finalize();
        if self.in_data {
            return Err("footer without a preceding end of the data section".to_string());
        }
        if told == 0 || told == calculated {
            return Ok(());
        }
        Err(format!(
            "CRC of the index is {calculated:08x}, the footer says {told:08x}: no message is affected, but \
             other programs may miss some"
        ))
    }

    fn end_magic(&mut self) -> Result<FileRecord, LogError> {
        self.read_up_to(MAGIC.len() as u64 + 1)?;
        let magic = std::mem::take(&mut self.record);
        self.finished = true;
        if magic == MAGIC {
            Ok(FileRecord::End)
        } else if MAGIC.starts_with(&magic) {
            Ok(FileRecord::Cut(TruncationPoint { offset: self.offset, incomplete_bytes: magic.len() as u64 }))
        } else {
            let cause = "the bytes after the footer are not the end of an MCAP file".to_string();
            Err(LogError::Damaged { path: self.path.clone(), offset: self.offset, cause })
        }
    }
}

/// Checks that a file begins with the magic number of MCAP.
pub(crate) fn check_magic(found: &[u8], path: &Path) -> Result<(), LogError> {
    if found == MAGIC {
        return Ok(());
    }
    let found = found.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ");
    let found = if found.is_empty() { "nothing".to_string() } else { found };
    Err(LogError::NotMcap { path: path.into(), found })
}

/// Parses a metadata record: its name and entries.
pub(crate) fn metadata(record: &[u8]) -> Result<(String, BTreeMap<String, String>), String> {
    if record.len() > MAX_METADATA_BYTES {
        let found = record.len();
        return Err(format!("a metadata record of {found} bytes, expected at most {MAX_METADATA_BYTES}"));
    }
    match parse_record(op::METADATA, record)? {
        Record::Metadata(found) if found.name.len() <= MAX_NAME_BYTES => Ok((found.name, found.metadata)),
        Record::Metadata(found) => {
            let length = found.name.len();
            Err(format!("a metadata record's name of {length} bytes, expected at most {MAX_NAME_BYTES}"))
        }
        _ => Err("malformed metadata record".to_string()),
    }
}

/// Parses an attachment. Layout: log time, create time (8 bytes each), name, media type (4 bytes of length
/// each), 8 bytes of data length, data, CRC of all before it.
pub(crate) fn attachment(record: &[u8]) -> Result<AttachmentRecord, String> {
    let parse = || -> Option<(AttachmentRecord, u32)> {
        let (body, crc) = record.split_at_checked(record.len().checked_sub(4)?)?;
        let word = |at: usize| Some(u64::from_le_bytes(body.get(at..at + 8)?.try_into().ok()?));
        let (name, rest) = string(body.get(16..)?)?;
        let (media_type, rest) = string(rest)?;
        if name.len().max(media_type.len()) > MAX_NAME_BYTES {
            return None;
        }
        let (length, data) = rest.split_at_checked(8)?;
        let length = u64::from_le_bytes(length.try_into().ok()?);
        let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
        let attached = AttachmentRecord {
            log_time: word(0)?,
            create_time: word(8)?,
            name: text(name),
            media_type: text(media_type),
            data: data.to_vec(),
        };
        let crc = u32::from_le_bytes(crc.try_into().ok()?);
        (length == data.len() as u64).then_some((attached, crc))
    };
    let (attached, crc) = parse().ok_or("attachment with inconsistent lengths or an overlong name")?;
    if crc32fast::hash(&record[..record.len() - 4]) != crc {
        return Err(format!("wrong CRC in attachment '{}'", attached.name));
    }
    Ok(attached)
}

fn string(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_at_checked(4)?;
    rest.split_at_checked(u32::from_le_bytes(length.try_into().ok()?) as usize)
}

/// Splits the first record off a chunk's records; returns its type, body and size in bytes.
pub(crate) fn chunk_record(bytes: &[u8]) -> Option<(u8, &[u8], usize)> {
    let (header, rest) = bytes.split_at_checked(RECORD_HEADER)?;
    let length = u64::from_le_bytes(header[1..].try_into().ok()?);
    let length = usize::try_from(length).ok()?;
    Some((header[0], rest.get(..length)?, RECORD_HEADER + length))
}
