//! Unpacks chunks.

use std::io::Read;

use mcap::records::ChunkHeader;

use crate::records::MAX_RECORD_BYTES;

/// Unpacks a chunk and checks its CRC before any of its records is read; 0 is "not computed" (MCAP specification, "Chunk").
pub(crate) fn unpack(header: &ChunkHeader, data: &[u8], out: &mut Vec<u8>) -> Result<(), String> {
    let size = header.uncompressed_size;
    if size > MAX_RECORD_BYTES {
        return Err(format!("a chunk of {size} bytes unpacked, expected at most {MAX_RECORD_BYTES}"));
    }
    out.clear();
    match header.compression.as_str() {
        "" => out.extend_from_slice(data),
        "lz4" => {
            let decoder =
                lz4::Decoder::new(data).map_err(|error| format!("cannot unpack a chunk: {error}"))?;
            let unpacked = decoder.take(size + 1).read_to_end(out);
            unpacked.map_err(|error| format!("cannot unpack a chunk: {error}"))?;
        }
        "zstd" => {
            let decoder =
                zstd::Decoder::new(data).map_err(|error| format!("cannot unpack a chunk: {error}"))?;
            let unpacked = decoder.take(size + 1).read_to_end(out);
            unpacked.map_err(|error| format!("cannot unpack a chunk: {error}"))?;
        }
        other => return Err(format!("a chunk packed with '{other}', expected lz4, zstd or nothing")),
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
