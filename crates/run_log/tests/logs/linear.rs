//! Commands that derive logs from logs take time proportional to the log, however many chunks it has.
//! Regression: 300,000 chunks took over 40 s.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;
use std::rc::Rc;

use crate::common::*;
use messages::{FrameTiming, Tick};
use run_log::*;
use zerocopy::{FromZeros, IntoBytes};

/// A source that counts the bytes read from it.
struct Counted {
    source: Cursor<Vec<u8>>,
    bytes: Rc<Cell<u64>>,
}

impl Read for Counted {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let read = self.source.read(out)?;
        self.bytes.set(self.bytes.get() + read as u64);
        Ok(read)
    }
}

impl Seek for Counted {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.source.seek(to)
    }
}

/// Returns the bytes that a repair reads, as a multiple of the log's size.
fn read_by_repair(log: Vec<u8>) -> f64 {
    let (length, bytes) = (log.len() as f64, Rc::new(Cell::new(0)));
    let source = Counted { source: Cursor::new(log), bytes: Rc::clone(&bytes) };
    repair::survey(source, Path::new("log.mcap")).unwrap();
    bytes.get() as f64 / length
}

/// A timing lane with one chunk per message.
fn many_chunks(chunks: u64) -> Vec<u8> {
    let mut log = TimingLog::create(Vec::new(), &header()).unwrap();
    let timing = FrameTiming::new_zeroed();
    for chunk in 0..chunks {
        log.message(Topic::FrameTiming, Tick(chunk), timing.as_bytes()).unwrap();
        log.flush().unwrap();
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap().1
}

/// Counts bytes rather than time, which other load on the machine would affect. Each byte is read once, or as
/// often as the buffers overlap.
#[test]
fn a_log_of_many_chunks_is_read_once_and_not_once_a_chunk() {
    for chunks in [1000, 20_000] {
        let whole = many_chunks(chunks);
        let times = read_by_repair(whole.clone());
        println!("{chunks} chunks, {} bytes: read {times:.2} times", whole.len());
        assert!(times < 2.0, "{times}");
        // The search starts after the damage, not at the start of the file.
        let mut changed = whole.clone();
        (0..40).for_each(|n| changed[(n + 1) * (whole.len() / 50)] ^= 0x55);
        let times = read_by_repair(changed);
        println!("  with 40 damaged places: read {times:.2} times");
        assert!(times < 25.0, "{times}");
    }
}

/// An untrusted file may contain something like the start of a chunk every few bytes, each of which would be
/// unpacked.
#[test]
fn what_looks_like_chunks_everywhere_is_given_up() {
    let mut log = many_chunks(1);
    let at = log.len() - 40;
    log.truncate(at);
    let room = 600_000_usize;
    // Uncompressed chunks that extend to the end of the file, with a wrong checksum.
    while log.len() < at + room {
        let records = (at + room - log.len()) as u64;
        let mut head = vec![6];
        head.extend((records + 40).to_le_bytes());
        head.extend([0; 16]);
        head.extend(records.to_le_bytes());
        head.extend([1, 2, 3, 4]);
        head.extend(0_u32.to_le_bytes());
        head.extend(records.to_le_bytes());
        log.extend(head);
    }
    let length = log.len() as f64;
    let bytes = read_by_repair(log) * length;
    println!("{bytes:.2e} bytes read of {length}");
    // Reading to the end each time would take 3e9 bytes.
    assert!(bytes < 3e8, "{bytes:.2e}");
}
