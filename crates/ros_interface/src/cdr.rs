//! CDR, the bytes of ROS 2 messages (OMG DDSI-RTPS 2.3, 10.2), behind the four bytes that name the encoding.

use byteorder::{BigEndian, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Byte order of a message that came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// `CDR_LE`.
    Little,
    /// `CDR_BE`.
    Big,
}

/// A message as little-endian CDR.
///
/// # Errors
/// A type that CDR cannot express; none of [`crate::msg`] is one.
pub fn encode<T: Serialize>(message: &T) -> Result<Vec<u8>, cdr_encoding::Error> {
    cdr_encoding::to_vec::<T, LittleEndian>(message)
}

/// A message from its CDR; bytes behind it are left, as senders pad.
///
/// # Errors
/// Too few bytes, text that is not UTF-8 or without its NUL.
pub fn decode<T: DeserializeOwned>(bytes: &[u8], order: Order) -> Result<T, cdr_encoding::Error> {
    let decoded = match order {
        Order::Little => cdr_encoding::from_bytes::<T, LittleEndian>(bytes),
        Order::Big => cdr_encoding::from_bytes::<T, BigEndian>(bytes),
    };
    decoded.map(|(message, _)| message)
}
