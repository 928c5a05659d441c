//! Reads ZIP archives (APPNOTE 6.3): stored and deflated entries. Every length is checked before it is used.

use std::io::Read as _;

use flate2::read::DeflateDecoder;

use super::{MOST_BYTES, MOST_TOTAL_BYTES, malformed};
use crate::error::FmuError;

/// A file in an archive.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    /// Relative path with `/`, without `..`.
    pub name: String,
    /// Size when unpacked.
    pub size: u64,
    method: u16,
    crc: u32,
    start: usize,
    packed: usize,
}

/// Size of the record at the end of an archive, without its comment.
const END: usize = 22;
/// Size of a file's record in the directory, without its texts.
const RECORD: usize = 46;
/// Size of the header before a file's bytes, without its texts.
const HEADER: usize = 30;

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

/// Lists the files of an archive.
pub(super) fn entries(bytes: &[u8]) -> Result<Vec<Entry>, FmuError> {
    let truncated = || malformed("not a ZIP archive, or truncated");
    let last = bytes.len().checked_sub(END).ok_or_else(truncated)?;
    let first = last.saturating_sub(usize::from(u16::MAX));
    let end =
        (first..=last).rev().find(|at| bytes[*at..].starts_with(b"PK\x05\x06")).ok_or_else(truncated)?;
    let count = u16_at(bytes, end + 10).ok_or_else(truncated)?;
    let mut at = u32_at(bytes, end + 16).ok_or_else(truncated)? as usize;
    let (mut found, mut total) = (Vec::new(), 0);
    for _ in 0..count {
        let (entry, next) = record(bytes, at).ok_or_else(truncated)??;
        total += entry.size;
        if total > MOST_TOTAL_BYTES {
            return Err(malformed("more than 2 GiB when unpacked"));
        }
        found.push(entry);
        at = next;
    }
    Ok(found)
}

/// Reads a record of the directory; `None` if it is truncated.
fn record(bytes: &[u8], at: usize) -> Option<Result<(Entry, usize), FmuError>> {
    let record = bytes.get(at..)?;
    if !record.starts_with(b"PK\x01\x02") {
        return None;
    }
    let length = |at: usize| u16_at(record, at).map(usize::from);
    let (name, extra, comment) = (length(28)?, length(30)?, length(32)?);
    let text = record.get(RECORD..RECORD + name)?;
    let Ok(name) = std::str::from_utf8(text) else { return Some(Err(malformed("a file name is not UTF-8"))) };
    let is_plain = !name.starts_with('/')
        && !name.contains(['\\', '\0'])
        && name.split('/').all(|part| part != ".." && part != ".");
    if !is_plain {
        return Some(Err(malformed(format!("file name `{}` leaves the archive", name.escape_debug()))));
    }
    let (flags, method) = (u16_at(record, 8)?, u16_at(record, 10)?);
    if flags & 1 != 0 || !matches!(method, 0 | 8) {
        return Some(Err(malformed(format!("`{name}` is encrypted or packed by an unsupported method"))));
    }
    let (crc, packed, size) = (u32_at(record, 16)?, u32_at(record, 20)?, u32_at(record, 24)?);
    if u64::from(size) > MOST_BYTES {
        return Some(Err(malformed(format!("`{name}` is longer than 1 GiB"))));
    }
    let header = u32_at(record, 42)? as usize;
    let texts =
        usize::from(u16_at(bytes, header.checked_add(26)?)?) + usize::from(u16_at(bytes, header + 28)?);
    let start = header.checked_add(HEADER + texts)?;
    bytes.get(start..start.checked_add(packed as usize)?)?;
    let entry =
        Entry { name: name.to_owned(), size: size.into(), method, crc, start, packed: packed as usize };
    Some(Ok((entry, at + RECORD + text.len() + extra + comment)))
}

/// Unpacks a file.
pub(super) fn content(bytes: &[u8], entry: &Entry) -> Result<Vec<u8>, FmuError> {
    let damaged = || malformed(format!("`{}` is damaged", entry.name));
    let packed = bytes.get(entry.start..entry.start + entry.packed).ok_or_else(damaged)?;
    let mut out = Vec::new();
    match entry.method {
        0 => out.extend_from_slice(packed),
        // Reads one byte beyond the stated size, so that a longer file is noticed.
        _ => {
            let read = DeflateDecoder::new(packed).take(entry.size + 1).read_to_end(&mut out);
            read.map_err(|_| damaged())?;
        }
    }
    let mut crc = flate2::Crc::new();
    crc.update(&out);
    if out.len() as u64 != entry.size || crc.sum() != entry.crc {
        return Err(damaged());
    }
    Ok(out)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail")]
mod tests {
    use super::*;
    use crate::archive::Archive;

    fn packed(files: &[(&str, &[u8])]) -> Vec<u8> {
        let mut archive = Archive::default();
        assert!(files.iter().all(|(name, content)| archive.add(name, content)));
        archive.finish().unwrap()
    }

    #[test]
    fn what_is_packed_comes_out() {
        let long = vec![7; 100_000];
        let bytes = packed(&[("a.txt", b"one"), ("b/c.bin", &long)]);
        let found = entries(&bytes).unwrap();
        assert_eq!(found.iter().map(|entry| entry.name.as_str()).collect::<Vec<_>>(), ["a.txt", "b/c.bin"]);
        assert_eq!(content(&bytes, &found[0]).unwrap(), b"one");
        assert_eq!(content(&bytes, &found[1]).unwrap(), long);
        assert!(bytes.len() < 1000, "deflated");
    }

    #[test]
    fn names_that_leave_the_archive_are_refused() {
        for name in ["/etc/passwd", "../x", "a/../../x", "a\\..\\x", "./x"] {
            let error = entries(&packed(&[(name, b"x")])).unwrap_err().to_string();
            assert!(error.contains("leaves the archive"), "{name}: {error}");
        }
    }

    /// No cut or changed byte is used without a check: it is an error, or the file is whole.
    #[test]
    fn damage_is_found() {
        let bytes = packed(&[("a.txt", b"some text that is long enough to pack"), ("b.txt", b"more")]);
        let all = |bytes: &[u8]| -> Result<Vec<Vec<u8>>, FmuError> {
            entries(bytes)?.iter().map(|entry| content(bytes, entry)).collect()
        };
        let whole = all(&bytes).unwrap();
        assert!((0..bytes.len()).all(|length| all(&bytes[..length]).is_err()), "every cut");
        for at in 0..bytes.len() {
            for bit in 0..8 {
                let mut changed = bytes.clone();
                changed[at] ^= 1 << bit;
                if let Ok(found) = all(&changed) {
                    assert!(found.iter().all(|content| whole.contains(content)), "byte {at}, bit {bit}");
                }
            }
        }
    }
}
