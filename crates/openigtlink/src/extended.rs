//! The extended header and the metadata of header version 2.

use crate::Error;
use crate::bytes::{FieldWriter, Fields};

const KIND: &str = "extended header";
/// Size of the extended header that this crate writes, in bytes; a longer one is skipped.
const EXTENDED_BYTES: u16 = 12;

/// Wraps content into a body of header version 2: no metadata, message number 0.
pub(crate) fn wrap(content: &[u8]) -> Vec<u8> {
    let mut body = Vec::with_capacity(content.len() + usize::from(EXTENDED_BYTES) + 2);
    body.put_u16(EXTENDED_BYTES);
    // The metadata's index: its count, nothing else.
    body.put_u16(2);
    body.put_u32(0);
    body.put_u32(0);
    body.put(content);
    body.put_u16(0);
    body
}

/// Returns the content of a body of header version 2, without extended header and metadata.
pub(crate) fn unwrap(body: &[u8]) -> Result<&[u8], Error> {
    let mut fields = Fields::new(KIND, body);
    let extended_bytes = usize::from(fields.u16()?);
    let index_bytes = usize::from(fields.u16()?);
    let metadata_bytes = fields.u32()? as usize;
    let behind = index_bytes.saturating_add(metadata_bytes);
    if extended_bytes < usize::from(EXTENDED_BYTES) {
        let given = extended_bytes.to_string();
        return Err(Error::Field {
            kind: KIND,
            field: "extended_header_size",
            given,
            expected: "12 or more",
        });
    }
    let end = body.len().checked_sub(behind).filter(|end| *end >= extended_bytes);
    let expected = || format!("at least {}", extended_bytes.saturating_add(behind));
    let end = end.ok_or_else(|| Fields::new(KIND, body).length(expected()))?;
    Ok(&body[extended_bytes..end])
}
