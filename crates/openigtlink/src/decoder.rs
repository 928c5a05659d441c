//! Decodes messages from a stream of bytes.

use crate::header::{HEADER_BYTES, Header, HeaderVersion, NO_CRC};
use crate::{Error, Message};

/// Decodes messages from bytes in pieces of any size.
///
/// After [`Error::HeaderVersion`] or [`Error::TooLarge`] the stream is out of step and every call fails in
/// the same way: close it. After any other error the message in question is lost and the next one can be
/// read.
#[derive(Debug)]
pub struct Decoder {
    most_body_bytes: usize,
    bytes: Vec<u8>,
    newest: Option<HeaderVersion>,
    lacks_checksums: bool,
}

impl Decoder {
    /// Creates a decoder that accepts bodies up to this size in bytes.
    pub fn new(most_body_bytes: usize) -> Decoder {
        Decoder { most_body_bytes, bytes: Vec::new(), newest: None, lacks_checksums: false }
    }

    /// Adds bytes of the stream. Before adding the next piece, call [`Decoder::next`] until it returns
    /// `None`, so that at most one message and one piece are held.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// Returns the version of the newest header that was read, which is what the sender understands.
    pub fn version(&self) -> Option<HeaderVersion> {
        self.newest
    }

    /// Returns whether a body came without a checksum (a CRC of 0), so that damage to it went unnoticed.
    pub fn lacks_checksums(&self) -> bool {
        self.lacks_checksums
    }

    /// Returns the next complete message, or `None` until more bytes are added.
    ///
    /// # Errors
    /// A stream that is not OpenIGTLink; a body that is too large, damaged, or malformed for its type.
    #[expect(clippy::should_implement_trait, reason = "None is not the end: more bytes may come")]
    pub fn next(&mut self) -> Result<Option<Message>, Error> {
        let Some(bytes) = self.bytes.first_chunk::<HEADER_BYTES>() else { return Ok(None) };
        let header = Header::read(bytes)?;
        let body_bytes = usize::try_from(header.body_bytes).unwrap_or(usize::MAX);
        if body_bytes > self.most_body_bytes {
            return Err(Error::TooLarge { bytes: header.body_bytes, most: self.most_body_bytes });
        }
        let end = HEADER_BYTES + body_bytes;
        if self.bytes.len() < end {
            return Ok(None);
        }
        self.newest = Some(header.version);
        self.lacks_checksums |= header.crc == NO_CRC && body_bytes > 0;
        let message = Message::decode(header, &self.bytes[HEADER_BYTES..end]);
        self.bytes.drain(..end);
        message.map(Some)
    }
}
