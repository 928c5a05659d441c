//! Competing load on the hub's cores: processes of this program that only cause load.
//!
//! They never outlive the test: the kernel sends them SIGTERM, which they do not catch, when their parent
//! dies; dropping their guard kills them; and each ends on its own after its limit.

use std::io::{Seek, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fastrand::Rng;
use ipc_types::process::{bind_to_parent, end_with_parent};

use super::plan::{Load, LoadKind};
use crate::failure::Failure;

/// Memory that a memory load touches, in words of 8 bytes.
const MEMORY_WORDS: usize = 8 << 20;
/// Size at which a disk load starts over at the beginning of its file.
const DISK_BYTES: u64 = 128 << 20;
const DISK_WRITE_BYTES: usize = 1 << 20;
/// Number of steps between clock reads.
const STEPS: usize = 1 << 16;

/// Competing processes that run until this is dropped.
#[derive(Debug, Default)]
pub struct Loads(Vec<Child>);

impl Loads {
    /// Starts the processes, each with its own seed, on this thread's cores. A disk load writes below
    /// `folder`.
    pub fn start(load: Load, seed: u64, folder: &Path, limit: Duration) -> std::io::Result<Loads> {
        let program = std::env::current_exe()?;
        let mut loads = Loads::default();
        let mut random = Rng::with_seed(seed);
        for _ in 0..load.count {
            let Some(kind) = load.kind else { break };
            let mut command = Command::new(&program);
            command.arg("load").arg(kind.name()).arg("--seed").arg(random.u64(..).to_string());
            command.arg("--folder").arg(folder).arg("--limit-s").arg(limit.as_secs().to_string());
            let command = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            loads.0.push(bind_to_parent(command).spawn()?);
        }
        Ok(loads)
    }
}

impl Drop for Loads {
    fn drop(&mut self) {
        for child in &mut self.0 {
            // It may already have ended.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Causes load until killed, or for `limit`.
pub fn disturb(kind: LoadKind, seed: u64, folder: &Path, limit: Duration) -> Result<(), Failure> {
    end_with_parent();
    let failed = |cause: std::io::Error| Failure::failed(format!("load {}: {cause}", kind.name()));
    let end = Instant::now() + limit;
    let mut random = Rng::with_seed(seed);
    match kind {
        LoadKind::Spin => {
            while Instant::now() < end {
                (0..STEPS).for_each(|_| {
                    std::hint::black_box(random.u64(..));
                });
            }
        }
        LoadKind::Memory => {
            let mut words = vec![seed; MEMORY_WORDS];
            while Instant::now() < end {
                for _ in 0..STEPS {
                    let word = random.u64(..);
                    words[word as usize % MEMORY_WORDS] ^= word;
                }
            }
            std::hint::black_box(&words);
        }
        LoadKind::Disk => disturb_disk(&mut random, folder, end).map_err(failed)?,
        LoadKind::Fork => {
            let program = std::env::current_exe().map_err(failed)?;
            while Instant::now() < end {
                let mut command = Command::new(&program);
                command.arg("--version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
                bind_to_parent(&mut command).status().map_err(failed)?;
            }
        }
    }
    Ok(())
}

fn disturb_disk(random: &mut Rng, folder: &Path, end: Instant) -> std::io::Result<()> {
    // The file is unnamed, so nothing is left behind.
    let mut file = tempfile::tempfile_in(folder)?;
    let mut bytes = vec![0_u8; DISK_WRITE_BYTES];
    let mut written = 0;
    while Instant::now() < end {
        random.fill(&mut bytes);
        let length = random.usize(4096..DISK_WRITE_BYTES);
        file.write_all(&bytes[..length])?;
        file.sync_data()?;
        written += length as u64;
        if written > DISK_BYTES {
            file.rewind()?;
            written = 0;
        }
    }
    Ok(())
}
