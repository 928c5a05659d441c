//! The messages of a log, one after the other, checked.

use std::collections::{BTreeMap, BTreeSet};
use std::io::BufReader;
use std::ops::Range;
use std::path::Path;

use ipc_types::layout::{CDR_LITTLE_ENDIAN, Description, Message};
use ipc_types::messages::Removed;
use ipc_types::services::MAX_REMOVED_PER_TICK;
use mcap::records::{Record, op};

use crate::continuity::Continuity;
use crate::end::{END_RECORD, EndMarker, Ending, REPAIR_RECORD};
use crate::error::LogError;
use crate::fields::message_size;
use crate::header::{HEADER_RECORD, LogHeader, check_layouts};
use crate::index::Summary;
use crate::lengths::parse_record;
use crate::limits::{Declared, check_declaration};
use crate::opening::{HeaderCopy, Opened, Parts, open};
pub use crate::records::ReadSeek;
use crate::records::{FileRecord, Records, chunk_record, open_log};
use crate::topics;
use crate::verdict::{Fault, Verdict};

/// Longest removal: with as many voxels as its service takes.
const MAX_REMOVED_BYTES: usize = Removed::DESCRIPTION.size + MAX_REMOVED_PER_TICK * 4;

/// How strict a reader is.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReadOptions {
    /// Reads messages whose layout is not this build's as if it were. Their sizes are still checked.
    pub allow_other_layouts: bool,
}

/// One message.
#[derive(Debug, Clone, Copy)]
pub struct LogMessage<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// Its layout.
    pub description: &'static Description,
    /// Low 32 bits of the number of earlier messages of this topic.
    pub sequence: u32,
    /// Simulated time.
    pub log_time_ns: u64,
    /// Number of its chunk in the file, from 1.
    pub chunk: u64,
    /// Struct and tail.
    pub body: &'a [u8],
}

struct Channel {
    topic: String,
    description: Option<&'static Description>,
    schema: String,
    count: u64,
    bytes: u64,
    /// Messages that a damage took, as the numbers show; only in a repaired log.
    missing: u64,
}

/// Messages and bytes of one topic so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TopicCount {
    /// Messages read.
    pub messages: u64,
    /// Their bytes, without framing, before compression.
    pub bytes: u64,
    /// Messages between them that a damage took; 0 but in a repaired log, since others are not read beyond a gap.
    pub missing: u64,
}

/// The messages of a log in the order in which they were written. Holds one chunk in memory.
pub struct MessageStream {
    records: Records,
    header: LogHeader,
    metadata: BTreeMap<String, String>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
    position: usize,
    in_chunk: bool,
    chunks: u64,
    ending: Ending,
    repaired: bool,
    declared: Declared,
    /// The second copy of the header, as far as it has come.
    second: Parts,
    /// Whether it has been met, whole or not.
    has_second: bool,
    header_fault: Option<(HeaderCopy, String)>,
    continuity: Continuity,
    /// Where reading stopped, and why.
    damage: Option<(u64, String)>,
    /// Topics that are handed out; none for all.
    wanted: Option<Vec<String>>,
    done: bool,
}

/// A message found in the chunk: channel, number, time, range of its body.
struct Found {
    channel: u16,
    sequence: u32,
    log_time_ns: u64,
    body: Range<usize>,
}

impl MessageStream {
    /// Opens a log and reads its header.
    pub fn open(path: &Path, options: ReadOptions) -> Result<MessageStream, LogError> {
        let file = open_log(path)?;
        MessageStream::from_reader(Box::new(file), path, options)
    }

    /// Opens a log for some topics only. Chunks that hold none of them are not read if the log's index tells them, so
    /// that states cost the same with images beside them as without; the checksum of the whole file is then not
    /// checked, those of the chunks read are.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_topics(
        path: &Path,
        topics: &[String],
        options: ReadOptions,
    ) -> Result<MessageStream, LogError> {
        let mut stream = MessageStream::open(path, options)?;
        if let Ok(mut file) = open_log(path)
            && let Some(summary) = Summary::read(&mut file, None)
        {
            stream.records.pass_over(summary.chunks_without(topics));
            // A schema stands in a file once: it may lie in a chunk that is passed over.
            stream.schemas = summary.schemas.into_iter().map(|(id, (header, _))| (id, header.name)).collect();
        }
        stream.wanted = Some(topics.to_vec());
        Ok(stream)
    }

    /// Reads the header of a log from any source; errors will name `path`.
    pub fn from_reader(
        source: Box<dyn ReadSeek>,
        path: &Path,
        options: ReadOptions,
    ) -> Result<MessageStream, LogError> {
        let source = BufReader::with_capacity(1 << 16, source);
        let Opened { header, metadata, records, first_is_bad } = open(source, path)?;
        if !options.allow_other_layouts {
            check_layouts(path, &metadata, &header)?;
        }
        Ok(MessageStream {
            records,
            header,
            metadata,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            position: 0,
            in_chunk: false,
            chunks: 0,
            ending: Ending::default(),
            repaired: false,
            declared: Declared::default(),
            second: Parts::default(),
            has_second: first_is_bad.is_some(),
            header_fault: first_is_bad.map(|cause| (HeaderCopy::First, cause)),
            continuity: Continuity::default(),
            damage: None,
            wanted: None,
            done: false,
        })
    }

    /// What the log is about.
    pub fn header(&self) -> &LogHeader {
        &self.header
    }

    /// The header's metadata record as it stands in the file.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The file, for messages.
    pub fn path(&self) -> &Path {
        self.records.path()
    }

    /// How the file ends. Known once [`next_message`](Self::next_message) has returned none.
    pub fn ending(&self) -> &Ending {
        &self.ending
    }

    /// What is wrong with the log, as far as it has been read: all of it once
    /// [`next_message`](Self::next_message) has returned none or an error. With some topics only, of the chunks read.
    pub fn verdict(&self) -> Verdict {
        let mut faults = Vec::new();
        if let Some((copy, cause)) = &self.header_fault {
            faults.push(Fault::HeaderDamaged { copy: *copy, cause: cause.clone() });
        }
        let gap =
            self.continuity.gap(self.wants(topics::REMOVED), &self.counts(), self.ending.marker.as_ref());
        faults.extend(gap.map(Fault::Gap));
        match (&self.damage, self.ending.cut, &self.ending.marker) {
            (Some((offset, cause)), _, _) => {
                faults.push(Fault::Damaged { offset: *offset, cause: cause.clone() });
            }
            (None, Some(cut), marker) => {
                faults.push(Fault::Cut { cut, ended: marker.is_some() });
            }
            (None, None, None) => faults.push(Fault::NotEnded),
            (None, None, Some(_)) => {}
        }
        Verdict { faults, ending: self.ending.clone() }
    }

    /// Messages and bytes so far, by topic.
    pub fn counts(&self) -> BTreeMap<String, TopicCount> {
        let count = |channel: &Channel| {
            let Channel { count, bytes, missing, .. } = *channel;
            TopicCount { messages: count, bytes, missing }
        };
        self.channels.values().map(|channel| (channel.topic.clone(), count(channel))).collect()
    }

    /// Topics of the log. All of them are known once [`next_message`](Self::next_message) has returned none.
    pub(crate) fn topics(&self) -> BTreeSet<&str> {
        let declared = self.channels.values().map(|channel| channel.topic.as_str());
        let counted = self.ending.marker.iter().flat_map(|marker| marker.counts.keys().map(String::as_str));
        declared.chain(counted).collect()
    }

    pub(crate) fn no_such_topic(&self, topic: &str) -> LogError {
        let topics = Vec::from_iter(self.topics()).join(", ");
        LogError::NoSuchTopic { path: self.path().into(), topic: topic.to_owned(), topics }
    }

    /// Bytes of the file that have been read.
    pub fn offset(&self) -> u64 {
        self.records.offset()
    }

    /// The next message; none at the end, however the file ends. After an error there is no more.
    pub fn next_message(&mut self) -> Result<Option<LogMessage<'_>>, LogError> {
        let found = self.find().inspect_err(|error| {
            self.done = true;
            self.damage = Some(match error {
                LogError::Damaged { offset, cause, .. } => (*offset, cause.clone()),
                other => (self.records.offset(), other.without_path()),
            });
        });
        let Some(found) = found? else { return Ok(None) };
        let missing =
            || LogError::NoHeader { path: self.records.path().into(), offset: self.records.offset() };
        let channel = self.channels.get(&found.channel).ok_or_else(missing)?;
        let description = channel.description.ok_or_else(missing)?;
        Ok(Some(LogMessage {
            topic: &channel.topic,
            description,
            sequence: found.sequence,
            log_time_ns: found.log_time_ns,
            chunk: self.chunks,
            body: &self.records.chunk()[found.body],
        }))
    }

    fn wants(&self, topic: &str) -> bool {
        self.wanted.as_ref().is_none_or(|wanted| wanted.iter().any(|name| name == topic))
    }

    fn find(&mut self) -> Result<Option<Found>, LogError> {
        loop {
            if self.done {
                return Ok(None);
            }
            if self.in_chunk {
                match self.find_in_chunk()? {
                    Some(found) => return Ok(Some(found)),
                    None => self.in_chunk = false,
                }
            }
            match self.next_record()? {
                FileRecord::Chunk => {
                    (self.position, self.in_chunk) = (0, true);
                    self.chunks += 1;
                }
                FileRecord::Metadata { name, entries } if name == END_RECORD => self.end_marker(&entries)?,
                FileRecord::Metadata { name, entries } if name == HEADER_RECORD => self.second(&entries),
                FileRecord::Metadata { name, .. } if name == REPAIR_RECORD => self.repaired = true,
                FileRecord::Attachment(found) => self.second.take(&found),
                FileRecord::Metadata { .. } => (),
                FileRecord::End => self.done = true,
                FileRecord::Cut(cut) => {
                    self.ending.cut = Some(cut);
                    self.done = true;
                }
            }
        }
    }

    /// The next record of the file. What is wrong with the second copy of the header keeps nobody from reading on.
    fn next_record(&mut self) -> Result<FileRecord, LogError> {
        loop {
            match self.records.next_record() {
                Err(LogError::Damaged { cause, .. })
                    if !self.has_second && self.chunks == 1 && self.records.is_beside_messages() =>
                {
                    self.second_is_bad(cause);
                }
                other => return other,
            }
        }
    }

    fn second(&mut self, entries: &BTreeMap<String, String>) {
        let header = self.second.header(self.records.path(), entries);
        if std::mem::replace(&mut self.has_second, true) {
            return;
        }
        match header {
            Ok(header) if header == self.header => {}
            Ok(_) => self.second_is_bad("it is not the one at the start".to_string()),
            Err(error) => self.second_is_bad(crate::opening::cause(&error)),
        }
    }

    fn second_is_bad(&mut self, cause: String) {
        self.has_second = true;
        // That the whole file's checksum is wrong is explained.
        self.records.forget_checksum();
        self.header_fault.get_or_insert((HeaderCopy::Second, cause));
    }

    fn end_marker(&mut self, entries: &BTreeMap<String, String>) -> Result<(), LogError> {
        let marker = EndMarker::from_metadata(self.records.path(), entries)?;
        if !self.has_second && crate::seal::is_sealed(&self.metadata) {
            self.second_is_bad("there is none".to_string());
        }
        for (topic, &written) in &marker.counts {
            let channel = self.channels.values().find(|channel| channel.topic == *topic);
            let (read, missing) = channel.map_or((0, 0), |channel| (channel.count, channel.missing));
            let damaged = marker.damaged.get(topic).copied().unwrap_or(0);
            if self.wants(topic) && (read != written || missing > damaged) {
                return Err(self.damaged(format!(
                    "{topic} has {read} messages and misses {missing}, the end marker says {written} and {damaged}"
                )));
            }
        }
        self.ending.marker = Some(marker);
        Ok(())
    }

    fn find_in_chunk(&mut self) -> Result<Option<Found>, LogError> {
        loop {
            let chunk = self.records.chunk();
            if self.position == chunk.len() {
                return Ok(None);
            }
            let Some((opcode, body, length)) = chunk_record(&chunk[self.position..]) else {
                return Err(self.damaged("a record that reaches beyond its chunk".to_string()));
            };
            let end = self.position + length;
            let start = end - body.len();
            self.position = end;
            if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
                continue;
            }
            if opcode != op::MESSAGE {
                check_declaration(self.records.path(), body)?;
            }
            match parse_record(opcode, body) {
                Ok(Record::Schema { header, .. }) => {
                    if !self.schemas.contains_key(&header.id) {
                        // Its text is not kept.
                        self.declared.schema(self.records.path(), &header, 0)?;
                        self.schemas.insert(header.id, header.name);
                    }
                }
                Ok(Record::Channel(channel)) => self.declare(channel)?,
                Ok(Record::Message { header, data }) => {
                    let body = end - data.len().min(end - start)..end;
                    if let Some(found) = self.message(&header, body)? {
                        return Ok(Some(found));
                    }
                }
                Ok(_) => (),
                Err(cause) => return Err(self.damaged(cause)),
            }
        }
    }

    fn declare(&mut self, channel: mcap::records::Channel) -> Result<(), LogError> {
        if self.channels.contains_key(&channel.id) {
            return Ok(());
        }
        self.declared.channel(self.records.path(), &channel)?;
        let schema = self.schemas.get(&channel.schema_id).cloned();
        let Some(schema) = schema else {
            // Of a topic that nobody wants: its messages are passed over too.
            if !self.wants(&channel.topic) {
                return Ok(());
            }
            return Err(self.damaged(format!("{} has no schema", channel.topic)));
        };
        let description = topics::description_of(&schema);
        let entry = Channel { topic: channel.topic, description, schema, count: 0, bytes: 0, missing: 0 };
        self.channels.insert(channel.id, entry);
        Ok(())
    }

    fn message(
        &mut self,
        header: &mcap::records::MessageHeader,
        data: Range<usize>,
    ) -> Result<Option<Found>, LogError> {
        let Some(channel) = self.channels.get(&header.channel_id) else {
            // Declared in a chunk that was passed over; a channel that is wanted is counted at the end.
            if self.wanted.is_some() {
                return Ok(None);
            }
            return Err(self.damaged(format!("a message of the undeclared channel {}", header.channel_id)));
        };
        // Of other topics not all chunks are read: their numbers say nothing.
        if !self.wants(&channel.topic) {
            return Ok(None);
        }
        let Some(description) = channel.description else {
            return Err(
                self.damaged(format!("{} holds {}, unknown to this build", channel.topic, channel.schema))
            );
        };
        let expected = (channel.count + channel.missing) as u32;
        let jump = header.sequence.wrapping_sub(expected);
        // A repaired log says so at its start and counts what is missing at its end.
        if jump != 0 && !(self.repaired && jump < u32::MAX / 2) {
            let cause = format!("message {} of {}, expected {expected}", header.sequence, channel.topic);
            return Err(self.damaged(cause));
        }
        let bytes = &self.records.chunk()[data.clone()];
        let Some(body) = bytes.strip_prefix(CDR_LITTLE_ENDIAN.as_slice()) else {
            return Err(
                self.damaged(format!("a message of {} without the CDR header 00 01 00 00", channel.topic))
            );
        };
        let expected = message_size(description, body).filter(|_| body.len() >= description.size);
        if expected != Some(body.len()) {
            let expected = expected.unwrap_or(description.size);
            let cause =
                format!("a message of {} of {} bytes, expected {expected}", channel.topic, body.len());
            return Err(self.damaged(cause));
        }
        // A tick's voxels are held until its state comes: no message holds more than one can publish.
        if channel.topic == topics::REMOVED && body.len() > MAX_REMOVED_BYTES {
            let cause = format!(
                "a message of {} of {} bytes, at most {MAX_REMOVED_BYTES}",
                channel.topic,
                body.len()
            );
            return Err(self.damaged(cause));
        }
        self.continuity.see(&channel.topic, body);
        let body = data.end - body.len()..data.end;
        if let Some(channel) = self.channels.get_mut(&header.channel_id) {
            channel.count += 1;
            channel.missing += u64::from(jump);
            channel.bytes += body.len() as u64;
        }
        let (sequence, log_time_ns) = (header.sequence, header.log_time);
        Ok(Some(Found { channel: header.channel_id, sequence, log_time_ns, body }))
    }

    fn damaged(&self, cause: String) -> LogError {
        LogError::Damaged { path: self.records.path().into(), offset: self.records.offset(), cause }
    }
}
