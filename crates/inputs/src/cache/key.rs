//! What a volume is made of, as one hash.

use std::fmt::Debug;
use std::fs::{File, Metadata};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use recorder_proc::build_info;
use sha2::{Digest, Sha256};
use volume_io::{ReadOptions, sources};

use super::ENDING;
use super::shared_work::on_all_cores;

/// Bytes of a file that are hashed by one thread.
const PIECE_BYTES: u64 = 1 << 20;

/// The hash of all that a volume is made of. Files are hashed whole: a file's time, size and number can stay
/// the same while its content changes, and a file that was moved or downloaded again is still the same CT.
/// SHA-256, because files come from anywhere: with a weaker hash somebody could make two that share their
/// place in the cache.
#[derive(Debug, Clone)]
pub struct Key {
    hash: [u8; 32],
    /// The files that were hashed, as they were then.
    files: Vec<(PathBuf, Stamp)>,
}

/// What tells whether a file has changed since it was opened a moment ago.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stamp {
    device: u64,
    inode: u64,
    bytes: u64,
    changed: (i64, i64),
}

impl From<&Metadata> for Stamp {
    fn from(found: &Metadata) -> Stamp {
        Stamp {
            device: found.dev(),
            inode: found.ino(),
            bytes: found.len(),
            changed: (found.ctime(), found.ctime_nsec()),
        }
    }
}

/// Begins a hash: with the kind of what is kept and the build, whose sources decide what becomes of the rest.
pub(super) fn begin(kind: &str) -> Sha256 {
    let build = build_info::current();
    let mut hasher = Sha256::new();
    for part in
        ["trabecula cache 2", kind, &build.version, &build.target, build.rustc.as_deref().unwrap_or("")]
    {
        add(&mut hasher, part.as_bytes());
    }
    hasher
}

/// Adds a part, with its length before it.
pub(super) fn add(hasher: &mut Sha256, part: &[u8]) {
    hasher.update((part.len() as u64).to_le_bytes());
    hasher.update(part);
}

impl Key {
    /// A synthetic volume: its kind, and all its parameters.
    pub fn of_phantom(kind: &str, specification: &impl Debug) -> Key {
        let mut hasher = begin(kind);
        // Rust prints the shortest text that is read back as the same number.
        add(&mut hasher, format!("{specification:?}").as_bytes());
        Key { hash: hasher.finalize().into(), files: Vec::new() }
    }

    /// A volume of files: their content, how they are read, and what is done to them then. None for a file
    /// that is read as fast as it is hashed, one that cannot be read (the reader says why), and one that
    /// names others.
    pub fn of_file(path: &Path, options: &ReadOptions, treatment: &str) -> Option<Key> {
        let found = sources(path, options).ok().flatten()?;
        if !found.are_encoded && treatment.is_empty() {
            return None;
        }
        let mut hasher = begin("files");
        add(&mut hasher, format!("{options:?}").as_bytes());
        add(&mut hasher, treatment.as_bytes());
        found.names.iter().for_each(|name| add(&mut hasher, name.as_bytes()));
        let mut files = Vec::new();
        for file in found.files {
            let (hash, stamp) = content(&file)?;
            add(&mut hasher, &hash);
            files.push((file, stamp));
        }
        Some(Key { hash: hasher.finalize().into(), files })
    }

    /// Whether the files are still those that were hashed.
    pub(super) fn is_current(&self) -> bool {
        let is_same = |(file, stamp): &(PathBuf, Stamp)| {
            file.metadata().is_ok_and(|found| Stamp::from(&found) == *stamp)
        };
        self.files.iter().all(is_same)
    }

    pub(super) fn hash(&self) -> &[u8; 32] {
        &self.hash
    }

    pub(super) fn name(&self) -> String {
        HEXLOWER.encode(&self.hash) + ENDING
    }
}

/// The SHA-256 of the SHA-256 of each [`PIECE_BYTES`] of a file, which all cores can compute, and of its
/// length. None for what is no file, and for one that says no length, as those of `/proc`: its end shows only
/// while it is read.
fn content(path: &Path) -> Option<([u8; 32], Stamp)> {
    let file = File::open(path).ok()?;
    let found = file.metadata().ok()?;
    let bytes = found.len();
    if !found.is_file() || bytes == 0 {
        return None;
    }
    let hash_piece = |start: u64| {
        let mut piece = vec![0; PIECE_BYTES.min(bytes - start) as usize];
        file.read_exact_at(&mut piece, start).ok()?;
        Some(Sha256::digest(&piece))
    };
    let pieces = on_all_cores((0..bytes).step_by(PIECE_BYTES as usize), hash_piece);
    let mut hasher = Sha256::new();
    hasher.update(bytes.to_le_bytes());
    for piece in pieces {
        hasher.update(piece?);
    }
    Some((hasher.finalize().into(), Stamp::from(&found)))
}
