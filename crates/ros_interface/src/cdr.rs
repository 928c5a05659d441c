//! CDR, the encoding of ROS 2 messages (OMG DDSI-RTPS 2.3, 10.2), after the four bytes that name the
//! encoding.

use byteorder::{BigEndian, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Byte order of a received message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// `CDR_LE`.
    Little,
    /// `CDR_BE`.
    Big,
}

/// Encodes a message as little-endian CDR.
///
/// # Errors
/// A type that CDR cannot express; [`crate::msg`] has none.
pub fn encode<T: Serialize>(message: &T) -> Result<Vec<u8>, cdr_encoding::Error> {
    cdr_encoding::to_vec::<T, LittleEndian>(message)
}

/// Decodes a message from CDR. Bytes after it are ignored, because senders pad.
///
/// # Errors
/// Too few bytes; a text that is not UTF-8 or lacks its NUL.
pub fn decode<T: DeserializeOwned>(bytes: &[u8], order: Order) -> Result<T, cdr_encoding::Error> {
    let decoded = match order {
        Order::Little => cdr_encoding::from_bytes::<T, LittleEndian>(bytes),
        Order::Big => cdr_encoding::from_bytes::<T, BigEndian>(bytes),
    };
    decoded.map(|(message, _)| message)
}
