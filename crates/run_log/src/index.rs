//! The summary of a complete log: which chunks contain which topics, so that reading one topic skips the
//! other chunks, and the declarations, as a fallback where the log's own are damaged.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::{Channel, Record, SchemaHeader, op};

use crate::lengths::parse_record;
use crate::limits::{DeclarationCount, MAX_DECLARATION_BYTES, MAX_INDEX_BYTES};
use crate::records::{RECORD_HEADER, chunk_record};
use crate::topics;

/// Size of the footer's fields and of the end of a complete file, in bytes.
const FOOTER: usize = 8 + 8 + 4;
const END: usize = RECORD_HEADER + FOOTER + MAGIC.len();

/// Declarations and chunk index, repeated in a log's summary.
#[derive(Default)]
pub(crate) struct Summary {
    /// Schemas with their text.
    pub schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    pub channels: BTreeMap<u16, Channel>,
    chunks: Vec<ChunkPlace>,
}

/// The part of a chunk's index entry that is kept.
struct ChunkPlace {
    offset: u64,
    channels: Box<[u16]>,
}

impl Summary {
    /// Reads the summary; returns `None` if the file has no intact index. `data_end` is where the summary
    /// begins; without it, the footer's value is used.
    pub fn read<R: Read + Seek>(source: &mut R, data_end: Option<u64>) -> Option<Summary> {
        let records = records(source, data_end)?;
        let (mut summary, mut rest) = (Summary::default(), records.as_slice());
        let mut declared = DeclarationCount::default();
        while !rest.is_empty() {
            let (opcode, body, length) = chunk_record(rest)?;
            let is_declaration = matches!(opcode, op::SCHEMA | op::CHANNEL);
            if is_declaration && body.len() > MAX_DECLARATION_BYTES {
                return None;
            }
            if is_declaration || opcode == op::CHUNK_INDEX {
                match parse_record(opcode, body).ok()? {
                    Record::Schema { header, data } => {
                        declared.schema(Path::new(""), &header, data.len()).ok()?;
                        summary.schemas.insert(header.id, (header, data.to_vec()));
                    }
                    Record::Channel(channel) => {
                        declared.channel(Path::new(""), &channel).ok()?;
                        summary.channels.insert(channel.id, channel);
                    }
                    Record::ChunkIndex(index) => {
                        let channels = index.message_index_offsets.keys().copied().collect();
                        let offset = index.chunk_start_offset;
                        summary.chunks.push(ChunkPlace { offset, channels });
                    }
                    _ => {}
                }
            }
            rest = &rest[length..];
        }
        Some(summary)
    }

    /// Returns the declarations of this build's writer in a run lane: schemas and channels numbered from 1 in
    /// topic order.
    pub fn of_run_lane() -> Summary {
        let mut summary = Summary::default();
        for (id, topic) in (1..).zip(topics::RUN_TOPICS) {
            let (name, text) = topics::schema_of(topic.description());
            let header = SchemaHeader { id, name: name.to_string(), encoding: "ros2msg".to_string() };
            summary.schemas.insert(id, (header, text.into_bytes()));
            let metadata = topics::channel_metadata(topic.description());
            let (topic, message_encoding) = (topic.name().to_string(), "cdr".to_string());
            summary.channels.insert(id, Channel { id, schema_id: id, topic, message_encoding, metadata });
        }
        summary
    }

    /// Returns the offsets of the chunks that contain no messages of these topics.
    pub fn chunks_without(&self, topics: &[String]) -> BTreeSet<u64> {
        let wanted = |id: &u16| self.channels.get(id).is_none_or(|channel| topics.contains(&channel.topic));
        // The first chunk declares the channels of the run lane.
        let others = self.chunks.iter().skip(1);
        let without = others.filter(|chunk| !chunk.channels.iter().any(wanted));
        without.map(|chunk| chunk.offset).collect()
    }
}

/// Reads the summary section's records after checking their checksum.
fn records<R: Read + Seek>(source: &mut R, data_end: Option<u64>) -> Option<Vec<u8>> {
    let length = source.seek(SeekFrom::End(0)).ok()?;
    let end = length.checked_sub(END as u64)?;
    let tail = read(source, end, END as u64)?;
    if tail[0] != op::FOOTER || !tail.ends_with(MAGIC) {
        return None;
    }
    let word = |at: usize| Some(u64::from_le_bytes(tail.get(at..at + 8)?.try_into().ok()?));
    let (told_start, offsets) = (word(RECORD_HEADER)?, word(RECORD_HEADER + 8)?);
    let start = data_end.unwrap_or(told_start);
    let bytes = end.checked_sub(start).filter(|bytes| start > 0 && *bytes <= MAX_INDEX_BYTES)?;
    let mut summary = read(source, start, bytes)?;
    // The checksum covers the summary and the footer up to itself (MCAP specification, "Footer").
    let crc_at = RECORD_HEADER + 16;
    let crc = u32::from_le_bytes(tail.get(crc_at..crc_at + 4)?.try_into().ok()?);
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&summary);
    hasher.update(&tail[..crc_at]);
    if crc == 0 || hasher.finalize() != crc {
        return None;
    }
    if let Some(length) = offsets.checked_sub(told_start) {
        summary.truncate(usize::try_from(length).unwrap_or(usize::MAX));
    }
    Some(summary)
}

fn read<R: Read + Seek>(source: &mut R, at: u64, count: u64) -> Option<Vec<u8>> {
    source.seek(SeekFrom::Start(at)).ok()?;
    let mut bytes = Vec::new();
    source.take(count).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 == count).then_some(bytes)
}
