//! Random access to a log's file by simulated time.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ipc_types::messages::layout::CDR_LITTLE_ENDIAN;
use mcap::records::Record;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions, ReadOrder};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{Summary, parse_record};
use run_log::{END_RECORD, EndMarker, EndReason, Topic};

/// Maximum length of a valid record, bytes.
const MAX_RECORD: usize = 1 << 30;

/// Maximum length of the record with a run's end reason, bytes.
const END_BYTES: usize = 1 << 20;

/// Bytes read per call.
const READ_BYTES: usize = 1 << 22;

/// Why a log cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// The system's reason.
    #[error("{}: cannot read the log: {cause}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Reason.
        cause: std::io::Error,
    },
    /// The index or a chunk is damaged, or the index is missing.
    #[error("{}: {cause}; `trabecula log repair` writes a playable copy", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        cause: String,
    },
}

/// A message of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Logged {
    /// Topic.
    pub topic: String,
    /// Simulated time, ns.
    pub time_ns: u64,
    /// CDR header, struct and tail.
    pub payload: Vec<u8>,
}

impl Logged {
    /// Struct and tail.
    pub fn body(&self) -> &[u8] {
        body_of(&self.payload)
    }
}

/// Returns struct and tail of a message with its CDR header.
pub fn body_of(payload: &[u8]) -> &[u8] {
    payload.strip_prefix(CDR_LITTLE_ENDIAN.as_slice()).unwrap_or_default()
}

/// An indexed log.
#[derive(Debug, Clone)]
pub struct LogFile {
    path: PathBuf,
    file: Arc<File>,
    summary: Arc<Summary>,
}

/// A cursor through a log.
pub struct Reading {
    log: LogFile,
    reader: IndexedReader,
}

impl LogFile {
    /// Opens a log and reads its index.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn open(path: &Path) -> Result<LogFile, PlayError> {
        let read_error = |cause| PlayError::Read { path: path.to_owned(), cause };
        let damaged = |cause: String| PlayError::Damaged { path: path.to_owned(), cause };
        let mut file = File::open(path).map_err(read_error)?;
        let mut reader = SummaryReader::new();
        while let Some(event) = reader.next_event() {
            match event.map_err(|error| damaged(error.to_string()))? {
                SummaryReadEvent::ReadRequest(bytes) => {
                    if bytes > MAX_RECORD {
                        return Err(damaged(format!("index record too large: {bytes} bytes")));
                    }
                    let read = file.read(reader.insert(bytes)).map_err(read_error)?;
                    reader.notify_read(read);
                }
                SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to).map_err(read_error)?),
            }
        }
        let summary = reader.finish().filter(|summary| !summary.chunk_indexes.is_empty());
        let summary = summary.ok_or_else(|| damaged("the log has no index: it is truncated".to_owned()))?;
        Ok(LogFile { path: path.to_owned(), file: Arc::new(file), summary: Arc::new(summary) })
    }

    /// Returns why the run ended, or `None` if the log does not contain it.
    pub fn end_reason(&self) -> Option<EndReason> {
        /// Opcode and length of a record.
        const HEAD: usize = 1 + size_of::<u64>();
        let index = self.summary.metadata_indexes.iter().rev().find(|index| index.name == END_RECORD)?;
        let length =
            usize::try_from(index.length).ok().filter(|length| (HEAD..=END_BYTES).contains(length))?;
        let mut record = vec![0; length];
        self.file.read_exact_at(&mut record, index.offset).ok()?;
        match parse_record(record[0], &record[HEAD..]).ok()? {
            Record::Metadata(entries) => {
                EndMarker::from_metadata(&self.path, &entries.metadata).ok().map(|marker| marker.reason)
            }
            _ => None,
        }
    }

    /// First and last simulated time, ns.
    pub fn bounds_ns(&self) -> (u64, u64) {
        let chunks = &self.summary.chunk_indexes;
        let first = chunks.iter().map(|chunk| chunk.message_start_time).min().unwrap_or(0);
        let last = chunks.iter().map(|chunk| chunk.message_end_time).max().unwrap_or(0);
        (first, last)
    }

    /// Returns the messages of some topics (empty: all) after a time, oldest first.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn after(&self, time_ns: Option<u64>, topics: &[&str]) -> Result<Reading, PlayError> {
        let mut options = IndexedReaderOptions::new().with_order(ReadOrder::LogTime);
        if let Some(time_ns) = time_ns {
            options = options.starting_after(time_ns);
        }
        self.reading(options, topics)
    }

    /// Returns the newest message of a topic at or before a time.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn newest(&self, topic: Topic, time_ns: u64) -> Result<Option<Logged>, PlayError> {
        let known = self.summary.channels.values().any(|channel| channel.topic == topic.name());
        if !known {
            return Ok(None);
        }
        let options = IndexedReaderOptions::new().with_order(ReadOrder::ReverseLogTime).ending_at(time_ns);
        self.reading(options, &[topic.name()])?.next_message()
    }

    fn reading(&self, mut options: IndexedReaderOptions, topics: &[&str]) -> Result<Reading, PlayError> {
        if !topics.is_empty() {
            options = options.include_topics(topics.iter().copied());
        }
        let options = options.with_record_length_limit(MAX_RECORD);
        let reader =
            IndexedReader::new_with_options(&self.summary, options).map_err(|error| self.damaged(&error))?;
        Ok(Reading { log: self.clone(), reader })
    }

    fn damaged(&self, cause: &mcap::McapError) -> PlayError {
        PlayError::Damaged { path: self.path.clone(), cause: cause.to_string() }
    }

    fn chunk(&self, offset: u64, length: usize) -> Result<Vec<u8>, PlayError> {
        let read_error = |cause| PlayError::Read { path: self.path.clone(), cause };
        let mut bytes = Vec::new();
        // A forged length must not allocate memory: the buffer grows only as bytes are read. `read_at` leaves
        // the file's position alone, because several threads read.
        while bytes.len() < length {
            let begin = bytes.len();
            bytes.resize(begin + READ_BYTES.min(length - begin), 0);
            let read = self.file.read_at(&mut bytes[begin..], offset.saturating_add(begin as u64));
            bytes.truncate(begin + *read.as_ref().unwrap_or(&0));
            match read {
                Ok(0) => break,
                Err(cause) if cause.kind() != ErrorKind::Interrupted => return Err(read_error(cause)),
                _ => {}
            }
        }
        Ok(bytes)
    }
}

impl Reading {
    /// Returns the next message.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn next_message(&mut self) -> Result<Option<Logged>, PlayError> {
        self.next_with(|topic, time_ns, payload| Logged {
            topic: topic.to_owned(),
            time_ns,
            payload: payload.to_vec(),
        })
    }

    /// Returns the result of `take` on the next message, without a copy; `take` gets its topic, its time, and
    /// its CDR header, struct and tail.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn next_with<R>(&mut self, take: impl FnOnce(&str, u64, &[u8]) -> R) -> Result<Option<R>, PlayError> {
        loop {
            let request = match self.reader.next_event() {
                None => return Ok(None),
                Some(Err(error)) => return Err(self.log.damaged(&error)),
                Some(Ok(IndexedReadEvent::Message { header, data })) => {
                    let Some(channel) = self.log.summary.channels.get(&header.channel_id) else { continue };
                    return Ok(Some(take(&channel.topic, header.log_time, data)));
                }
                Some(Ok(IndexedReadEvent::ReadChunkRequest { offset, length })) => (offset, length),
            };
            let bytes = self.log.chunk(request.0, request.1)?;
            self.reader
                .insert_chunk_record_data(request.0, &bytes)
                .map_err(|error| self.log.damaged(&error))?;
        }
    }
}
