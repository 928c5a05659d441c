//! Recognizes the start of a chunk, a header or an end marker among other bytes.

use mcap::records::op;

use crate::end::END_RECORD;
use crate::header::{CALIBRATION_ATTACHMENT, HEADER_RECORD, SCENE_ATTACHMENT};
use crate::records::{MAX_RECORD_BYTES, RECORD_HEADER};

fn number(bytes: &[u8], at: usize, width: usize) -> Option<u64> {
    let mut buffer = [0; 8];
    buffer.get_mut(..width)?.copy_from_slice(bytes.get(at..at + width)?);
    Some(u64::from_le_bytes(buffer))
}

/// Returns whether bytes look like the start of a chunk: a length that fits its own fields and a known
/// compression.
pub(super) fn begins_chunk(bytes: &[u8]) -> bool {
    let fits = || {
        let length = number(bytes, 1, 8)?;
        let fields = RECORD_HEADER + 28;
        let name = number(bytes, fields, 4)? as usize;
        let known = matches!(bytes.get(fields + 4..fields + 4 + name)?, b"" | b"lz4" | b"zstd");
        let records = number(bytes, fields + 4 + name, 8)?;
        Some(known && length <= MAX_RECORD_BYTES && records.checked_add(40 + name as u64)? == length)
    };
    bytes.first() == Some(&op::CHUNK) && name_is_short(bytes) && fits().unwrap_or(false)
}

/// A compression name has at most 4 bytes; a longer one would read past the window.
fn name_is_short(bytes: &[u8]) -> bool {
    number(bytes, RECORD_HEADER + 28, 4).is_some_and(|length| length <= 4)
}

/// Returns whether bytes look like the start of the header or the end marker.
pub(super) fn begins_metadata(bytes: &[u8]) -> bool {
    let name = || {
        let length = number(bytes, RECORD_HEADER, 4)? as usize;
        bytes.get(RECORD_HEADER + 4..(RECORD_HEADER + 4).checked_add(length)?)
    };
    bytes.first() == Some(&op::METADATA) && name().is_some_and(is_sought)
}

/// Returns whether bytes look like the start of one of the header's attachments.
pub(super) fn begins_attachment(bytes: &[u8]) -> bool {
    let name = || {
        let length = number(bytes, RECORD_HEADER + 16, 4)? as usize;
        bytes.get(RECORD_HEADER + 20..(RECORD_HEADER + 20).checked_add(length)?)
    };
    let is_sought = |name: &[u8]| {
        [SCENE_ATTACHMENT, CALIBRATION_ATTACHMENT].iter().any(|sought| name == sought.as_bytes())
    };
    bytes.first() == Some(&op::ATTACHMENT) && name().is_some_and(is_sought)
}

pub(super) fn is_sought(name: &[u8]) -> bool {
    [HEADER_RECORD, END_RECORD].iter().any(|sought| name == sought.as_bytes())
}

/// Returns whether the type is defined by the format (0x01 to 0x0f) or private.
pub(super) fn plausible(opcode: u8, length: u64) -> bool {
    (matches!(opcode, 1..=0x0f) || opcode >= 0x80) && length <= MAX_RECORD_BYTES
}
