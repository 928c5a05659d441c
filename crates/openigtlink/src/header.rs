//! The 58-byte header of each message.

use crc::{CRC_64_ECMA_182, Crc};

use crate::Error;
use crate::bytes::{FieldWriter, Fields};

/// Size of a header in bytes.
pub const HEADER_BYTES: usize = 58;

/// CRC of a body: ECMA-182, starting from 0, as computed by `igtl_util.c`.
pub(crate) const CRC: Crc<u64> = Crc::<u64>::new(&CRC_64_ECMA_182);
/// CRC field of a sender that computes no checksum. An empty body and one of zeros have it too.
pub(crate) const NO_CRC: u64 = 0;

const TYPE_BYTES: usize = 12;
const DEVICE_BYTES: usize = 20;

/// Version of the header, which is not that of the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeaderVersion {
    /// Protocols 1 and 2: the content follows immediately.
    V1,
    /// Protocol 3: the body begins with an extended header and ends with metadata.
    V2,
}

impl HeaderVersion {
    fn code(self) -> u16 {
        match self {
            HeaderVersion::V1 => 1,
            HeaderVersion::V2 => 2,
        }
    }
}

/// Seconds since 1970 as defined by OpenIGTLink; zero if the sender gives none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Timestamp {
    /// Whole seconds.
    pub seconds: u32,
    /// Fraction of a second in units of 2⁻³² s.
    pub fraction: u32,
}

impl Timestamp {
    /// Converts nanoseconds since 1970. The field's range ends in 2106.
    pub fn from_ns(ns: u64) -> Timestamp {
        let fraction = ((ns % 1_000_000_000) << 32) / 1_000_000_000;
        Timestamp {
            seconds: u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX),
            fraction: u32::try_from(fraction).unwrap_or(u32::MAX),
        }
    }
}

/// A header. Its `body_bytes` include the extended header and the metadata.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) version: HeaderVersion,
    pub(crate) kind: String,
    pub(crate) device: String,
    pub(crate) timestamp: Timestamp,
    pub(crate) body_bytes: u64,
    pub(crate) crc: u64,
}

impl Header {
    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), Error> {
        out.put_u16(self.version.code());
        put_name(out, "the message type", &self.kind, TYPE_BYTES)?;
        put_name(out, "the device name", &self.device, DEVICE_BYTES)?;
        out.put_u32(self.timestamp.seconds);
        out.put_u32(self.timestamp.fraction);
        out.put_u64(self.body_bytes);
        out.put_u64(self.crc);
        Ok(())
    }

    pub(crate) fn read(bytes: &[u8; HEADER_BYTES]) -> Result<Header, Error> {
        let mut fields = Fields::new("header", bytes);
        let version = match fields.u16()? {
            1 => HeaderVersion::V1,
            2 => HeaderVersion::V2,
            other => return Err(Error::HeaderVersion(other)),
        };
        Ok(Header {
            version,
            kind: fields.padded(TYPE_BYTES)?,
            device: fields.padded(DEVICE_BYTES)?,
            timestamp: Timestamp { seconds: fields.u32()?, fraction: fields.u32()? },
            body_bytes: fields.u64()?,
            crc: fields.u64()?,
        })
    }
}

/// Writes a name. The header's names may fill their fields; no NUL need follow.
fn put_name(out: &mut Vec<u8>, field: &'static str, text: &str, bytes: usize) -> Result<(), Error> {
    crate::bytes::check_text(field, text, bytes)?;
    out.put(text.as_bytes());
    out.resize(out.len() + bytes - text.len(), 0);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_is_that_of_the_catalogue() {
        // "check" of CRC-64/ECMA-182 in the catalogue of parametrised CRC algorithms (reveng).
        assert_eq!(CRC.checksum(b"123456789"), 0x6c40_df5f_0b49_7347);
    }

    #[test]
    fn half_a_second_is_half_of_the_fraction() {
        let half = Timestamp::from_ns(5_500_000_000);
        assert_eq!(half, Timestamp { seconds: 5, fraction: 1 << 31 });
    }
}
