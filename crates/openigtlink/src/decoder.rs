//! Messages from a stream of bytes.

use crate::header::{HEADER_BYTES, Header, HeaderVersion};
use crate::{Error, Message};

/// Turns bytes, in pieces of any size, into messages.
///
/// After [`Error::HeaderVersion`] or [`Error::TooLarge`] the stream is out of step and every call fails
/// alike: close it. After any other error the message in question is gone and the next one can be read.
#[derive(Debug)]
pub struct Decoder {
    most_body_bytes: usize,
    bytes: Vec<u8>,
    newest: Option<HeaderVersion>,
}

impl Decoder {
    /// A decoder that accepts bodies of at most so many bytes.
    pub fn new(most_body_bytes: usize) -> Decoder {
        Decoder { most_body_bytes, bytes: Vec::new(), newest: None }
    }

    /// Takes bytes of the stream. Call [`Decoder::next`] until it returns `None` before the next piece, so
    /// that no more than one message and one piece are held.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    /// Version of the newest header that was read: what the sender understands.
    pub fn version(&self) -> Option<HeaderVersion> {
        self.newest
    }

    /// The next whole message; `None` until more bytes come.
    ///
    /// # Errors
    /// A stream that is not OpenIGTLink, a body that is too large, damaged, or not what its type asks for.
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
        let message = Message::decode(header, &self.bytes[HEADER_BYTES..end]);
        self.bytes.drain(..end);
        message.map(Some)
    }
}
