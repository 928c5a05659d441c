//! Cache file of a volume.
//!
//! ```text
//! 16 bytes  "trabecula cache2"
//! 32        the key: everything the volume is built from
//! 16        XXH3-128 of the key and of all that follows, except the voxels
//!  8        length of the notes in bytes
//! 16        XXH3-128 of the voxels: of the XXH3-128 of each 256 KiB of them
//!           the volume's message: hash, geometry, dimensions
//!           the notes, a JSON list of texts
//!           the voxels, 16 bits each, i fastest
//! ```
//!
//! Numbers are little-endian. The volume's own SHA-256 is computed when the volume is built. It need not be
//! computed again: together, the two checksums cover it, the geometry and every voxel, and only this user can
//! write the folder.

use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::FileExt;

use ipc_types::messages::Volume as VolumeMessage;
use ipc_types::messages::layout::Message;
use volume_io::volume_hash;
use voxel_grid::{Ct, Volume};
use xxhash_rust::xxh3::xxh3_128;
use zerocopy::{FromBytes, IntoBytes};

use super::key::Key;
use super::shared_work::on_all_cores;
use crate::volume_source::VolumeWithNotes;

const MAGIC: &[u8; 16] = b"trabecula cache2";
/// Largest size of the notes: a reader writes a few lines.
const MAX_NOTES_BYTES: u64 = 1 << 20;
/// Voxels per checksum, so that several threads can read and check them while they are in a core's cache.
const PIECE_VOXELS: usize = 1 << 17;
const HEAD_BYTES: usize = 16 + 32 + 16 + 8 + 16;

/// What is wrong with a cache file.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// A link, a folder, a pipe, or another user's file.
    #[error("not a file of this user")]
    NotAFile,
    /// It cannot be read.
    #[error("cannot be read ({0})")]
    Read(io::Error),
    /// Its length does not match its header.
    #[error("wrong length: {bytes} bytes, expected {expected}")]
    Length {
        /// Its length.
        bytes: u64,
        /// The length that its header implies.
        expected: u64,
    },
    /// Its header is invalid.
    #[error("damaged: {0}")]
    Head(&'static str),
    /// Its voxels have changed.
    #[error("damaged: wrong voxel checksum")]
    Voxels,
}

/// Everything in the file before the voxels.
///
/// # Errors
/// The notes are too long.
pub(super) fn head(key: &Key, loaded: &VolumeWithNotes, voxels_sum: u128) -> io::Result<Vec<u8>> {
    let notes = serde_json::to_vec(&loaded.notes)?;
    if notes.len() as u64 > MAX_NOTES_BYTES {
        return Err(io::ErrorKind::FileTooLarge.into());
    }
    let message = VolumeMessage::of(&loaded.ct);
    let length = (notes.len() as u64).to_le_bytes();
    let below = [length.as_slice(), &voxels_sum.to_le_bytes(), message.as_bytes(), &notes].concat();
    let sum = xxh3_128(&[key.hash().as_slice(), &below].concat()).to_le_bytes();
    Ok([MAGIC.as_slice(), key.hash(), &sum, &below].concat())
}

/// Combines the checksums of the pieces into that of the voxels.
pub(super) fn sum_of(pieces: impl IntoIterator<Item = io::Result<u128>>) -> io::Result<u128> {
    let sums: Vec<[u8; 16]> =
        pieces.into_iter().map(|sum| sum.map(u128::to_le_bytes)).collect::<io::Result<_>>()?;
    Ok(xxh3_128(sums.as_flattened()))
}

/// Reads and checks a volume's cache file.
///
/// # Errors
/// The fault of the file.
pub fn read(mut file: &File, bytes: u64, key: &Key) -> Result<VolumeWithNotes, Damage> {
    let mut head = [0; HEAD_BYTES];
    let message_bytes = VolumeMessage::DESCRIPTION.size;
    let least = (HEAD_BYTES + message_bytes) as u64;
    if bytes < least {
        return Err(Damage::Length { bytes, expected: least });
    }
    file.read_exact(&mut head).map_err(Damage::Read)?;
    let (sum, below) = (&head[48..64], &head[64..]);
    let (length, voxels_sum) = below.split_at(8);
    let notes_bytes = length.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte));
    if head[..16] != *MAGIC || head[16..48] != *key.hash() || notes_bytes > MAX_NOTES_BYTES {
        return Err(Damage::Head("it belongs to another volume"));
    }
    if bytes < least + notes_bytes {
        return Err(Damage::Length { bytes, expected: least + notes_bytes });
    }
    let mut rest = vec![0; message_bytes + notes_bytes as usize];
    file.read_exact(&mut rest).map_err(Damage::Read)?;
    if xxh3_128(&[&head[16..48], below, &rest].concat()).to_le_bytes() != *sum {
        return Err(Damage::Head("wrong header checksum"));
    }
    let (message, notes) = rest.split_at(message_bytes);
    let message = VolumeMessage::read_from_bytes(message).map_err(|_| Damage::Head("it holds no volume"))?;
    let notes = serde_json::from_slice(notes).map_err(|_| Damage::Head("its notes are malformed"))?;
    let grid = message.grid().map_err(|_| Damage::Head("its grid is invalid"))?;
    if grid.voxel_count() != message.hu_length as usize {
        return Err(Damage::Head("its dimensions do not match its voxels"));
    }
    let expected = least + notes_bytes + 2 * u64::from(message.hu_length);
    if bytes != expected {
        return Err(Damage::Length { bytes, expected });
    }
    let mut hu = vec![0_i16; message.hu_length as usize];
    let sum = read_pieces(file, least + notes_bytes, &mut hu).map_err(Damage::Read)?;
    if sum.to_le_bytes() != *voxels_sum {
        return Err(Damage::Voxels);
    }
    Ok(VolumeWithNotes { ct: Ct { volume: Volume { grid, hu }, sha256: message.sha256 }, notes })
}

/// Reads the voxels from `start`; returns their checksum.
fn read_pieces(file: &File, start: u64, hu: &mut [i16]) -> io::Result<u128> {
    let starts = (start..).step_by(2 * PIECE_VOXELS);
    sum_of(on_all_cores(hu.chunks_mut(PIECE_VOXELS).zip(starts), |(piece, start)| {
        file.read_exact_at(piece.as_mut_bytes(), start)?;
        Ok(xxh3_128(piece.as_bytes()))
    }))
}

/// Writes the voxels from `start`; returns their checksum.
fn write_pieces(file: &File, start: u64, hu: &[i16]) -> io::Result<u128> {
    let starts = (start..).step_by(2 * PIECE_VOXELS);
    sum_of(hu.chunks(PIECE_VOXELS).zip(starts).map(|(piece, start)| {
        file.write_all_at(piece.as_bytes(), start)?;
        Ok(xxh3_128(piece.as_bytes()))
    }))
}

/// Lets `write` write a volume's file (it gets the file's length), while a second thread hashes the volume.
/// Returns the volume with its hash, whether or not the file could be written.
pub fn write_and_hash(
    key: &Key,
    volume: Volume,
    notes: Vec<String>,
    write: impl FnOnce(u64, &mut dyn FnMut(&File) -> io::Result<()>) -> io::Result<()>,
) -> VolumeWithNotes {
    let mut loaded = VolumeWithNotes { ct: Ct { volume, sha256: [0; 32] }, notes };
    let mut hash = None;
    if let Ok(head_bytes) = head(key, &loaded, 0).map(|head| head.len() as u64) {
        // A failed write costs only time.
        let _ = write(head_bytes + 2 * loaded.ct.volume.hu.len() as u64, &mut |file| {
            let voxels = &loaded.ct.volume;
            let voxels_sum = std::thread::scope(|scope| {
                let hashing = std::thread::Builder::new().spawn_scoped(scope, || volume_hash(voxels));
                let voxels_sum = write_pieces(file, head_bytes, &voxels.hu);
                // Without a thread it is hashed below.
                hash = hashing.ok().and_then(|hashing| hashing.join().ok());
                voxels_sum
            })?;
            loaded.ct.sha256 = *hash.get_or_insert_with(|| volume_hash(voxels));
            file.write_all_at(&head(key, &loaded, voxels_sum)?, 0)
        });
    }
    loaded.ct.sha256 = hash.unwrap_or_else(|| volume_hash(&loaded.ct.volume));
    loaded
}
