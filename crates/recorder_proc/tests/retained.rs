//! How much of a log readers keep in memory is limited by kind. Regression: a log of 49 kB took 1.6 GB of
//! schema names.
//!
//! Counts every allocated byte, freed or not, which is an upper bound on the peak memory use.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod common;
use std::alloc::System;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use common::*;
use ipc_types::messages::Keyframe;
use recorder_proc::log_file::LogFile;
use recorder_proc::rewritten::repair;
use run_log::*;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use zerocopy::{FromZeros, IntoBytes};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// More than any reader needs for these logs, and less than a third of what they would otherwise keep.
const MOST_BYTES: usize = 128 << 20;

/// Bytes that an action allocates.
fn allocated<T>(act: impl FnOnce() -> T) -> (T, usize) {
    let region = Region::new(ALLOCATOR);
    let result = act();
    (result, region.change().bytes_allocated)
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &[u8]) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text].concat()
}

/// A chunk of these records, compressed.
fn chunk(records: &[u8]) -> Vec<u8> {
    let packed = zstd::encode_all(records, 1).unwrap();
    let size = (records.len() as u64).to_le_bytes();
    let crc = crc32fast::hash(records).to_le_bytes();
    let body =
        [&[0; 16][..], &size, &crc, &text(b"zstd"), &(packed.len() as u64).to_le_bytes(), &packed].concat();
    record(6, &body)
}

fn schema(id: u16, name: &[u8], data: &[u8]) -> Vec<u8> {
    record(3, &[&id.to_le_bytes()[..], &text(name), &text(b"ros2msg"), &text(data)].concat())
}

fn channel(id: u16, topic: &[u8], fact: &[u8]) -> Vec<u8> {
    let facts = if fact.is_empty() { Vec::new() } else { [text(b"units"), text(fact)].concat() };
    record(
        4,
        &[&id.to_le_bytes()[..], &1_u16.to_le_bytes(), &text(topic), &text(b"cdr"), &text(&facts)].concat(),
    )
}

/// The start of a log: everything before its first chunk.
fn start() -> Vec<u8> {
    let whole = write_log(&run_messages(0, None));
    let mut at = 8;
    while whole[at] != 6 {
        at += 9 + u64::from_le_bytes(whole[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    whole[..at].to_vec()
}

/// A log whose chunks hold these records.
fn log_of(chunks: impl Iterator<Item = Vec<u8>>) -> Vec<u8> {
    chunks.fold(start(), |log, records| [log, chunk(&records)].concat())
}

fn save_named(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    println!("{name}: {} bytes", bytes.len());
    save(folder, name, bytes)
}

/// Reads a log with every reader. Each must report the exceeded limit, and stay within its memory bound.
fn refused(bytes: &[u8], name: &str, what: &str) {
    let folder = tempfile::tempdir().unwrap();
    let (log, output) = (save_named(folder.path(), name, bytes), folder.path().join("out.mcap"));
    let (error, info_bytes) = allocated(|| {
        info(&LogFile::at(&log), ReadOptions::default()).unwrap().log_error.map(|error| error.to_string())
    });
    let (repaired, repair_bytes) = allocated(|| repair(&log, &output).map_err(|error| error.to_string()));
    println!("{name}: info {info_bytes} bytes: {error:?}; repair {repair_bytes} bytes");
    let told = |text: &Option<String>| text.as_ref().is_some_and(|text| text.contains(what));
    assert!(told(&error) || told(&repaired.err()), "{name}: {error:?}");
    assert!(
        info_bytes.max(repair_bytes) < MOST_BYTES,
        "{name}: {info_bytes} and {repair_bytes} bytes allocated"
    );
}

/// A single test, because the counter covers the whole process.
#[test]
fn a_log_of_few_bytes_makes_no_reader_keep_many() {
    const LONG: usize = 200 << 10;
    let many = |make: &dyn Fn(u16) -> Vec<u8>, count: u16| {
        let ids: Vec<u16> = (1..=count).collect();
        log_of(
            ids.chunks(40)
                .map(|ids| ids.iter().flat_map(|id| make(*id)).collect())
                .collect::<Vec<Vec<u8>>>()
                .into_iter(),
        )
    };
    let name = vec![b'x'; LONG];
    refused(&many(&|id| schema(id, &name, b""), 2000), "schema names", "bytes of a schema's name");
    refused(&many(&|id| channel(id, &name, b""), 2000), "topics", "bytes of a topic's name");
    let numbered = |id: u16| [b"a/b".to_vec(), id.to_string().into_bytes()].concat();
    refused(&many(&|id| schema(id, &numbered(id), b""), 5000), "schemas", "schemas, at most 4096");
    let declared = |id: u16| [schema(1, b"a", b""), channel(id, &numbered(id), b"")].concat();
    refused(&many(&declared, 5000), "channels", "channels, at most 4096");
    // A reader does not keep these records, but a repair rewrites them.
    refused(
        &many(&|id| schema(id, &numbered(id), &name), 2000),
        "schema texts",
        "bytes of schemas and channels",
    );
    let described = |id: u16| [schema(1, b"a", b""), channel(id, &numbered(id), &name)].concat();
    refused(&many(&described, 2000), "channel facts", "bytes of schemas and channels");
    // One channel, declared again and again under different topics.
    let renamed = |id: u16| [schema(1, b"a", b""), channel(1, &numbered(id), b"")].concat();
    refused(&many(&renamed, 5000), "topics of a channel", "channels, at most 4096");
    // Records outside the chunks are not compressed; the cost is in their many parts.
    let entries: Vec<u8> =
        (0..400_000_u32).flat_map(|n| [text(&n.to_le_bytes()), text(b"")].concat()).collect();
    let metadata = record(12, &[text(b"x"), text(&entries)].concat());
    refused(&[start(), metadata].concat(), "metadata", "a metadata record of");
    let mut attachment = [&[0; 16][..], &text(&vec![b'x'; 1 << 20]), &text(b""), &[0; 8]].concat();
    attachment.extend(crc32fast::hash(&attachment).to_le_bytes());
    refused(&[start(), record(9, &attachment)].concat(), "attachment", "overlong name");
    keyframe_of_a_gigabyte();
    index_of_many_chunks();
}

/// A keyframe is assembled from as many parts as the first one announces.
fn keyframe_of_a_gigabyte() {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let steps = run_messages(3, None);
    feed(&mut log, &steps).unwrap();
    // Each part goes into its own chunk.
    log.keep_places();
    log.close_chunk().unwrap();
    let data = vec![0; 1 << 20];
    for part in 0..400 {
        let mut head = Keyframe::new_zeroed();
        (head.tick, head.sequence) = (3, u64::from(part) + 1);
        (head.total_bytes, head.offset_bytes, head.data_length) = (1 << 30, part << 20, 1 << 20);
        log.keyframe(&[head.as_bytes(), &data].concat()).unwrap();
        log.close_chunk().unwrap();
    }
    let bytes = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1;
    let folder = tempfile::tempdir().unwrap();
    let path = save_named(folder.path(), "keyframe", &bytes);
    let (error, read_bytes) =
        allocated(|| LogReader::open(&LogFile::at(&path)).unwrap().find_map(Result::err));
    println!("keyframe: {read_bytes} bytes: {error:?}");
    assert!(matches!(error, Some(LogError::Gap { topic: Topic::Keyframe, .. })), "{error:?}");
    assert!(read_bytes < MOST_BYTES, "{read_bytes}");
}

/// An index of 200,000 chunks is kept in a fraction of its size on disk.
fn index_of_many_chunks() {
    let mut entry = vec![0; 16];
    entry.extend(99_u64.to_le_bytes());
    entry.extend(9_u64.to_le_bytes());
    entry.extend(text(&[[1_u8, 0].as_slice(), &[0; 8]].concat()));
    entry.extend([0; 8]);
    entry.extend(text(b"zstd"));
    entry.extend([0; 16]);
    let index: Vec<u8> = record(8, &entry).repeat(200_000);
    let log = [log_of([schema(1, b"a", b"")].into_iter()), record(15, &[0; 4])].concat();
    let mut footer = (log.len() as u64).to_le_bytes().to_vec();
    footer.extend((log.len() as u64 + index.len() as u64).to_le_bytes());
    let mut crc = crc32fast::Hasher::new();
    crc.update(&index);
    crc.update(&record(2, &[&footer[..], &[0; 4]].concat())[..25]);
    footer.extend(crc.finalize().to_le_bytes());
    let bytes = [log, index, record(2, &footer), mcap::MAGIC.to_vec()].concat();
    let folder = tempfile::tempdir().unwrap();
    let path = save_named(folder.path(), "index", &bytes);
    let wanted = ["/state".to_owned()];
    let (stream, read_bytes) = allocated(|| {
        MessageStream::open_topics(&LogFile::at(&path), &wanted, ReadOptions::default()).map(|_| ())
    });
    stream.unwrap();
    println!("index: {read_bytes} bytes for one of {}", bytes.len());
    assert!(read_bytes < 4 * bytes.len(), "{read_bytes} of {}", bytes.len());
}
