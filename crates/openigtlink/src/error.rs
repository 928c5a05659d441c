//! Errors of encoding and decoding messages.

use thiserror::Error;

/// Why a message cannot be written or read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Error {
    /// The header has an unknown version.
    #[error("header version {0}, expected 1 or 2: the stream is not OpenIGTLink, or out of step")]
    HeaderVersion(u16),
    /// The announced body is larger than the reader accepts.
    #[error("a body of {bytes} bytes, at most {most} accepted")]
    TooLarge {
        /// Announced length.
        bytes: u64,
        /// The reader's limit.
        most: usize,
    },
    /// The body does not match its checksum.
    #[error("`{kind}`: the body's CRC-64 is {computed:#018x}, its header says {stated:#018x}")]
    Checksum {
        /// Type of the message.
        kind: String,
        /// CRC of the received bytes.
        computed: u64,
        /// CRC in the header.
        stated: u64,
    },
    /// A body is shorter or longer than its type and its own lengths require.
    #[error("`{kind}`: a body of {bytes} bytes, expected {expected}")]
    Length {
        /// Type of the message.
        kind: &'static str,
        /// The body's length in bytes.
        bytes: usize,
        /// What was expected.
        expected: String,
    },
    /// A field of a body is out of range.
    #[error("`{kind}`: `{field}` is {given}, expected {expected}")]
    Field {
        /// Type of the message.
        kind: &'static str,
        /// Field.
        field: &'static str,
        /// Its value.
        given: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// A text does not fit its field.
    #[error("`{text}` has {bytes} bytes, {field} allows at most {most}, ASCII only")]
    Text {
        /// The field.
        field: &'static str,
        /// The text.
        text: String,
        /// Its length.
        bytes: usize,
        /// The field's length.
        most: usize,
    },
}
