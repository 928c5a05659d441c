//! IMAGE: a picture or volume of 16-bit samples in space.

use crate::Error;
use crate::bytes::{FieldWriter, Fields};
use crate::geometry::{columns, put_columns};

pub(crate) const IMAGE: &str = "IMAGE";

const VERSION: u16 = 1;
const SCALAR_UINT16: u8 = 5;
const LITTLE_ENDIAN: u8 = 2;

/// The patient axes in which positions are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coordinates {
    /// Right, anterior, superior: Slicer's.
    Ras,
    /// Left, posterior, superior: DICOM's.
    Lps,
}

/// An image of one component with 16 unsigned bits per sample.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Coordinates of `axes_mm` and `centre_mm`.
    pub coordinates: Coordinates,
    /// Samples along i, j and k.
    pub size: [u16; 3],
    /// Column j is the step from one sample to the next along axis j.
    pub axes_mm: [[f32; 3]; 3],
    /// Centre of the image (not of its first sample).
    pub centre_mm: [f32; 3],
    /// Samples, i fastest.
    pub samples: Vec<u16>,
}

impl Image {
    fn sample_count(size: [u16; 3]) -> usize {
        // 65535³ fits 64 bits.
        size.iter().map(|n| usize::from(*n)).product()
    }
}

pub(crate) fn write(image: &Image, body: &mut Vec<u8>) -> Result<(), Error> {
    let expected = Image::sample_count(image.size);
    if image.samples.len() != expected {
        let expected = format!("{} (2 for each of {expected} samples)", 2 * expected);
        return Err(Error::Length { kind: IMAGE, bytes: 2 * image.samples.len(), expected });
    }
    body.put_u16(VERSION);
    body.put(&[1, SCALAR_UINT16, LITTLE_ENDIAN, if image.coordinates == Coordinates::Ras { 1 } else { 2 }]);
    image.size.iter().for_each(|n| body.put_u16(*n));
    put_columns(&image.axes_mm, body);
    body.put_f32s(&image.centre_mm);
    // The sub-volume that is sent: all of the image.
    (0..3).for_each(|_| body.put_u16(0));
    image.size.iter().for_each(|n| body.put_u16(*n));
    body.reserve(2 * expected);
    image.samples.iter().for_each(|sample| body.put(&sample.to_le_bytes()));
    Ok(())
}

pub(crate) fn read(body: &[u8]) -> Result<Image, Error> {
    let mut fields = Fields::new(IMAGE, body);
    expect("version", u32::from(fields.u16()?), &[1, 2], "1 or 2")?;
    expect("number of components", fields.u8()?.into(), &[1], "1")?;
    expect("scalar type", fields.u8()?.into(), &[SCALAR_UINT16.into()], "5 (uint16)")?;
    let endian = fields.u8()?;
    expect("endian", endian.into(), &[1, 2], "1 (big) or 2 (little)")?;
    let coordinates = fields.u8()?;
    expect("coordinate", coordinates.into(), &[1, 2], "1 (RAS) or 2 (LPS)")?;
    let size = [fields.u16()?, fields.u16()?, fields.u16()?];
    let axes_mm = columns(&mut fields, "axes")?;
    let centre_mm = fields.vector("centre")?;
    for n in [0, 0, 0, size[0], size[1], size[2]] {
        let given = fields.u16()?;
        expect("sub-volume", given.into(), &[n.into()], "the whole image")?;
    }
    let wanted = 2 * Image::sample_count(size);
    if fields.left() != wanted {
        return Err(fields.length(format!("{} ({wanted} of samples)", body.len() - fields.left() + wanted)));
    }
    let (pairs, _) = fields.rest().as_chunks::<2>();
    let sample =
        |pair: &[u8; 2]| if endian == 1 { u16::from_be_bytes(*pair) } else { u16::from_le_bytes(*pair) };
    let coordinates = if coordinates == 1 { Coordinates::Ras } else { Coordinates::Lps };
    Ok(Image { coordinates, size, axes_mm, centre_mm, samples: pairs.iter().map(sample).collect() })
}

fn expect(field: &'static str, given: u32, allowed: &[u32], expected: &'static str) -> Result<(), Error> {
    if allowed.contains(&given) {
        return Ok(());
    }
    Err(Error::Field { kind: IMAGE, field, given: given.to_string(), expected })
}
