//! Writes a ZIP archive in memory (APPNOTE 6.3: deflated entries, no ZIP64, no encryption).
//!
//! Dates are those of the format's epoch, so the same files give the same bytes.

use std::io::Write as _;

use flate2::write::DeflateEncoder;
use flate2::{Compression, Crc};

/// 1 January 1980, midnight: the first date of the format.
const DATE: u16 = 0x21;
/// Version of the format that an extractor needs: 2.0, deflate.
const NEEDS: u16 = 20;
/// Made on UNIX by version 2.0, so that the attributes hold a file mode.
const MADE_BY: u16 = 3 << 8 | NEEDS;
/// Names are UTF-8.
const UTF_8: u16 = 1 << 11;
const DEFLATE: u16 = 8;
/// Mode of a regular file that everyone may read and execute, as libraries need.
const MODE: u32 = 0o100_755 << 16;

/// An archive under construction.
#[derive(Debug, Default)]
pub struct Archive {
    bytes: Vec<u8>,
    directory: Vec<u8>,
    count: u16,
}

impl Archive {
    /// Adds a file. Returns false, and adds nothing, if the archive would exceed the format's 4 GiB or 65535
    /// files.
    pub fn add(&mut self, name: &str, content: &[u8]) -> bool {
        let mut crc = Crc::new();
        crc.update(content);
        let mut encoder = DeflateEncoder::new(Vec::new(), Compression::default());
        // Writing to memory does not fail.
        let written = encoder.write_all(content).and_then(|()| encoder.finish());
        let Ok(packed) = written else { return false };
        let sizes =
            (u32::try_from(packed.len()), u32::try_from(content.len()), u32::try_from(self.bytes.len()));
        let (Ok(packed_size), Ok(size), Ok(offset)) = sizes else { return false };
        let (Ok(length), Some(count)) = (u16::try_from(name.len()), self.count.checked_add(1)) else {
            return false;
        };
        let mut shared = Vec::new();
        for word in [NEEDS, UTF_8, DEFLATE, 0, DATE] {
            shared.extend(word.to_le_bytes());
        }
        for word in [crc.sum(), packed_size, size] {
            shared.extend(word.to_le_bytes());
        }
        shared.extend(length.to_le_bytes());
        shared.extend(0u16.to_le_bytes());
        self.bytes.extend(b"PK\x03\x04");
        self.bytes.extend(&shared);
        self.bytes.extend(name.as_bytes());
        self.bytes.extend(packed);
        self.directory.extend(b"PK\x01\x02");
        self.directory.extend(MADE_BY.to_le_bytes());
        self.directory.extend(&shared);
        // No comment, first disk, no text.
        self.directory.extend([0; 6]);
        self.directory.extend(MODE.to_le_bytes());
        self.directory.extend(offset.to_le_bytes());
        self.directory.extend(name.as_bytes());
        self.count = count;
        true
    }

    /// Returns the archive's bytes, or `None` if it exceeds 4 GiB.
    pub fn finish(self) -> Option<Vec<u8>> {
        let Archive { mut bytes, directory, count } = self;
        let (offset, size) = (u32::try_from(bytes.len()).ok()?, u32::try_from(directory.len()).ok()?);
        bytes.extend(directory);
        bytes.extend(b"PK\x05\x06\0\0\0\0");
        bytes.extend(count.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend(size.to_le_bytes());
        bytes.extend(offset.to_le_bytes());
        bytes.extend([0; 2]);
        Some(bytes)
    }
}
