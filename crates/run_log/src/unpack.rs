//! Unpacks chunks.

use std::io::{self, ErrorKind, Read};

use mcap::records::ChunkHeader;

use crate::records::MAX_RECORD_BYTES;

/// Largest ratio at which a chunk is unpacked in one piece. A chunk that claims more is unpacked piece by
/// piece, so that it takes no memory before it has proved that it needs it. LZ4 reaches 255.
const LARGEST_RATIO: u64 = 256;

/// Unpacks a chunk and checks its CRC before any of its records is read; 0 means "not computed" (MCAP
/// specification, "Chunk").
pub(crate) fn unpack(header: &ChunkHeader, data: &[u8], out: &mut Vec<u8>) -> Result<(), String> {
    let size = header.uncompressed_size;
    if size > MAX_RECORD_BYTES {
        return Err(format!("a chunk of {size} bytes unpacked, expected at most {MAX_RECORD_BYTES}"));
    }
    let is_plausible = size <= LARGEST_RATIO.saturating_mul(data.len() as u64);
    let cannot = |error: io::Error| format!("cannot decompress a chunk: {error}");
    match header.compression.as_str() {
        "" => {
            out.clear();
            out.extend_from_slice(data);
        }
        "lz4" => {
            let decoder = lz4::Decoder::new(data).map_err(cannot)?;
            unpack_with(decoder, size, is_plausible, out).map_err(cannot)?;
        }
        "zstd" => {
            let decoder = zstd::Decoder::new(data).map_err(cannot)?;
            unpack_with(decoder, size, is_plausible, out).map_err(cannot)?;
        }
        other => return Err(format!("unsupported chunk compression '{other}'; expected lz4, zstd or none")),
    }
    if out.len() as u64 != size {
        return Err(format!("a chunk of {} bytes unpacked, its header says {size}", out.len()));
    }
    let calculated = crc32fast::hash(out);
    if header.uncompressed_crc != 0 && calculated != header.uncompressed_crc {
        return Err(format!(
            "CRC of a chunk is {calculated:08x}, its header says {:08x}",
            header.uncompressed_crc
        ));
    }
    Ok(())
}

/// Unpacks `size` bytes, or one more if there are more. If unpacked in one piece, the decoder writes directly
/// to the destination, not to its own memory first.
fn unpack_with(mut decoder: impl Read, size: u64, in_one_piece: bool, out: &mut Vec<u8>) -> io::Result<()> {
    if !in_one_piece {
        out.clear();
        return decoder.take(size + 1).read_to_end(out).map(|_| ());
    }
    out.resize(size as usize, 0);
    let found = read_full(&mut decoder, out)?;
    out.truncate(found);
    // The decoder checks its own checksum only when asked for more.
    let mut more = [0];
    if found as u64 == size && read_full(&mut decoder, &mut more)? > 0 {
        out.extend_from_slice(&more);
    }
    Ok(())
}

/// Reads until the buffer is full or the source ends; returns the number of bytes.
pub(crate) fn read_full(source: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut found = 0;
    while found < buffer.len() {
        match source.read(&mut buffer[found..]) {
            Ok(0) => break,
            Ok(count) => found += count,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(found)
}
