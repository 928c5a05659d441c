//! Messages as bytes: `ros_interface` encodes and decodes them, DDS transports them.

use core::convert::Infallible;

use ros_interface::cdr::Order;
use rustdds::RepresentationIdentifier as Encoding;
use rustdds::bytes::Bytes;
use rustdds::no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter};

/// The CDR of an outgoing message.
#[derive(Debug, Clone)]
pub(crate) struct OutgoingCdr(pub(crate) Bytes);

/// The CDR of a received message.
#[derive(Debug, Clone)]
pub(crate) struct ReceivedCdr {
    pub(crate) cdr: Vec<u8>,
    pub(crate) order: Order,
}

/// Adapter that passes both through DDS unchanged.
#[derive(Debug)]
pub(crate) struct CdrAdapter;

impl SerializerAdapter<OutgoingCdr> for CdrAdapter {
    type Error = Infallible;

    fn output_encoding() -> Encoding {
        Encoding::CDR_LE
    }

    fn to_bytes(value: &OutgoingCdr) -> Result<Bytes, Infallible> {
        Ok(value.0.clone())
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Reader;

impl<'de> Decode<'de, ReceivedCdr> for Reader {
    type Error = Infallible;

    fn decode_bytes(self, bytes: &'de [u8], encoding: Encoding) -> Result<ReceivedCdr, Infallible> {
        let order = if encoding == Encoding::CDR_BE { Order::Big } else { Order::Little };
        Ok(ReceivedCdr { cdr: bytes.to_vec(), order })
    }
}

impl DeserializerAdapter<ReceivedCdr> for CdrAdapter {
    type Error = Infallible;
    type Decoded = ReceivedCdr;

    fn supported_encodings() -> &'static [Encoding] {
        &[Encoding::CDR_LE, Encoding::CDR_BE]
    }

    fn transform_decoded(decoded: ReceivedCdr) -> ReceivedCdr {
        decoded
    }
}

impl DefaultDecoder<ReceivedCdr> for CdrAdapter {
    type Decoder = Reader;
    const DECODER: Reader = Reader;
}
