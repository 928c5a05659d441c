//! Messages as bytes: `ros_interface` encodes and decodes them, DDS transports them.

use core::convert::Infallible;

use ros_interface::cdr::Order;
use rustdds::RepresentationIdentifier as Encoding;
use rustdds::bytes::Bytes;
use rustdds::no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter};

/// The CDR of an outgoing message.
#[derive(Debug, Clone)]
pub(crate) struct Sent(pub(crate) Bytes);

/// The CDR of a received message.
#[derive(Debug, Clone)]
pub(crate) struct Came {
    pub(crate) cdr: Vec<u8>,
    pub(crate) order: Order,
}

/// Adapter that passes both through DDS unchanged.
#[derive(Debug)]
pub(crate) struct Raw;

impl SerializerAdapter<Sent> for Raw {
    type Error = Infallible;

    fn output_encoding() -> Encoding {
        Encoding::CDR_LE
    }

    fn to_bytes(value: &Sent) -> Result<Bytes, Infallible> {
        Ok(value.0.clone())
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Reader;

impl<'de> Decode<'de, Came> for Reader {
    type Error = Infallible;

    fn decode_bytes(self, bytes: &'de [u8], encoding: Encoding) -> Result<Came, Infallible> {
        let order = if encoding == Encoding::CDR_BE { Order::Big } else { Order::Little };
        Ok(Came { cdr: bytes.to_vec(), order })
    }
}

impl DeserializerAdapter<Came> for Raw {
    type Error = Infallible;
    type Decoded = Came;

    fn supported_encodings() -> &'static [Encoding] {
        &[Encoding::CDR_LE, Encoding::CDR_BE]
    }

    fn transform_decoded(decoded: Came) -> Came {
        decoded
    }
}

impl DefaultDecoder<Came> for Raw {
    type Decoder = Reader;
    const DECODER: Reader = Reader;
}
