//! OpenIGTLink messages as bytes, as 3D Slicer, PLUS and tracking systems exchange them.
//!
//! Source: the OpenIGTLink protocol, versions 2 and 3 (openigtlink.org/developers/spec: header, extended
//! header, CRC, TRANSFORM, IMAGE, POINT, STRING, STATUS, POLYDATA). Numbers are big-endian; lengths are in
//! millimetres, as Slicer expects.
//!
//! A [`Message`] is encoded to bytes by [`Message::encode`]; a [`Decoder`] decodes messages from a stream of
//! bytes.
//!
//! **Boundary:** bytes only; no socket, no clock. **Invariants:** a decoder holds at most one message and
//! never more than its limit; lengths in a message are checked before they are trusted; a body of an unknown
//! type is kept as bytes.
//!
//! ```
//! use openigtlink::{Body, Decoder, HeaderVersion, Message, Transform};
//!
//! let pose = Transform { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation_mm: [1.0, 2.0, 3.0] };
//! let sent = Message::new("BurrToRAS", Body::Transform(pose))?;
//! let mut decoder = Decoder::new(1 << 20);
//! decoder.push(&sent.encode(HeaderVersion::V2)?);
//! assert_eq!(decoder.next()?, Some(sent));
//! # Ok::<(), openigtlink::Error>(())
//! ```

mod bytes;
mod decoder;
mod error;
mod extended;
mod geometry;
mod header;
mod image;
mod message;
mod points;
mod polydata;
mod text;

pub use decoder::Decoder;
pub use error::Error;
pub use geometry::Transform;
pub use header::{HEADER_BYTES, HeaderVersion, Timestamp};
pub use image::{Coordinates, Image};
pub use message::{Body, Message};
pub use points::Point;
pub use polydata::PolyData;
pub use text::{Status, StatusCode};
