//! Which chunks hold which topics, from a whole log's index: a question about one topic need not read the others.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Seek, SeekFrom};

use mcap::MAGIC;
use mcap::records::{Record, op};

use crate::records::{MAX_RECORD_BYTES, RECORD_HEADER, chunk_record};

/// Bytes of the footer's fields and of the whole end of a file.
const FOOTER: usize = 8 + 8 + 4;
const END: usize = RECORD_HEADER + FOOTER + MAGIC.len();

/// Offsets of the chunks that hold nothing of the topics; none if the file has no index that can be trusted: then
/// everything is read.
pub(crate) fn chunks_without<R: Read + Seek>(source: &mut R, topics: &[String]) -> Option<BTreeSet<u64>> {
    let summary = summary(source)?;
    let (mut channels, mut chunks) = (BTreeMap::new(), Vec::new());
    let mut rest = summary.as_slice();
    while !rest.is_empty() {
        let (opcode, body, length) = chunk_record(rest)?;
        match (opcode, mcap::parse_record(opcode, body)) {
            (op::CHANNEL, Ok(Record::Channel(channel))) => {
                channels.insert(channel.id, channel.topic);
            }
            (op::CHUNK_INDEX, Ok(Record::ChunkIndex(index))) => chunks.push(index),
            (_, Ok(_)) => {}
            (_, Err(_)) => return None,
        }
        rest = &rest[length..];
    }
    let wanted = |id: &u16| channels.get(id).is_none_or(|topic| topics.contains(topic));
    // The first chunk declares the channels of the run lane.
    let without = chunks.iter().skip(1).filter(|chunk| !chunk.message_index_offsets.keys().any(wanted));
    Some(without.map(|chunk| chunk.chunk_start_offset).collect())
}

/// The summary section's records, their checksum checked.
fn summary<R: Read + Seek>(source: &mut R) -> Option<Vec<u8>> {
    let length = source.seek(SeekFrom::End(0)).ok()?;
    let end = length.checked_sub(END as u64)?;
    let tail = read(source, end, END as u64)?;
    if tail[0] != op::FOOTER || !tail.ends_with(MAGIC) {
        return None;
    }
    let word = |at: usize| Some(u64::from_le_bytes(tail.get(at..at + 8)?.try_into().ok()?));
    let (start, offsets) = (word(RECORD_HEADER)?, word(RECORD_HEADER + 8)?);
    let bytes = end.checked_sub(start).filter(|bytes| start > 0 && *bytes <= MAX_RECORD_BYTES)?;
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
    if offsets >= start {
        summary.truncate((offsets - start) as usize);
    }
    Some(summary)
}

fn read<R: Read + Seek>(source: &mut R, at: u64, count: u64) -> Option<Vec<u8>> {
    source.seek(SeekFrom::Start(at)).ok()?;
    let mut bytes = Vec::new();
    source.take(count).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 == count).then_some(bytes)
}
