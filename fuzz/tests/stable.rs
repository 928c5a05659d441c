//! Runs the targets with stable Rust: on the stored corpus and on seeded mutations of the seeds.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use fastrand::Rng;
use flate2::read::GzDecoder;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use trabecula_fuzz::{TARGETS, Target};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<std::alloc::System> = &INSTRUMENTED_SYSTEM;

/// Memory limit for an input of the corpus, summed over all allocations, in bytes.
const MOST_BYTES: usize = 1 << 30;
/// Time limit for one input: a machine under load takes seconds where libFuzzer allows ten.
const LIMIT: Duration = Duration::from_secs(120);
/// Numbers at which readers tend to fail.
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

/// Runs the inputs of all targets, each with a name, and fails if one panics, takes too much memory or does
/// not finish.
fn run(inputs: impl Fn(&'static Target) -> Vec<(String, Vec<u8>)>) {
    for target in TARGETS {
        let inputs = inputs(target);
        let (done, finished) = channel();
        let names: Vec<String> = inputs.iter().map(|(name, _)| name.clone()).collect();
        // With a stack of 2 MB, as in a user's thread.
        let worker = std::thread::spawn(move || {
            for (name, data) in &inputs {
                let region = Region::new(ALLOCATOR);
                (target.run)(data);
                let bytes = region.change().bytes_allocated;
                assert!(bytes < MOST_BYTES, "{}, {name}: {bytes} bytes of memory", target.name);
                let _ = done.send(());
            }
        });
        for name in names {
            match finished.recv_timeout(LIMIT) {
                Ok(()) => {}
                Err(RecvTimeoutError::Timeout) => panic!("{}, {name}: not done in {LIMIT:?}", target.name),
                Err(RecvTimeoutError::Disconnected) => {
                    panic!("{}, {name}: the message is above", target.name)
                }
            }
        }
        worker.join().unwrap();
    }
}

/// Returns the folder of the corpus archives.
fn archives() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus")
}

/// Returns the stored inputs of a target, in the archive's order.
fn corpus(target: &Target) -> Vec<(String, Vec<u8>)> {
    let path = archives().join(format!("{}.tar.gz", target.name));
    let file = std::fs::File::open(&path).unwrap_or_else(|cause| panic!("{}: {cause}", path.display()));
    let mut archive = tar::Archive::new(GzDecoder::new(file));
    let read = |entry: std::io::Result<tar::Entry<'_, _>>| {
        let mut entry = entry.unwrap();
        let name = entry.path().unwrap().display().to_string();
        let mut data = Vec::new();
        entry.read_to_end(&mut data).unwrap();
        (name, data)
    };
    archive.entries().unwrap().map(read).collect()
}

fn mutations(target: &Target) -> Vec<(String, Vec<u8>)> {
    let seeds = (target.seeds)();
    assert!(!seeds.is_empty(), "{} has no seeds", target.name);
    let mut random = Rng::with_seed(7);
    let mut all: Vec<(String, Vec<u8>)> =
        seeds.iter().enumerate().map(|(number, seed)| (format!("seed {number}"), seed.clone())).collect();
    for number in 0..1000 {
        let seed = random.usize(..seeds.len());
        all.push((format!("mutation {number} of seed {seed}"), mutate(&seeds[seed], &mut random)));
    }
    all
}

#[test]
fn every_kept_input_ends_soon_without_a_panic_and_in_little_memory() {
    run(|target| {
        let kept = corpus(target);
        println!("{}: {} inputs", target.name, kept.len());
        assert!(!kept.is_empty(), "no corpus of {}", target.name);
        kept
    });
}

#[test]
fn every_target_takes_mutated_seeds() {
    run(mutations);
}

/// An archive without a target would never be read.
#[test]
fn every_archive_belongs_to_a_target_and_the_corpus_is_small() {
    for entry in std::fs::read_dir(archives()).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        let of_target = |target: &Target| name == format!("{}.tar.gz", target.name);
        assert!(TARGETS.iter().any(of_target), "fuzz/corpus/{name} belongs to no target");
    }
    let bytes: usize = TARGETS.iter().flat_map(corpus).map(|(_, data)| data.len()).sum();
    assert!(bytes < 2_000_000, "the corpus has {bytes} bytes");
}

/// Packing the same inputs again must not change the archive.
#[test]
fn archives_are_packed_by_name_without_times_and_owners() {
    for target in TARGETS {
        let names: Vec<String> = corpus(target).into_iter().map(|(name, _)| name).collect();
        assert!(names.is_sorted_by(|a, b| a < b), "{} is not sorted; use fuzz/run --pack", target.name);
        let path = archives().join(format!("{}.tar.gz", target.name));
        let mut archive = tar::Archive::new(GzDecoder::new(std::fs::File::open(path).unwrap()));
        for entry in archive.entries().unwrap() {
            let entry = entry.unwrap();
            let header = entry.header();
            let found = [header.mtime().unwrap(), header.uid().unwrap(), header.gid().unwrap()];
            assert_eq!(found, [0; 3], "{}, {}", target.name, entry.path().unwrap().display());
        }
    }
}
