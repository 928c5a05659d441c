//! A message: header and body.

use crate::geometry::{self, TRANSFORM};
use crate::header::{CRC, HEADER_BYTES, Header, NO_CRC};
use crate::image::{self, IMAGE};
use crate::points::{self, POINT};
use crate::polydata::{self, POLYDATA};
use crate::text::{self, STATUS, STRING};
use crate::{Error, HeaderVersion, Image, Point, PolyData, Status, Timestamp, Transform, bytes, extended};

/// The content of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// A pose.
    Transform(Transform),
    /// A picture or volume.
    Image(Image),
    /// Fiducials.
    Points(Vec<Point>),
    /// A text.
    Text(String),
    /// An answer.
    Status(Status),
    /// A surface or lines.
    PolyData(PolyData),
    /// A type unknown to this crate, such as `GET_TRANS`; its content as received.
    Other {
        /// The type.
        kind: String,
        /// The content, without extended header and metadata.
        content: Vec<u8>,
    },
}

impl Body {
    fn kind(&self) -> &str {
        match self {
            Body::Transform(_) => TRANSFORM,
            Body::Image(_) => IMAGE,
            Body::Points(_) => POINT,
            Body::Text(_) => STRING,
            Body::Status(_) => STATUS,
            Body::PolyData(_) => POLYDATA,
            Body::Other { kind, .. } => kind,
        }
    }
}

/// A message.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// Name of the item, at most 20 bytes of ASCII. Receivers keep one item per name and type.
    pub device: String,
    /// Time of creation; zero if unknown.
    pub timestamp: Timestamp,
    /// The content.
    pub body: Body,
}

impl Message {
    /// Creates a message without a time.
    ///
    /// # Errors
    /// [`Error::Text`] for a device name of more than 20 bytes or not ASCII.
    pub fn new(device: &str, body: Body) -> Result<Message, Error> {
        bytes::check_text("the device name", device, 20)?;
        Ok(Message { device: device.to_owned(), timestamp: Timestamp::default(), body })
    }

    /// Encodes the message.
    ///
    /// # Errors
    /// A text, length or index that does not fit its field.
    pub fn encode(&self, version: HeaderVersion) -> Result<Vec<u8>, Error> {
        let mut content = Vec::new();
        match &self.body {
            Body::Transform(transform) => geometry::write(transform, &mut content),
            Body::Image(image) => image::write(image, &mut content)?,
            Body::Points(points) => points::write(points, &mut content)?,
            Body::Text(text) => text::write_string(text, &mut content)?,
            Body::Status(status) => text::write_status(status, &mut content)?,
            Body::PolyData(data) => polydata::write(data, &mut content)?,
            Body::Other { content: other, .. } => content.extend_from_slice(other),
        }
        let body = match version {
            HeaderVersion::V1 => content,
            HeaderVersion::V2 => extended::wrap(&content),
        };
        let header = Header {
            version,
            kind: self.body.kind().to_owned(),
            device: self.device.clone(),
            timestamp: self.timestamp,
            body_bytes: body.len() as u64,
            crc: CRC.checksum(&body),
        };
        let mut message = Vec::with_capacity(HEADER_BYTES + body.len());
        header.write(&mut message)?;
        message.extend_from_slice(&body);
        Ok(message)
    }

    /// Returns the message with this header and body. A checksum of 0 means that the sender computed none, as
    /// other implementations read it; then the body is not verified.
    pub(crate) fn decode(header: Header, body: &[u8]) -> Result<Message, Error> {
        let computed = CRC.checksum(body);
        if computed != header.crc && header.crc != NO_CRC {
            return Err(Error::Checksum { kind: header.kind, computed, stated: header.crc });
        }
        let content = match header.version {
            HeaderVersion::V1 => body,
            HeaderVersion::V2 => extended::unwrap(body)?,
        };
        let body = match header.kind.as_str() {
            TRANSFORM => Body::Transform(geometry::read(content)?),
            IMAGE => Body::Image(image::read(content)?),
            POINT => Body::Points(points::read(content)?),
            STRING => Body::Text(text::read_string(content)?),
            STATUS => Body::Status(text::read_status(content)?),
            POLYDATA => Body::PolyData(polydata::read(content)?),
            _ => Body::Other { kind: header.kind, content: content.to_vec() },
        };
        Ok(Message { device: header.device, timestamp: header.timestamp, body })
    }
}
