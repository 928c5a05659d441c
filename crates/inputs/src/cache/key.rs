//! Cache keys: everything a volume is built from, as one hash.

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

/// Bytes of a file that one thread hashes at a time.
const PIECE_BYTES: u64 = 1 << 20;

/// Hash of everything a volume is built from. Files are hashed whole: time, size and inode can stay the same
/// while the content changes, and a file that was moved or downloaded again is still the same CT. SHA-256,
/// because files come from anywhere: with a weaker hash, two files could be crafted to share a cache entry.
#[derive(Debug, Clone)]
pub struct Key {
    hash: [u8; 32],
    /// The hashed files, as they were then.
    files: Vec<(PathBuf, Stamp)>,
}

/// Detects whether a file has changed since it was opened.
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

/// Begins a hash with the kind of entry and the build, whose sources determine the result.
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

/// Adds a part, prefixed by its length.
pub(super) fn add(hasher: &mut Sha256, part: &[u8]) {
    hasher.update((part.len() as u64).to_le_bytes());
    hasher.update(part);
}

impl Key {
    /// Key of a synthetic volume: its kind, and all its parameters.
    pub fn of_phantom(kind: &str, specification: &impl Debug) -> Key {
        let mut hasher = begin(kind);
        // Rust prints the shortest text that parses back to the same number.
        add(&mut hasher, format!("{specification:?}").as_bytes());
        Key { hash: hasher.finalize().into(), files: Vec::new() }
    }

    /// Key of a volume from files: their content, the read options, and the processing afterwards. `None` for
    /// a file that is read as fast as it is hashed, one that cannot be read (the reader reports why), and one
    /// that refers to other files.
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

    /// Whether the files are unchanged since they were hashed.
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

/// SHA-256 over the SHA-256 of each [`PIECE_BYTES`] of a file, which all cores can compute in parallel, and
/// over its length. `None` for anything but a regular file, and for files without a length, as in `/proc`.
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
