//! Frames as 8-bit grey PNG files.

use std::path::Path;

use super::ReportError;

/// An 8-bit grey picture, row by row from the top left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreyImage {
    /// Pixel columns.
    pub columns: u32,
    /// Pixel rows.
    pub rows: u32,
    /// `columns` × `rows` grey values.
    pub pixels: Vec<u8>,
}

impl GreyImage {
    /// From little-endian `mono16` rows without padding; none if there are no pixels, or fewer than the size requires
    /// (a log that keeps only hashes).
    pub fn from_mono16(columns: u32, rows: u32, mono16: &[u8]) -> Option<GreyImage> {
        let count = (columns as usize).checked_mul(rows as usize)?;
        let bytes = mono16.get(..count.checked_mul(2)?)?;
        // Maps 0..=65535 to 0..=255, rounded: 65535 = 257 * 255.
        let narrow = |b: &[u8]| ((u32::from(u16::from_le_bytes([b[0], b[1]])) + 128) / 257) as u8;
        let pixels = bytes.chunks_exact(2).map(narrow).collect();
        (count > 0).then_some(GreyImage { columns, rows, pixels })
    }

    /// The picture as PNG; errors name this file.
    pub fn png(&self, path: &Path) -> Result<Vec<u8>, ReportError> {
        encode_png(path, self.columns, self.rows, png::ColorType::Grayscale, &self.pixels)
    }
}

/// Encodes 8-bit samples as PNG; errors name this file.
pub fn encode_png(
    path: &Path,
    columns: u32,
    rows: u32,
    colour: png::ColorType,
    samples: &[u8],
) -> Result<Vec<u8>, ReportError> {
    let mut bytes = Vec::new();
    let mut encode = || {
        let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
        encoder.set_color(colour);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(samples)?;
        writer.finish()
    };
    encode().map_err(|source: png::EncodingError| ReportError::Png { path: path.into(), source })?;
    Ok(bytes)
}
