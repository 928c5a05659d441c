//! Why the `mcap` crate's writer is not used: its memory grows with the file, that of ours does not.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod common;
use std::alloc::System;
use std::collections::BTreeMap;
use std::io::{Read, Seek, SeekFrom, Write};

use common::*;
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, WriteOptions};
use messages::{Tick, TickTiming};
use run_log::*;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use zerocopy::IntoBytes;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Ticks per simulated minute at 1 kHz; the timing lane closes a chunk every 100 of them.
const MINUTE: u64 = 60_000;
const CHUNK: u64 = 100;

/// An index stored outside the heap.
struct Elsewhere;

impl Write for Elsewhere {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        Ok(bytes.len())
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Read for Elsewhere {
    fn read(&mut self, _: &mut [u8]) -> std::io::Result<usize> {
        Ok(0)
    }
}

impl Seek for Elsewhere {
    fn seek(&mut self, _: SeekFrom) -> std::io::Result<u64> {
        Ok(0)
    }
}

/// Heap growth from the first to the fourth simulated minute, bytes per minute.
fn growth_per_minute(mut write: impl FnMut(u64)) -> isize {
    (0..MINUTE).for_each(&mut write);
    let region = Region::new(ALLOCATOR);
    (MINUTE..4 * MINUTE).for_each(&mut write);
    let change = region.change();
    (change.bytes_allocated as isize - change.bytes_deallocated as isize) / 3
}

#[test]
fn the_crates_writer_grows_with_the_file_and_this_one_does_not() {
    let timing = TickTiming::zeroed();
    let index = Box::new(Elsewhere);
    let path = std::path::Path::new("timing.mcap");
    let mut own = TimingLog::create_named(std::io::sink(), path, index, &header()).unwrap();
    let own_growth = growth_per_minute(|tick| {
        own.message(Topic::TickTiming, Tick(tick), timing.as_bytes()).unwrap();
    });

    let options =
        WriteOptions::new().chunk_size(None).disable_seeking(true).compression(Some(Compression::Lz4));
    let mut crates = options.create(NoSeek::new(std::io::sink())).unwrap();
    let schema = crates.add_schema("A", "ros2msg", b"text").unwrap();
    let channel_id = crates.add_channel(schema, "/timing/tick", "cdr", &BTreeMap::new()).unwrap();
    let crates_growth = growth_per_minute(|tick| {
        let time = tick * 1_000_000;
        let header = MessageHeader { channel_id, sequence: tick as u32, log_time: time, publish_time: time };
        crates.write_to_known_channel(&header, timing.as_bytes()).unwrap();
        if tick % CHUNK == CHUNK - 1 {
            crates.flush().unwrap();
        }
    });
    println!("bytes a minute: {own_growth} of this writer, {crates_growth} of the crate's");
    // A buffer may grow once more; 600 chunk indexes of more than 100 bytes each would exceed this.
    assert!(own_growth.abs() < 8 << 10, "{own_growth}");
    assert!(crates_growth > 60_000, "{crates_growth}");
}
