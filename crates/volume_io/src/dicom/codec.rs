//! Decoders of compressed pixels, each behind checks that its crate lacks: sizes are checked before
//! allocation, and missing pixels are never invented.

use super::pixels::Shape;
use crate::error::VolumeError;
use std::path::Path;

/// Most pixels per byte of JPEG data: 8 in a lossless image, where every pixel takes at least a bit; 512 in
/// one coded in blocks of 64, where a block's first coefficient takes at least a bit (ITU-T T.81, annexes F
/// to H).
const JPEG_PIXELS_PER_BYTE: u64 = 512;
/// JPEG-LS codes runs, so the format has no useful bound. This limit is our own, as for bzip2: far above what
/// any image with noise reaches, and above what an empty slice of 2048 x 2048 pixels needs.
const RUN_PIXELS_PER_BYTE: u64 = 2000;
const RUN_FREE_PIXELS: u64 = 1 << 22;

/// Markers of JPEG and JPEG-LS (ITU-T T.81 table B.1, T.87 table C.1).
const START_OF_SCAN: u8 = 0xda;
const JPEG_LS_FRAME: u8 = 0xf7;
const JPEG_LS_PRESETS: u8 = 0xf8;
const EXTENDED_SEQUENTIAL: u8 = 0xc1;

pub(super) fn corrupt(path: &Path, codec: &'static str, reason: impl Into<String>) -> VolumeError {
    VolumeError::Corrupt { path: path.into(), codec, reason: reason.into() }
}

/// RLE lossless (PS3.5 annex G): a header of 16 u32, then one PackBits segment per byte plane, most
/// significant first.
pub(super) fn rle(path: &Path, fragment: &[u8], shape: Shape) -> Result<Vec<u32>, VolumeError> {
    let planes = shape.bytes as usize;
    rle_planes(fragment, shape.count(), planes)
        .ok_or_else(|| corrupt(path, "RLE", "the segments do not contain all pixels"))
}

fn rle_planes(fragment: &[u8], count: usize, planes: usize) -> Option<Vec<u32>> {
    let word = |i: usize| Some(u32::from_le_bytes(fragment.get(4 * i..4 * i + 4)?.try_into().ok()?) as usize);
    if word(0)? != planes {
        return None;
    }
    // PackBits turns 128 bytes into 2 at best, so a header cannot promise more than that.
    if count > fragment.len().checked_mul(128)? {
        return None;
    }
    let mut samples = vec![0_u32; count];
    for plane in 0..planes {
        let start = word(1 + plane)?;
        let end = if plane + 1 < planes { word(2 + plane)? } else { fragment.len() };
        unpack_bits(fragment.get(start..end)?, &mut samples)?;
    }
    Some(samples)
}

/// Shifts one byte plane into the samples.
fn unpack_bits(segment: &[u8], samples: &mut [u32]) -> Option<()> {
    let count = samples.len();
    let (mut at, mut out) = (0, 0);
    while out < count {
        let control = *segment.get(at)?;
        at += 1;
        let (length, repeat) = match control {
            0..=127 => (usize::from(control) + 1, false),
            128 => continue,
            129..=255 => (257 - usize::from(control), true),
        };
        for i in 0..length.min(count - out) {
            let byte = *segment.get(if repeat { at } else { at + i })?;
            let sample = samples.get_mut(out + i)?;
            *sample = (*sample << 8) | u32::from(byte);
        }
        at += if repeat { 1 } else { length };
        out += length;
    }
    Some(())
}

/// Most zero bytes that are dropped before the end-of-image marker.
const MOST_ZEROS: usize = 3;

/// A frame without the bytes that programs pad it with, to even length or further: 00, 20 (a text's padding)
/// or ff (T.81 B.1.1.2 allows it before a marker).
pub(super) fn without_padding(data: &[u8]) -> &[u8] {
    let padding = data.iter().rev().take_while(|byte| matches!(byte, 0 | b' ' | 0xff)).count();
    &data[..data.len() - padding]
}

/// Size of a frame as stated in its own header.
pub(super) struct StatedSize {
    pub rows: usize,
    pub columns: usize,
}

/// Checks that the data are complete and large enough for the pixels of `shape`; `stated` is the size in the
/// frame's own header.
pub(super) fn check_frame(
    path: &Path,
    codec: &'static str,
    data: &[u8],
    stated: StatedSize,
    shape: Shape,
    most_pixels: u64,
) -> Result<(), VolumeError> {
    let StatedSize { rows, columns } = stated;
    if (rows, columns) != (shape.rows, shape.columns) {
        let reason = format!(
            "{rows} x {columns} pixels in the frame, {} x {} in the header",
            shape.rows, shape.columns
        );
        return Err(corrupt(path, codec, reason));
    }
    // If data are missing, decoders invent pixels, and allocate them first.
    let pixels = shape.count() as u64;
    if pixels > most_pixels {
        return Err(corrupt(path, codec, format!("{} bytes cannot hold {pixels} pixels", data.len())));
    }
    // The end-of-image marker (EOI).
    if !data.ends_with(&[0xff, 0xd9]) {
        return Err(corrupt(path, codec, "the data end without an end-of-image marker"));
    }
    Ok(())
}

fn run_limit(data: &[u8]) -> u64 {
    data.len() as u64 * RUN_PIXELS_PER_BYTE + RUN_FREE_PIXELS
}

/// A frame header of JPEG or JPEG-LS.
struct FrameHeader {
    marker: u8,
    bits: u8,
    rows: usize,
    columns: usize,
    components: u8,
}

impl FrameHeader {
    fn size(&self) -> StatedSize {
        StatedSize { rows: self.rows, columns: self.columns }
    }
}

/// The segments up to the scan: marker and content of each. `None` if the chain of segments is broken.
fn segments(data: &[u8]) -> Option<Vec<(u8, &[u8])>> {
    let mut out = Vec::new();
    let mut at = 2;
    if !data.starts_with(&[0xff, 0xd8]) {
        return None;
    }
    loop {
        // Fill bytes may precede a marker (T.81 B.1.1.2).
        while data.get(at) == Some(&0xff) && data.get(at + 1) == Some(&0xff) {
            at += 1;
        }
        let [0xff, marker, high, low] = *data.get(at..)?.first_chunk::<4>()? else { return None };
        let length = usize::from(u16::from_be_bytes([high, low]));
        out.push((marker, data.get(at + 4..(at + 2).checked_add(length)?)?));
        if marker == START_OF_SCAN {
            return Some(out);
        }
        at += 2 + length;
    }
}

fn frame_header(segments: &[(u8, &[u8])]) -> Option<FrameHeader> {
    let is_frame = |marker: u8| {
        (matches!(marker, 0xc0..=0xcf) && ![0xc4, 0xc8, 0xcc].contains(&marker)) || marker == JPEG_LS_FRAME
    };
    let (marker, content) = segments.iter().find(|(marker, _)| is_frame(*marker))?;
    let [bits, y1, y0, x1, x0, components, ..] = **content else { return None };
    Some(FrameHeader {
        marker: *marker,
        bits,
        rows: usize::from(u16::from_be_bytes([y1, y0])),
        columns: usize::from(u16::from_be_bytes([x1, x0])),
        components,
    })
}

/// JPEG baseline, extended (8 and 12 bits) and lossless, one frame.
pub(super) fn jpeg(path: &Path, data: &[u8], shape: Shape) -> Result<Vec<u32>, VolumeError> {
    use jpeg_decoder::PixelFormat;
    let data = without_padding(data);
    let header = segments(data).as_deref().and_then(frame_header);
    let header = header.ok_or_else(|| corrupt(path, "JPEG", "no image header"))?;
    let most = data.len() as u64 * JPEG_PIXELS_PER_BYTE;
    if header.marker == EXTENDED_SEQUENTIAL && header.bits == 12 {
        check_frame(path, "JPEG", data, header.size(), shape, most)?;
        return jpeg_of_12_bits(path, data);
    }
    let mut decoder = jpeg_decoder::Decoder::new(data);
    decoder.read_info().map_err(|e| corrupt(path, "JPEG", e.to_string()))?;
    let info = decoder.info().ok_or_else(|| corrupt(path, "JPEG", "no image header"))?;
    let wide = match info.pixel_format {
        PixelFormat::L8 => false,
        PixelFormat::L16 => true,
        other => return Err(corrupt(path, "JPEG", format!("{other:?} pixels in a greyscale image"))),
    };
    let size = StatedSize { rows: usize::from(info.height), columns: usize::from(info.width) };
    check_frame(path, "JPEG", data, size, shape, most)?;
    let bytes = decoder.decode().map_err(|e| corrupt(path, "JPEG", e.to_string()))?;
    Ok(if wide {
        // The decoder returns 16-bit samples in the machine's byte order.
        bytes.chunks_exact(2).map(|b| u32::from(u16::from_ne_bytes([b[0], b[1]]))).collect()
    } else {
        bytes.iter().map(|b| u32::from(*b)).collect()
    })
}

fn jpeg_of_12_bits(path: &Path, data: &[u8]) -> Result<Vec<u32>, VolumeError> {
    let image = libjpeg_turbo_rs::precision::decompress_12bit(data)
        .map_err(|e| corrupt(path, "JPEG", e.to_string()))?;
    if image.num_components != 1 {
        return Err(corrupt(
            path,
            "JPEG",
            format!("{} components in a greyscale image", image.num_components),
        ));
    }
    // Samples are 0 to 4095.
    Ok(image.data.iter().map(|sample| u32::from(sample.unsigned_abs())).collect())
}

/// JPEG-LS (ITU-T T.87), lossless and near-lossless, one component.
pub(super) fn jpeg_ls(path: &Path, data: &[u8], shape: Shape) -> Result<Vec<u32>, VolumeError> {
    let fail = |reason: &str| corrupt(path, "JPEG-LS", reason);
    let data = without_padding(data);
    let parts = segments(data).ok_or_else(|| fail("broken chain of segments before the scan"))?;
    let header = frame_header(&parts).filter(|header| header.marker == JPEG_LS_FRAME);
    let header = header.ok_or_else(|| fail("no frame header"))?;
    if header.components != 1 || !(2..=16).contains(&header.bits) {
        let reason = format!("{} components of {} bits in a greyscale image", header.components, header.bits);
        return Err(fail(&reason));
    }
    check_frame(path, "JPEG-LS", data, header.size(), shape, run_limit(data))?;
    check_presets(&parts, header.bits).ok_or_else(|| fail("parameters out of the ranges of ITU-T T.87"))?;
    let (columns, rows) = (header.columns as u32, header.rows as u32);
    let decode = |data: &[u8]| jpegls::decode(data, columns, rows).map(|(samples, ..)| samples);
    let mut decoded = decode(data);
    // Some programs pad to even length before the end-of-image marker, where the decoder expects nothing.
    let (body, end) = data.split_at(data.len() - 2);
    let zeros = body.iter().rev().take_while(|byte| **byte == 0).count().min(MOST_ZEROS);
    for dropped in 1..=zeros {
        if decoded.is_ok() {
            break;
        }
        decoded = decode(&[&body[..body.len() - dropped], end].concat()).or(decoded);
    }
    let samples = decoded.map_err(|e| fail(&e.to_string()))?;
    Ok(samples.into_iter().map(u32::from).collect())
}

/// Checks what the decoder does not: the scan's parameters and the presets (T.87, tables C.1 and C.3, section
/// C.2.4.1.1).
fn check_presets(parts: &[(u8, &[u8])], bits: u8) -> Option<()> {
    let (_, scan) = parts.iter().find(|(marker, _)| *marker == START_OF_SCAN)?;
    // One component, its number and table; NEAR, interleave, point transform.
    let [1, _, _, near, 0, 0] = **scan else { return None };
    let mut max = (1_u32 << bits) - 1;
    for (_, content) in parts.iter().filter(|(marker, _)| *marker == JPEG_LS_PRESETS) {
        let [1, values @ ..] = *content else { return None };
        let values: Vec<u32> =
            values.chunks_exact(2).map(|b| u32::from(u16::from_be_bytes([b[0], b[1]]))).collect();
        let [given_max, t1, t2, t3, reset] = *values.as_slice() else { return None };
        // Zero means the default.
        max = if given_max == 0 { max } else { given_max };
        let or = |value: u32, default: u32| if value == 0 { default } else { value };
        let low = u32::from(near) + 1;
        let (t1, t2, t3) = (or(t1, low), or(t2, or(t1, low)), or(t3, max));
        let ordered = low <= t1 && t1 <= t2 && t2 <= t3 && t3 <= max && max < 1 << bits;
        if !ordered || (reset != 0 && !(3..=max.max(255)).contains(&reset)) {
            return None;
        }
    }
    (u32::from(near) <= 255.min(max / 2)).then_some(())
}
