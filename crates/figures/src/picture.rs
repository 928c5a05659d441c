//! Pictures as PNG.

use png::{BitDepth, ColorType, Compression, EncodingError};

/// Encodes samples as PNG, row by row from the top left; 16-bit samples are big-endian.
pub fn encode(
    [columns, rows]: [u32; 2],
    (colour, depth): (ColorType, BitDepth),
    compression: Compression,
    samples: &[u8],
) -> Result<Vec<u8>, EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    encoder.set_compression(compression);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(samples)?;
    writer.finish()?;
    Ok(bytes)
}

/// Encodes a 16-bit PNG.
pub fn grey16(columns: u32, rows: u32, greys: impl Iterator<Item = u16>) -> Result<Vec<u8>, String> {
    let bytes: Vec<u8> = greys.flat_map(u16::to_be_bytes).collect();
    let kind = (ColorType::Grayscale, BitDepth::Sixteen);
    encode([columns, rows], kind, Compression::default(), &bytes).map_err(|cause| cause.to_string())
}

/// Encodes an 8-bit PNG; 0 stays 0 and 65535 becomes 255.
pub fn grey8(columns: u32, rows: u32, greys: impl Iterator<Item = u16>) -> Result<Vec<u8>, String> {
    let bytes: Vec<u8> = greys.map(narrow).collect();
    let kind = (ColorType::Grayscale, BitDepth::Eight);
    encode([columns, rows], kind, Compression::default(), &bytes).map_err(|cause| cause.to_string())
}

/// Encodes an 8-bit RGB PNG of greys; 0 stays 0 and 65535 becomes 255. Also returns how many pixels have each
/// grey of 0..=255.
pub fn grey_as_rgb8(
    columns: u32,
    rows: u32,
    greys: impl Iterator<Item = u16>,
) -> Result<(Vec<u8>, [u64; 256]), String> {
    let mut counts = [0; 256];
    let bytes: Vec<u8> = greys.map(narrow).inspect(|grey| counts[usize::from(*grey)] += 1).collect();
    let bytes: Vec<u8> = bytes.into_iter().flat_map(|grey| [grey; 3]).collect();
    let kind = (ColorType::Rgb, BitDepth::Eight);
    let png =
        encode([columns, rows], kind, Compression::default(), &bytes).map_err(|cause| cause.to_string())?;
    Ok((png, counts))
}

/// Maps 0..=65535 to 0..=255, rounded: 65535 = 257 * 255.
fn narrow(grey: u16) -> u8 {
    ((u32::from(grey) + 128) / 257) as u8
}

/// An 8-bit grey picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreyImage {
    size: [u32; 2],
    pixels: Vec<u8>,
}

impl GreyImage {
    /// Creates a picture from little-endian `mono16` rows without padding. Returns `None` if there are no or
    /// too few pixels (a log that keeps only hashes).
    pub fn from_mono16(columns: u32, rows: u32, mono16: &[u8]) -> Option<GreyImage> {
        let count = (columns as usize).checked_mul(rows as usize)?;
        let bytes = mono16.get(..count.checked_mul(2)?)?;
        let pixels = bytes.chunks_exact(2).map(|b| narrow(u16::from_le_bytes([b[0], b[1]]))).collect();
        (count > 0).then_some(GreyImage { size: [columns, rows], pixels })
    }

    /// Encodes the picture as PNG.
    pub fn png(&self) -> Result<Vec<u8>, EncodingError> {
        encode(self.size, (ColorType::Grayscale, BitDepth::Eight), Compression::Fast, &self.pixels)
    }
}
