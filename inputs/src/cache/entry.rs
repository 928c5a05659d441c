//! A volume as a file of the cache.
//!
//! ```text
//! 16 bytes  "trabecula cache1"
//! 32        the key: what the volume is made of
//! 16        XXH3-128 of the key, the two parts below it and their lengths
//!  8        bytes of the notes
//!           the volume's message: hash, geometry, dimensions
//!           the notes, a JSON list of texts
//!           the voxels, 16 bits each, i fastest
//! ```
//!
//! Numbers are little-endian. The voxels are checked with the volume's own SHA-256, which is computed anew and covers its geometry too: the
//! hash that goes into a log is always that of the voxels that are published.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::unix::fs::FileExt;
use std::sync::mpsc::channel;

use ipc_types::layout::Message;
use ipc_types::messages::Volume as VolumeMessage;
use volume_io::{Volume, VolumeHasher, volume_hash};
use xxhash_rust::xxh3::xxh3_128;
use zerocopy::{FromBytes, IntoBytes};

use super::Made;
use super::key::Key;
use crate::volume_source;

const MAGIC: &[u8; 16] = b"trabecula cache1";
/// Most bytes of notes: a reader makes a few lines.
const MAX_NOTES_BYTES: u64 = 1 << 20;
/// Voxels that are read before the next ones are hashed beside them.
const PIECE_VOXELS: usize = 1 << 20;
const HEAD_BYTES: usize = 16 + 32 + 16 + 8;

/// What is wrong with a file of the cache.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// A link, a folder, a pipe, or another user's.
    #[error("not a file of this user")]
    NotAFile,
    /// It cannot be read.
    #[error("cannot be read ({0})")]
    Read(io::Error),
    /// Its length is not what it says.
    #[error("it has {bytes} bytes, expected {expected}")]
    Length {
        /// Its length.
        bytes: u64,
        /// The length that follows from its head.
        expected: u64,
    },
    /// Its head is none.
    #[error("damaged: {0}")]
    Head(&'static str),
    /// Its voxels are not those that were kept.
    #[error("damaged: its voxels have another hash")]
    Voxels,
}

/// A volume, ready to be written.
pub struct Kept<'a> {
    head: Vec<u8>,
    volume: &'a Volume,
}

impl Kept<'_> {
    /// The file of a volume.
    ///
    /// # Errors
    /// Its notes are too long.
    pub fn of<'a>(key: &Key, made: &'a Made) -> io::Result<Kept<'a>> {
        let notes = serde_json::to_vec(&made.notes)?;
        if notes.len() as u64 > MAX_NOTES_BYTES {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        let message = volume_source::message(&made.volume, made.sha256);
        let length = (notes.len() as u64).to_le_bytes();
        let checked = [key.hash().as_slice(), &length, message.as_bytes(), &notes].concat();
        let sum = xxh3_128(&checked).to_le_bytes();
        let head = [MAGIC.as_slice(), key.hash(), &sum, &checked[32..]].concat();
        Ok(Kept { head, volume: &made.volume })
    }

    /// Its length.
    pub fn bytes(&self) -> u64 {
        (self.head.len() + 2 * self.volume.hu.len()) as u64
    }

    /// Writes it.
    ///
    /// # Errors
    /// The system's.
    pub fn write(&self, file: &mut impl Write) -> io::Result<()> {
        file.write_all(&self.head)?;
        file.write_all(self.volume.hu.as_bytes())
    }
}

/// Reads and checks the file of a volume.
///
/// # Errors
/// What is wrong with it.
pub fn read(mut file: &File, bytes: u64, key: &Key) -> Result<Made, Damage> {
    let mut head = [0; HEAD_BYTES];
    let message_bytes = VolumeMessage::DESCRIPTION.size;
    let least = (HEAD_BYTES + message_bytes) as u64;
    if bytes < least {
        return Err(Damage::Length { bytes, expected: least });
    }
    file.read_exact(&mut head).map_err(Damage::Read)?;
    let (sum, length) = (&head[48..64], &head[64..]);
    let notes_bytes = length.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte));
    if head[..16] != *MAGIC || head[16..48] != *key.hash() || notes_bytes > MAX_NOTES_BYTES {
        return Err(Damage::Head("it is another file"));
    }
    if bytes < least + notes_bytes {
        return Err(Damage::Length { bytes, expected: least + notes_bytes });
    }
    let mut rest = vec![0; message_bytes + notes_bytes as usize];
    file.read_exact(&mut rest).map_err(Damage::Read)?;
    if xxh3_128(&[&head[16..48], length, &rest].concat()).to_le_bytes() != *sum {
        return Err(Damage::Head("its head has another checksum"));
    }
    let (message, notes) = rest.split_at(message_bytes);
    let message = VolumeMessage::read_from_bytes(message).map_err(|_| Damage::Head("it holds no volume"))?;
    let notes = serde_json::from_slice(notes).map_err(|_| Damage::Head("its notes are no list of texts"))?;
    let dims = message.dimensions.map(|n| n as usize);
    let count = dims.iter().try_fold(1_usize, |count, n| count.checked_mul(*n));
    if count != Some(message.hu_length as usize) {
        return Err(Damage::Head("its dimensions do not give its voxels"));
    }
    let expected = least + notes_bytes + 2 * u64::from(message.hu_length);
    if bytes != expected {
        return Err(Damage::Length { bytes, expected });
    }
    // Row by row; the message holds axis by axis.
    let direction = [0, 1, 2].map(|row| [0, 1, 2].map(|axis| message.direction[3 * axis + row]));
    let (spacing_m, origin_m) = (message.spacing_m, message.origin_m);
    let mut hu = vec![0_i16; message.hu_length as usize];
    let hasher = VolumeHasher::new(dims, spacing_m, origin_m, direction);
    if read_and_hash(file, &mut hu, hasher).map_err(Damage::Read)? != Some(message.sha256) {
        return Err(Damage::Voxels);
    }
    let volume = Volume { dims, spacing_m, origin_m, direction, hu };
    Ok(Made { volume, sha256: message.sha256, notes })
}

/// Reads voxels, and hashes in a second thread those that are there. No hash if that thread died.
fn read_and_hash(mut file: &File, hu: &mut [i16], mut hasher: VolumeHasher) -> io::Result<Option<[u8; 32]>> {
    std::thread::scope(|scope| {
        let (pieces, arrived) = channel::<&[i16]>();
        let hashing = scope.spawn(move || {
            arrived.iter().for_each(|piece| hasher.update(piece));
            hasher.finish()
        });
        for piece in hu.chunks_mut(PIECE_VOXELS) {
            file.read_exact(piece.as_mut_bytes())?;
            // Fails only if the thread has died, which its end tells.
            let _ = pieces.send(piece);
        }
        drop(pieces);
        Ok(hashing.join().ok())
    })
}

/// Writes the file of a volume, and hashes the volume in a second thread meanwhile. Returns what is kept, whether it could be written or not.
pub fn write_and_hash(
    key: &Key,
    volume: Volume,
    notes: Vec<String>,
    write: impl FnOnce(u64, &mut dyn FnMut(&File) -> io::Result<()>) -> io::Result<()>,
) -> Made {
    let mut made = Made { volume, sha256: [0; 32], notes };
    let mut hash = None;
    let outcome = Kept::of(key, &made).map(|kept| (kept.head.len() as u64, kept.bytes()));
    if let Ok((head_bytes, bytes)) = outcome {
        // A file that cannot be written costs time only.
        let _ = write(bytes, &mut |file| {
            let voxels = &made.volume;
            let written = std::thread::scope(|scope| {
                let hashing = scope.spawn(|| volume_hash(voxels));
                let written = file.write_all_at(voxels.hu.as_bytes(), head_bytes);
                hash = hashing.join().ok();
                written
            });
            written?;
            made.sha256 = hash.ok_or(io::ErrorKind::Other)?;
            file.write_all_at(&Kept::of(key, &made)?.head, 0)
        });
    }
    made.sha256 = hash.unwrap_or_else(|| volume_hash(&made.volume));
    made
}
