//! JPEG 2000 with one greyscale component. The decoder allocates whatever the headers promise and fills in
//! missing data, so the codestream's headers and the chain of tile-parts are checked first.
//!
//! Source: ITU-T T.800 (ISO/IEC 15444-1), annexes A (codestream) and B (tiles, precincts, code-blocks); DICOM
//! PS3.5 annex A.4.4.

use super::codec::{StatedSize, check_frame, corrupt, without_padding};
use super::pixels::{Bits, Shape};
use crate::error::VolumeError;
use hayro_jpeg2000::{DecodeSettings, DecoderContext, Image};
use std::path::Path;

const CODEC: &str = "JPEG 2000";
/// Largest frame: 4096 x 4096 pixels, which the decoder decodes in 300 MB.
const MOST_PIXELS: usize = 1 << 24;
/// Empty code-blocks take no data, so the format has no useful bound. These limits are our own: beyond what
/// an empty slice of 2048 x 2048 pixels needs, and at a compression of larger ones that leaves no image. A
/// hostile pixel costs 1 to 2 µs, a usual one 0.2.
const PIXELS_PER_BYTE: u64 = 128;
const FREE_PIXELS: u64 = 1 << 22;
/// Largest number of precincts and layers of code-blocks, for which the decoder keeps records (about 100
/// bytes each), by pixels and by data. An image with code-blocks of 32 x 32 and ten layers has one per 77
/// pixels.
const PIXELS_PER_PART: u64 = 8;
const PARTS_PER_BYTE: u64 = 4;
const FREE_PARTS: u64 = 1 << 14;
/// Layers and bits per sample that the decoder supports; samples up to 16 bits are exact in its `f32`.
const LAYERS: u64 = 32;
const BITS: u8 = 16;
/// Largest number of wavelet decompositions (T.800 table A.15).
const DECOMPOSITIONS: u8 = 32;
/// Size of the smallest tile-part: SOT and SOD (T.800 A.4.2, A.4.3).
const LEAST_TILE_PART: u64 = 14;

/// Markers (T.800 table A.2).
const SIZ: u8 = 0x51;
const COD: u8 = 0x52;
const TLM: u8 = 0x55;
const PLT: u8 = 0x58;
const QCD: u8 = 0x5c;
const CRG: u8 = 0x63;
const COM: u8 = 0x64;
const SOT: u8 = 0x90;
const SOD: u8 = 0x93;
const EOC: u8 = 0xd9;

fn fail(path: &Path, reason: impl Into<String>) -> VolumeError {
    corrupt(path, CODEC, reason)
}

/// Checks that the compressed bytes of a file can hold its frames. The limit is for all frames together;
/// otherwise a file of many tiny frames would be unbounded.
///
/// # Errors
/// `Corrupt` if they cannot.
pub(super) fn check_file(path: &Path, frames: usize, shape: Shape, bytes: u64) -> Result<(), VolumeError> {
    let pixels = frames as u64 * shape.count() as u64;
    if pixels > bytes * PIXELS_PER_BYTE + FREE_PIXELS {
        return Err(fail(path, format!("{bytes} bytes cannot hold {pixels} pixels")));
    }
    Ok(())
}

/// Decodes a frame, lossless or lossy. Samples are in two's complement.
///
/// # Errors
/// `Corrupt` if the codestream is damaged, incomplete or contradicts the slice's header; `Unsupported` for
/// features not supported here.
pub(super) fn jpeg_2000(path: &Path, data: &[u8], shape: Shape, bits: Bits) -> Result<Vec<u32>, VolumeError> {
    let data = without_padding(codestream(data));
    let component = check(path, data, shape)?;
    // Readers agree on samples of the other sign only if both headers state the same bits.
    if component.signed != bits.signed && u32::from(component.bits) != bits.stored {
        let sign = |signed| if signed { "signed" } else { "unsigned" };
        let (inside, outside) = (sign(component.signed), sign(bits.signed));
        let reason = format!(
            "{inside} {} bits in the codestream, {outside} {} bits in the header",
            component.bits, bits.stored
        );
        return Err(fail(path, reason));
    }
    // Strict: an incomplete packet is an error; nothing is invented.
    let settings = DecodeSettings { resolve_palette_indices: false, strict: true, target_resolution: None };
    let image = Image::new(data, &settings).map_err(|e| fail(path, e.to_string()))?;
    let mut context = DecoderContext::default();
    let decoded = image.decode(&mut context).map_err(|e| fail(path, e.to_string()))?;
    let [samples] = decoded.components() else {
        return Err(fail(path, format!("{} components in a greyscale image", decoded.components().len())));
    };
    // The decoder shifts samples of either sign to 0 and above.
    let most = (1_i32 << component.bits) - 1;
    let zero = if component.signed { 1 << (component.bits - 1) } else { 0 };
    let number = |sample: &f32| sample.round_ties_even().clamp(0.0, most as f32) as i32 - zero;
    Ok(samples.samples().iter().map(|sample| number(sample) as u32).collect())
}

/// The codestream of a frame, or the frame itself if it has no box with one. DICOM wants it bare (PS3.5 annex
/// A.4.4), but some programs write a JP2 file: boxes of which one holds the codestream (T.800 annex I.4).
fn codestream(data: &[u8]) -> &[u8] {
    let mut at = 0;
    while let Some(length) = word(data, at) {
        let kind = data.get(at + 4..at + 8);
        if at == 0 && kind != Some(b"jP  ") {
            break;
        }
        // 0: up to the end; 1: the length follows in 64 bits.
        let (head, length) = match length {
            0 => (8, data.len() - at),
            1 => match (word(data, at + 8), word(data, at + 12)) {
                (Some(0), Some(low)) => (16, low as usize),
                _ => break,
            },
            length => (8, length as usize),
        };
        let Some(content) = at.checked_add(length).and_then(|end| data.get(at + head..end)) else { break };
        if kind == Some(b"jp2c") {
            return content;
        }
        at += length;
    }
    data
}

/// The single component of an image.
struct Component {
    signed: bool,
    bits: u8,
}

/// Marker segments: marker and content of each.
type Segments<'a> = Vec<(u8, &'a [u8])>;

/// The segments from byte `at` up to the marker `stop`, and its position. `None` if the chain is broken.
fn segments(data: &[u8], mut at: usize, stop: u8) -> Option<(Segments<'_>, usize)> {
    let mut out = Vec::new();
    loop {
        let [0xff, marker] = *data.get(at..)?.first_chunk::<2>()? else { return None };
        if marker == stop {
            return Some((out, at));
        }
        let length = usize::from(u16::from_be_bytes(*data.get(at + 2..)?.first_chunk::<2>()?));
        out.push((marker, data.get(at + 4..at + 2 + length)?));
        at += 2 + length;
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(*bytes.get(at..)?.first_chunk::<4>()?))
}

/// Checks headers and tile-parts.
fn check(path: &Path, data: &[u8], shape: Shape) -> Result<Component, VolumeError> {
    if !data.starts_with(&[0xff, 0x4f, 0xff, SIZ]) {
        return Err(fail(path, "no codestream at the start (SOC, SIZ)"));
    }
    let (main, begin) =
        segments(data, 2, SOT).ok_or_else(|| fail(path, "broken chain of segments before the first tile"))?;
    let (grid, component) = Grid::read(path, data, main[0].1, shape)?;
    let style = check_header(path, &main[1..], &[TLM, CRG, COM])?;
    let style = style.ok_or_else(|| fail(path, "no coding style (COD)"))?;
    let [width, height] = grid.tile;
    let mut parts = grid.tiles * style.parts(width, height);
    let mut tiles = vec![false; grid.tiles as usize];
    let mut at = begin;
    while data.get(at..at + 2) == Some(&[0xff, SOT]) {
        if word(data, at + 6) == Some(0) {
            return Err(unsupported(path, "a tile-part of unstated length"));
        }
        let (tile, end) =
            tile_part(data, at).ok_or_else(|| fail(path, format!("no complete tile-part at byte {at}")))?;
        let (header, _) = segments(&data[..end], at + 12, SOD)
            .ok_or_else(|| fail(path, format!("broken chain of segments in the tile-part at byte {at}")))?;
        if let Some(style) = check_header(path, &header, &[PLT, COM])? {
            parts += style.parts(width, height);
        }
        let seen = tiles.get_mut(tile).ok_or_else(|| fail(path, format!("tile {tile} of {}", grid.tiles)))?;
        *seen = true;
        at = end;
    }
    if data.get(at..at + 2) != Some(&[0xff, EOC]) {
        return Err(fail(path, format!("neither a tile-part nor the end of the codestream at byte {at}")));
    }
    if let Some(tile) = tiles.iter().position(|seen| !seen) {
        return Err(fail(path, format!("tile {tile} of {} is missing", grid.tiles)));
    }
    let most = shape.count() as u64 / PIXELS_PER_PART + data.len() as u64 * PARTS_PER_BYTE + FREE_PARTS;
    if parts > most {
        let reason = format!("up to {parts} precincts and layers of code-blocks, expected at most {most}");
        return Err(fail(path, reason));
    }
    Ok(component)
}

/// The tile of a tile-part, and where the tile-part ends (T.800 A.4.2).
fn tile_part(data: &[u8], at: usize) -> Option<(usize, usize)> {
    let [_, _, 0, 10, high, low, ..] = *data.get(at..at + 12)? else { return None };
    let length = word(data, at + 6)? as usize;
    let end = at.checked_add(length)?;
    let whole = length as u64 >= LEAST_TILE_PART && end <= data.len();
    whole.then_some((usize::from(u16::from_be_bytes([high, low])), end))
}

/// Tile grid of the image.
struct Grid {
    tiles: u64,
    /// Size of the largest tile, pixels along and across.
    tile: [u64; 2],
}

impl Grid {
    /// From the SIZ segment (T.800 A.5.1).
    fn read(path: &Path, data: &[u8], siz: &[u8], shape: Shape) -> Result<(Grid, Component), VolumeError> {
        let components = siz.get(34..36).map_or(0, |bytes| u16::from_be_bytes([bytes[0], bytes[1]]));
        if components != 1 {
            return Err(fail(path, format!("{components} components in a greyscale image")));
        }
        let [signed_bits, 1, 1] = *siz.get(36..).unwrap_or_default() else {
            return Err(fail(path, "a subsampled component"));
        };
        let component = Component { signed: signed_bits & 0x80 != 0, bits: (signed_bits & 0x7f) + 1 };
        let most = BITS.min(8 * shape.bytes as u8);
        if component.bits > most {
            return Err(fail(path, format!("{} bits per sample, expected at most {most}", component.bits)));
        }
        let field = |number: usize| word(siz, 2 + 4 * number).unwrap_or(0);
        // Image, its offset, tile, its offset; each along and across.
        let [columns, rows, x0, y0, tile_columns, tile_rows, tile_x0, tile_y0] = std::array::from_fn(field);
        if [x0, y0, tile_x0, tile_y0] != [0; 4] {
            return Err(unsupported(path, "an image that does not begin at the origin of its grid"));
        }
        if shape.count() > MOST_PIXELS {
            let given = format!("{} x {} pixels per frame", shape.rows, shape.columns);
            return Err(unsupported(path, &given));
        }
        let size = StatedSize { rows: rows as usize, columns: columns as usize };
        let most = data.len() as u64 * PIXELS_PER_BYTE + FREE_PIXELS;
        check_frame(path, CODEC, data, size, shape, most)?;
        if tile_columns == 0 || tile_rows == 0 {
            return Err(fail(path, format!("tiles of {tile_rows} x {tile_columns} pixels")));
        }
        let tiles = u64::from(columns.div_ceil(tile_columns)) * u64::from(rows.div_ceil(tile_rows));
        if tiles * LEAST_TILE_PART > data.len() as u64 {
            return Err(fail(path, format!("{tiles} tiles in {} bytes", data.len())));
        }
        let tile = [tile_columns.min(columns), tile_rows.min(rows)].map(u64::from);
        Ok((Grid { tiles, tile }, component))
    }
}

fn unsupported(path: &Path, given: &str) -> VolumeError {
    VolumeError::unsupported(
        path,
        "(7fe0,0010) PixelData",
        format!("JPEG 2000 with {given}"),
        format!(
            "at most {MOST_PIXELS} pixels from the origin, tile-parts of stated length, no region of \
             interest, packed packet headers or \
             changes of progression; convert it, for example with `gdcmconv --raw`"
        ),
    )
}

/// Checks the segments of a header, ignoring those in `others`; returns its coding style.
fn check_header(
    path: &Path,
    segments: &[(u8, &[u8])],
    others: &[u8],
) -> Result<Option<CodingStyle>, VolumeError> {
    let mut style = None;
    for (marker, content) in segments {
        match *marker {
            COD => {
                let read = CodingStyle::read(content);
                style = Some(read.ok_or_else(|| fail(path, "a coding style (COD) out of range"))?);
            }
            QCD => {
                check_quantization(content).ok_or_else(|| fail(path, "a quantization (QCD) out of range"))?
            }
            other if others.contains(&other) => {}
            other => return Err(unsupported(path, &format!("a segment with marker ff{other:02x}"))),
        }
    }
    Ok(style)
}

/// The QCD segment (T.800 A.6.4): one value per subband of its style; there are 3 subbands per decomposition,
/// plus 1.
fn check_quantization(content: &[u8]) -> Option<()> {
    let (style, values) = content.split_first()?;
    let most = 3 * usize::from(DECOMPOSITIONS) + 1;
    let valid = match style & 0x1f {
        0 => (1..=most).contains(&values.len()),
        1 => values.len() == 2,
        2 => values.len().is_multiple_of(2) && (1..=most).contains(&(values.len() / 2)),
        _ => false,
    };
    valid.then_some(())
}

/// Code-blocks and precincts as given by a COD segment (T.800 A.6.1).
struct CodingStyle {
    layers: u64,
    decompositions: u8,
    /// Size of a code-block, along and across, as exponents of 2.
    block: [u32; 2],
    /// Sizes of the precincts at each resolution, likewise; empty means 2^15.
    precincts: Vec<[u32; 2]>,
}

impl CodingStyle {
    /// `None` if the segment is malformed, or has more layers than the decoder supports.
    fn read(content: &[u8]) -> Option<CodingStyle> {
        let (fixed, sizes) = content.split_first_chunk::<10>()?;
        let [style, _, high, low, _, decompositions, block_x, block_y, ..] = *fixed;
        let layers = u64::from(u16::from_be_bytes([high, low]));
        let expected = if style & 1 == 0 { 0 } else { usize::from(decompositions) + 1 };
        let block = [block_x, block_y].map(|exponent| u32::from(exponent) + 2);
        let valid = (1..=LAYERS).contains(&layers)
            && decompositions <= DECOMPOSITIONS
            && sizes.len() == expected
            && block.iter().all(|exponent| *exponent <= 10)
            && block.iter().sum::<u32>() <= 12;
        let precincts = sizes.iter().map(|size| [u32::from(size & 15), u32::from(size >> 4)]).collect();
        valid.then_some(CodingStyle { layers, decompositions, block, precincts })
    }

    /// Upper bound of a tile's number of precincts and layers of code-blocks (T.800 B.5 to B.7).
    fn parts(&self, width: u64, height: u64) -> u64 {
        // As many as fit, plus one at either end.
        let cut = |extent: u64, exponent: u32| (extent >> exponent) + 2;
        let at = |resolution: u8| {
            let scale = u32::from(self.decompositions - resolution);
            let size = [width, height].map(|extent| extent.div_ceil(1 << scale));
            let precinct = *self.precincts.get(usize::from(resolution)).unwrap_or(&[15, 15]);
            // Above the first resolution there are three subbands of half the size.
            let (half, bands) = if resolution == 0 { (0, 1) } else { (1, 3) };
            let block = [0, 1].map(|axis| self.block[axis].min(precinct[axis].saturating_sub(half)));
            let precincts = cut(size[0], precinct[0]) * cut(size[1], precinct[1]);
            let blocks = cut(size[0] >> half, block[0]) * cut(size[1] >> half, block[1]);
            bands * (precincts + blocks * self.layers)
        };
        (0..=self.decompositions).map(at).sum()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// A file of 128 frames of 2048 x 2048 pixels in 200 bytes each kept the decoder busy for minutes.
    #[test]
    fn many_frames_of_next_to_no_data_are_refused() {
        let shape = Shape { rows: 2048, columns: 2048, bytes: 2 };
        check_file(Path::new("v.dcm"), 1, shape, 200).unwrap();
        let error = check_file(Path::new("v.dcm"), 128, shape, 128 * 200).unwrap_err();
        assert!(error.to_string().contains("25600 bytes cannot hold 536870912 pixels"), "{error}");
    }

    /// Counted as in T.800: 512 x 512 pixels, 5 decompositions, blocks of 64 x 64. Subbands of 256, 128 and
    /// so on down to 16 pixels have 16, 4, 1, 1 and 1 blocks, three of each size, plus one of 16 pixels.
    #[test]
    fn no_part_of_a_tile_is_left_out_of_the_count() {
        let style = CodingStyle::read(&[0, 0, 0, 10, 0, 5, 4, 4, 0, 1]).unwrap();
        let blocks = 3 * (16 + 4 + 1 + 1 + 1) + 1;
        let precincts = 3 * 5 + 1;
        assert!(style.parts(512, 512) >= 10 * blocks + precincts, "{}", style.parts(512, 512));
        // A usual image is far from the limit.
        assert!(style.parts(512, 512) < 512 * 512 / PIXELS_PER_PART / 4, "{}", style.parts(512, 512));
    }
}
