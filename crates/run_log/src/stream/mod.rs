//! Reads the messages of a log in order and checks them.

use std::collections::{BTreeMap, BTreeSet};
use std::io::BufReader;
use std::path::Path;

use messages::layout::Description;

use crate::continuity::{Continuity, Removals};
use crate::end::{END_RECORD, EndMarker, Ending, REPAIR_RECORD};
use crate::error::LogError;
use crate::header::{HEADER_RECORD, LogHeader, check_layouts};
use crate::index::Summary;
use crate::limits::DeclarationCount;
use crate::opening::{HeaderCopy, OpenedHeader, Parts, open};
use crate::records::{FileRecord, Records};
use crate::source::{LogSource, ReadSeek};
use crate::topics::Topic;
use crate::verdict::{Fault, Verdict};

use in_chunk::MessageLocation;

mod in_chunk;

/// How strict a reader is.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReadOptions {
    /// Reads messages whose layout differs from this build's as if it matched. Their sizes are still checked.
    pub allow_other_layouts: bool,
}

/// One message.
#[derive(Debug, Clone, Copy)]
pub struct LogMessage<'a> {
    /// Name of its topic.
    pub topic: &'a str,
    /// Its topic, if this build knows it.
    pub known: Option<Topic>,
    /// Its layout.
    pub description: &'static Description,
    /// Low 32 bits of the number of earlier messages of this topic.
    pub sequence: u32,
    /// Simulated time.
    pub log_time_ns: u64,
    /// Number of its chunk in the file, counted from 1.
    pub chunk: u64,
    /// Struct and tail.
    pub body: &'a [u8],
}

struct Channel {
    topic: String,
    known: Option<Topic>,
    description: Option<&'static Description>,
    schema: String,
    count: u64,
    bytes: u64,
    /// Messages lost to damage, according to the numbers; nonzero only in a repaired log.
    missing: u64,
}

/// Messages and bytes of one topic so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TopicCount {
    /// Messages read.
    pub messages: u64,
    /// Bytes of these messages, without framing, before compression.
    pub bytes: u64,
    /// Messages lost to damage in between. Nonzero only for a repaired log, because reading any other log
    /// stops at a gap.
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
    declared: DeclarationCount,
    /// The second copy of the header, as far as it has been read.
    second: Parts,
    /// Whether the second copy has been reached, intact or not.
    has_second: bool,
    header_fault: Option<(HeaderCopy, String)>,
    continuity: Continuity,
    /// The end marker of a log that another program rewrote with its metadata before its messages.
    early_marker: Option<EndMarker>,
    /// Where reading stopped, and why.
    damage: Option<(u64, String)>,
    /// Topics to return; `None` for all.
    wanted: Option<Vec<String>>,
    /// Whether messages have this build's layout, so that their times can be checked.
    has_own_layouts: bool,
    done: bool,
}

impl MessageStream {
    /// Opens a log and reads its header.
    pub fn open(log: &dyn LogSource, options: ReadOptions) -> Result<MessageStream, LogError> {
        MessageStream::from_reader(log.open()?, log.path(), options)
    }

    /// Opens a log for some topics only. If the log has an index, chunks without these topics are skipped, so
    /// that reading states costs the same with or without images beside them. The whole-file checksum is then
    /// not checked; those of the chunks that are read are.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_topics(
        log: &dyn LogSource,
        topics: &[String],
        options: ReadOptions,
    ) -> Result<MessageStream, LogError> {
        let mut stream = MessageStream::open(log, options)?;
        if let Ok(mut source) = log.open()
            && let Some(summary) = Summary::read(&mut source, None)
        {
            stream.records.skip_chunks(summary.chunks_without(topics));
            // A file holds each schema once, possibly in a skipped chunk.
            stream.schemas = summary.schemas.into_iter().map(|(id, (header, _))| (id, header.name)).collect();
        }
        stream.wanted = Some(topics.to_vec());
        Ok(stream)
    }

    /// Reads the header of a log from any source; errors name `path`.
    pub fn from_reader(
        source: Box<dyn ReadSeek>,
        path: &Path,
        options: ReadOptions,
    ) -> Result<MessageStream, LogError> {
        let source = BufReader::with_capacity(1 << 16, source);
        let OpenedHeader { header, metadata, records, first_is_bad, is_behind } = open(source, path)?;
        if !options.allow_other_layouts {
            check_layouts(path, &metadata, &header)?;
        }
        Ok(MessageStream {
            records,
            continuity: Continuity::from_tick(header.first_tick),
            header,
            metadata,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            position: 0,
            in_chunk: false,
            chunks: 0,
            ending: Ending::default(),
            repaired: false,
            declared: DeclarationCount::default(),
            second: Parts::default(),
            has_second: is_behind,
            header_fault: first_is_bad.map(|cause| (HeaderCopy::First, cause)),
            early_marker: None,
            damage: None,
            wanted: None,
            has_own_layouts: !options.allow_other_layouts,
            done: false,
        })
    }

    /// The log's header.
    pub fn header(&self) -> &LogHeader {
        &self.header
    }

    /// The header's metadata record as stored in the file.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The file's name for error messages.
    pub fn path(&self) -> &Path {
        self.records.path()
    }

    /// How the file ends. Known once [`next_message`](Self::next_message) has returned `None`.
    pub fn ending(&self) -> &Ending {
        &self.ending
    }

    /// Returns what is wrong with the log, as far as it has been read: complete once
    /// [`next_message`](Self::next_message) has returned `None` or an error. When reading only some topics,
    /// covers the chunks read.
    pub fn verdict(&self) -> Verdict {
        let mut faults = Vec::new();
        if let Some((copy, cause)) = &self.header_fault {
            faults.push(Fault::HeaderDamaged { copy: *copy, cause: cause.clone() });
        }
        let removals = if self.wants(Topic::Removed.name()) { Removals::Read } else { Removals::Skipped };
        let gap = self.continuity.gap(removals, &self.counts(), self.ending.marker.as_ref());
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

    /// Topics of the log. Complete once [`next_message`](Self::next_message) has returned `None`.
    pub(crate) fn topics(&self) -> BTreeSet<&str> {
        let declared = self.channels.values().map(|channel| channel.topic.as_str());
        let counted = self.ending.marker.iter().flat_map(|marker| marker.counts.keys().map(String::as_str));
        declared.chain(counted).collect()
    }

    pub(crate) fn no_such_topic(&self, topic: &str) -> LogError {
        let topics = Vec::from_iter(self.topics()).join(", ");
        LogError::NoSuchTopic { path: self.path().into(), topic: topic.to_owned(), topics }
    }

    /// Bytes of the file read so far.
    pub fn offset(&self) -> u64 {
        self.records.offset()
    }

    /// Returns the next message; `None` at the end, however the file ends. After an error there are no more.
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
            known: channel.known,
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

    fn find(&mut self) -> Result<Option<MessageLocation>, LogError> {
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
                FileRecord::Metadata { name, entries } if name == END_RECORD => {
                    let marker = EndMarker::from_metadata(self.records.path(), &entries)?;
                    match self.is_moved_before_messages() {
                        true => self.early_marker = Some(marker),
                        false => self.end_marker(marker)?,
                    }
                }
                FileRecord::Metadata { name, entries } if name == HEADER_RECORD => self.second(&entries),
                FileRecord::Metadata { name, .. } if name == REPAIR_RECORD => self.repaired = true,
                FileRecord::Attachment(found) => self.second.take(&found),
                FileRecord::Metadata { .. } => (),
                FileRecord::End => {
                    if let Some(marker) = self.early_marker.take() {
                        self.end_marker(marker)?;
                    }
                    self.done = true;
                }
                FileRecord::Cut(cut) => {
                    self.ending.cut = Some(cut);
                    self.done = true;
                }
            }
        }
    }

    /// Reads the next record of the file. A damaged second copy of the header does not stop reading.
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

    /// Returns whether a record that belongs after the messages precedes all of them, because another program
    /// rewrote the file.
    fn is_moved_before_messages(&self) -> bool {
        self.chunks == 0 && self.records.is_written_by_another()
    }

    fn second(&mut self, entries: &BTreeMap<String, String>) {
        if self.is_moved_before_messages() && *entries == self.metadata {
            // The first copy was read with the attachments of both.
            (self.second, self.has_second) = (Parts::default(), true);
            return;
        }
        let header = self.second.header(self.records.path(), entries);
        if std::mem::replace(&mut self.has_second, true) {
            return;
        }
        match header {
            Ok(header) if header == self.header => {}
            Ok(_) => self.second_is_bad("it differs from the one at the start".to_string()),
            Err(error) => self.second_is_bad(crate::opening::cause(&error)),
        }
    }

    fn second_is_bad(&mut self, cause: String) {
        self.has_second = true;
        // The damaged header already explains a wrong whole-file checksum.
        self.records.ignore_checksum();
        self.header_fault.get_or_insert((HeaderCopy::Second, cause));
    }

    fn end_marker(&mut self, marker: EndMarker) -> Result<(), LogError> {
        let is_ours = !self.records.is_written_by_another();
        if !self.has_second && is_ours && crate::seal::is_sealed(&self.metadata) {
            self.second_is_bad("missing".to_string());
        }
        for (topic, &written) in &marker.counts {
            let channel = self.channels.values().find(|channel| channel.topic == *topic);
            let (read, missing) = channel.map_or((0, 0), |channel| (channel.count, channel.missing));
            let damaged = marker.damaged.get(topic).copied().unwrap_or(0);
            if self.wants(topic) && (read != written || missing > damaged) {
                return Err(self.damaged(format!(
                    "{topic} has {read} messages and {missing} missing, the end marker says {written} and \
                     {damaged}"
                )));
            }
        }
        self.ending.marker = Some(marker);
        Ok(())
    }
}
