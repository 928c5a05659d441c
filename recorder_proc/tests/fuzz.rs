//! The fuzz targets of `recorder_proc/fuzz`, run with stable Rust over seeded mutations of a small corpus.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod common;
#[path = "../fuzz/src/targets.rs"]
mod targets;

use common::*;
use fastrand::Rng;

/// Numbers at which readers go wrong.
const EDGES: [u64; 8] = [0, 1, 0xff, 0x7fff_ffff, 0xffff_ffff, 1 << 40, u64::MAX - 8, u64::MAX];

fn mutate(seed: &[u8], random: &mut Rng) -> Vec<u8> {
    let mut data = seed.to_vec();
    for _ in 0..1 + random.usize(..8) {
        if data.is_empty() {
            data.push(random.u8(..));
        }
        let at = random.usize(..data.len());
        match random.usize(..7) {
            0 => data[at] ^= 1 << random.usize(..8),
            1 => data[at] = random.u8(..),
            2 => data.truncate(at),
            3 => {
                let end = (at + random.usize(..64)).min(data.len());
                data.drain(at..end);
            }
            4 => {
                let from = random.usize(..data.len());
                let piece = data[from..(from + random.usize(..200)).min(data.len())].to_vec();
                data.splice(at..at, piece);
            }
            5 => {
                let width = [1, 2, 4, 8][random.usize(..4)].min(data.len() - at);
                let edge = EDGES[random.usize(..EDGES.len())].to_le_bytes();
                data[at..at + width].copy_from_slice(&edge[..width]);
            }
            _ => {
                let noise: Vec<u8> = (0..random.usize(..16)).map(|_| random.u8(..)).collect();
                data.splice(at..at, noise);
            }
        }
    }
    data
}

fn run(target: fn(&[u8]), corpus: &[Vec<u8>], executions: usize, seed: u64) {
    let mut random = Rng::with_seed(seed);
    corpus.iter().for_each(|data| target(data));
    for _ in 0..executions {
        let data = mutate(&corpus[random.usize(..corpus.len())], &mut random);
        target(&data);
    }
}

fn logs() -> Vec<Vec<u8>> {
    [(3, None), (25, Some(12)), (130, None)]
        .map(|(ticks, reset)| write_log(&run_messages(ticks, reset)))
        .to_vec()
}

/// The records of the chunks of a log, unpacked.
fn chunks() -> Vec<Vec<u8>> {
    let bytes = write_log(&run_messages(30, Some(9)));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let unpack = |index: &mcap::records::ChunkIndex| {
        let start = index.chunk_start_offset as usize + 9;
        let record = mcap::parse_record(6, &bytes[start..start + index.chunk_length as usize - 9]).unwrap();
        let mcap::records::Record::Chunk { header, data } = record else { panic!("a chunk") };
        let mut out = Vec::with_capacity(header.uncompressed_size as usize);
        std::io::Read::read_to_end(&mut lz4::Decoder::new(&data[..]).unwrap(), &mut out).unwrap();
        out
    };
    summary.chunk_indexes.iter().map(unpack).collect()
}

#[test]
fn the_log_reader_takes_any_bytes() {
    run(targets::log_reader, &logs(), 2000, 1);
}

#[test]
fn the_log_reader_takes_any_records_behind_a_right_checksum() {
    let all: Vec<u8> = chunks().concat();
    // The content as it is reads as a log.
    run(targets::chunk_content, &[all, chunks()[0].clone()], 2000, 2);
}

#[test]
fn the_repair_takes_any_bytes() {
    run(targets::log_repair, &logs(), 2000, 3);
}

#[test]
fn the_scene_reader_takes_any_text() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs");
    let scenes: Vec<Vec<u8>> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file())
        .map(|path| std::fs::read(path).unwrap())
        .collect();
    assert!(!scenes.is_empty());
    run(targets::scene, &scenes, 3000, 4);
}
