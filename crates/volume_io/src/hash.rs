//! The identity of a volume: SHA-256 over its geometry and voxels.

use std::convert::Infallible;

use sha2::{Digest, Sha256};
use voxel_grid::{Ct, Volume};

/// Prefix of every hash, so that another layout of the same numbers cannot collide with it.
const DOMAIN: &[u8] = b"trabecula volume v1\0";

/// A volume with its hash.
pub fn identified(volume: Volume) -> Ct {
    Ct { sha256: volume_hash(&volume), volume }
}

/// SHA-256 of a volume's geometry and voxels.
///
/// Hashed, in this order, all little-endian: the text `trabecula volume v1` and a zero byte; the dimensions
/// as three u64; spacing and origin in metres and the direction matrix (row by row) as f64 bits, with −0
/// hashed as +0; the voxels as i16, i fastest.
pub fn volume_hash(volume: &Volume) -> [u8; 32] {
    let Volume { grid, hu } = volume;
    let mut hasher = Sha256::new();
    hasher.update(DOMAIN);
    for n in grid.dims() {
        hasher.update((n as u64).to_le_bytes());
    }
    for value in grid.spacing_m().iter().chain(&grid.origin_m()).chain(grid.direction().iter().flatten()) {
        // Adding zero turns −0 into +0 and leaves every other value unchanged.
        hasher.update((value + 0.0).to_le_bytes());
    }
    // Buffered, because hashing two bytes at a time costs more than the hash itself.
    let Ok(()) = in_little_endian(hu, |bytes| {
        hasher.update(bytes);
        Ok::<(), Infallible>(())
    });
    hasher.finalize().into()
}

/// Calls `take` with the voxels as little-endian bytes, a few thousand at a time.
///
/// # Errors
/// Those of `take`.
pub(crate) fn in_little_endian<E>(hu: &[i16], mut take: impl FnMut(&[u8]) -> Result<(), E>) -> Result<(), E> {
    let mut buffer = [0_u8; 8192];
    for chunk in hu.chunks(buffer.len() / 2) {
        for (bytes, value) in buffer.chunks_exact_mut(2).zip(chunk) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
        take(&buffer[..2 * chunk.len()])?;
    }
    Ok(())
}
