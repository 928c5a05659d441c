//! Greys as PNG.

/// A PNG of 16 bits with these values.
///
/// # Errors
/// The encoder's, in words.
pub fn grey16(columns: u32, rows: u32, greys: impl Iterator<Item = u16>) -> Result<Vec<u8>, String> {
    // PNG is big-endian.
    let bytes: Vec<u8> = greys.flat_map(u16::to_be_bytes).collect();
    encoded(columns, rows, png::BitDepth::Sixteen, &bytes)
}

/// A PNG of 8 bits: 0 stays 0 and 65535 becomes 255.
///
/// # Errors
/// The encoder's, in words.
pub fn grey8(columns: u32, rows: u32, greys: impl Iterator<Item = u16>) -> Result<Vec<u8>, String> {
    let bytes: Vec<u8> = greys.map(|grey| ((u32::from(grey) + 128) / 257) as u8).collect();
    encoded(columns, rows, png::BitDepth::Eight, &bytes)
}

fn encoded(columns: u32, rows: u32, depth: png::BitDepth, values: &[u8]) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(depth);
    let write = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(values)?;
        writer.finish()
    });
    write.map(|()| bytes).map_err(|cause| cause.to_string())
}
