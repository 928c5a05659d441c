//! The identity of a volume: SHA-256 over its geometry and voxels.

use crate::volume::Volume;
use sha2::{Digest, Sha256};

/// Prefix of every hash, so that another layout of the same numbers cannot collide with this one.
const DOMAIN: &[u8] = b"trabecula volume v1\0";

/// SHA-256 of a volume's geometry and voxels; see [`volume_hash_of_parts`].
pub fn volume_hash(volume: &Volume) -> [u8; 32] {
    volume_hash_of_parts(volume.dims, volume.spacing_m, volume.origin_m, volume.direction, &volume.hu)
}

/// SHA-256 of geometry and voxels passed separately, for a caller that holds them in shared memory.
///
/// Hashed, in this order, all little-endian: the text `trabecula volume v1` and a zero byte; `dims` as three u64; `spacing_m`, `origin_m`
/// and `direction` (row by row) as f64 bits, with −0 hashed as +0; the voxels as i16, i fastest.
pub fn volume_hash_of_parts(
    dims: [usize; 3],
    spacing_m: [f64; 3],
    origin_m: [f64; 3],
    direction: [[f64; 3]; 3],
    hu: &[i16],
) -> [u8; 32] {
    let mut hasher = Sha256::new();
    hasher.update(DOMAIN);
    for n in dims {
        hasher.update((n as u64).to_le_bytes());
    }
    for value in spacing_m.iter().chain(&origin_m).chain(direction.iter().flatten()) {
        // Adding zero turns −0 into +0 and leaves every other value unchanged.
        hasher.update((value + 0.0).to_le_bytes());
    }
    // Buffered, because hashing two bytes at a time costs more than the hash itself.
    let mut buffer = [0_u8; 8192];
    for chunk in hu.chunks(buffer.len() / 2) {
        for (bytes, value) in buffer.chunks_exact_mut(2).zip(chunk) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
        hasher.update(&buffer[..2 * chunk.len()]);
    }
    hasher.finalize().into()
}
