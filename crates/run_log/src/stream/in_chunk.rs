//! Reads the records of one chunk: declarations, and messages, which are checked before they are returned.

use std::ops::Range;

use mcap::records::{Record, op};
use messages::Removed;
use messages::layout::{CDR_LITTLE_ENDIAN, Message};
use messages::services::MAX_REMOVED_PER_MESSAGE;

use super::{Channel, MessageStream};
use crate::error::LogError;
use crate::fields::message_size;
use crate::lengths::parse_record;
use crate::limits::check_declaration;
use crate::records::chunk_record;
use crate::times::log_time_ns;
use crate::topics::{self, Topic};

/// Longest removal message in bytes: as many voxels as its service can carry.
const MAX_REMOVED_BYTES: usize = Removed::DESCRIPTION.size + MAX_REMOVED_PER_MESSAGE * 4;

/// A message found in the chunk: channel, number, time, range of its body.
pub(super) struct MessageLocation {
    pub channel: u16,
    pub sequence: u32,
    pub log_time_ns: u64,
    pub body: Range<usize>,
}

impl MessageStream {
    pub(super) fn find_in_chunk(&mut self) -> Result<Option<MessageLocation>, LogError> {
        loop {
            let chunk = self.records.chunk();
            if self.position == chunk.len() {
                return Ok(None);
            }
            let Some((opcode, body, length)) = chunk_record(&chunk[self.position..]) else {
                return Err(self.damaged("record extends beyond its chunk".to_string()));
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
                        // The schema's text is not kept.
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
            // No reader requested this topic, so skip its messages too.
            if !self.wants(&channel.topic) {
                return Ok(());
            }
            return Err(self.damaged(format!("{} has no schema", channel.topic)));
        };
        let description = topics::description_of(&schema);
        let known = Topic::of_name(&channel.topic);
        let entry =
            Channel { topic: channel.topic, known, description, schema, count: 0, bytes: 0, missing: 0 };
        self.channels.insert(channel.id, entry);
        Ok(())
    }

    fn message(
        &mut self,
        header: &mcap::records::MessageHeader,
        data: Range<usize>,
    ) -> Result<Option<MessageLocation>, LogError> {
        let Some(channel) = self.channels.get(&header.channel_id) else {
            // Declared in a skipped chunk; requested channels are checked at the end.
            if self.wanted.is_some() {
                return Ok(None);
            }
            return Err(self.damaged(format!("message on undeclared channel {}", header.channel_id)));
        };
        // Chunks of other topics may be skipped, so their numbers prove nothing.
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
        // A repaired log announces this at its start and counts its losses at its end.
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
        // A tick's voxels are held until its state arrives, so reject any message larger than the service can
        // publish.
        if channel.known == Some(Topic::Removed) && body.len() > MAX_REMOVED_BYTES {
            let cause = format!(
                "a message of {} of {} bytes, at most {MAX_REMOVED_BYTES}",
                channel.topic,
                body.len()
            );
            return Err(self.damaged(cause));
        }
        self.check_time(channel, header, body)?;
        self.continuity.see(channel.known, body);
        let body = data.end - body.len()..data.end;
        if let Some(channel) = self.channels.get_mut(&header.channel_id) {
            channel.count += 1;
            channel.missing += u64::from(jump);
            channel.bytes += body.len() as u64;
        }
        let (sequence, log_time_ns) = (header.sequence, header.log_time);
        Ok(Some(MessageLocation { channel: header.channel_id, sequence, log_time_ns, body }))
    }

    /// Checks the two times of a message of the run lane; a replay compares only the bodies.
    fn check_time(
        &self,
        channel: &Channel,
        header: &mcap::records::MessageHeader,
        body: &[u8],
    ) -> Result<(), LogError> {
        let topic = channel.known.filter(|_| self.has_own_layouts);
        let expected = topic.and_then(|topic| log_time_ns(topic, body, self.header.dt_ns));
        let times = [("log_time", header.log_time), ("publish_time", header.publish_time)];
        match times.into_iter().find(|(_, found)| expected.is_some_and(|expected| *found != expected)) {
            None => Ok(()),
            Some((name, found)) => Err(self.damaged(format!(
                "message {} of {} has {name} {found} ns, its content has {} ns",
                header.sequence,
                channel.topic,
                expected.unwrap_or_default()
            ))),
        }
    }

    pub(super) fn damaged(&self, cause: String) -> LogError {
        LogError::Damaged { path: self.records.path().into(), offset: self.records.offset(), cause }
    }
}
