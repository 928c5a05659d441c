//! POINT: named fiducials.

use crate::Error;
use crate::bytes::{FieldWriter, Fields};

pub(crate) const POINT: &str = "POINT";

const NAME_BYTES: usize = 64;
const GROUP_BYTES: usize = 32;
const OWNER_BYTES: usize = 20;
const POINT_BYTES: usize = 136;

/// A fiducial.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Name, at most 63 bytes of ASCII.
    pub name: String,
    /// Group, such as `Fiducial`; at most 31 bytes.
    pub group: String,
    /// Red, green, blue, opacity.
    pub rgba: [u8; 4],
    /// Position.
    pub position_mm: [f32; 3],
    /// Diameter of the mark; 0 lets the receiver choose.
    pub diameter_mm: f32,
    /// Device name of the image that the point belongs to; may be empty.
    pub owner: String,
}

pub(crate) fn write(points: &[Point], body: &mut Vec<u8>) -> Result<(), Error> {
    for point in points {
        body.put_padded("a point's name", &point.name, NAME_BYTES)?;
        body.put_padded("a point's group", &point.group, GROUP_BYTES)?;
        body.put(&point.rgba);
        body.put_f32s(&point.position_mm);
        body.put_f32s(&[point.diameter_mm]);
        body.put_padded("a point's owner", &point.owner, OWNER_BYTES)?;
    }
    Ok(())
}

pub(crate) fn read(body: &[u8]) -> Result<Vec<Point>, Error> {
    if !body.len().is_multiple_of(POINT_BYTES) {
        let expected = format!("a multiple of {POINT_BYTES}");
        return Err(Error::Length { kind: POINT, bytes: body.len(), expected });
    }
    body.chunks_exact(POINT_BYTES).map(read_one).collect()
}

fn read_one(bytes: &[u8]) -> Result<Point, Error> {
    let mut fields = Fields::new(POINT, bytes);
    Ok(Point {
        name: fields.padded(NAME_BYTES)?,
        group: fields.padded(GROUP_BYTES)?,
        rgba: fields.array()?,
        position_mm: fields.vector("position")?,
        diameter_mm: fields.f32("diameter")?,
        owner: fields.padded(OWNER_BYTES)?,
    })
}
