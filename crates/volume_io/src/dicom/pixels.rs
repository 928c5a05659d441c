//! Decodes the pixels of one frame.

use super::codec;
use super::elements::Tag;
use super::fields::Fields;
use super::file::DicomFile;
use super::jpeg2000;
use super::scan::{PixelCodec, Pixels};
use super::slice::Slice;
use crate::error::VolumeError;
use crate::input::Codec;
use crate::scalar::{Endian, HuSink, Layout};
use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;

const FIELD: &str = "(7fe0,0010) PixelData";

/// Rows, columns and bytes per sample of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    pub rows: usize,
    pub columns: usize,
    /// 1, 2 or 4.
    pub bytes: u32,
}

impl Shape {
    pub fn count(self) -> usize {
        self.rows * self.columns
    }
}

/// How an integer sample is stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bits {
    pub allocated: u32,
    pub stored: u32,
    high: u32,
    pub signed: bool,
}

impl Bits {
    /// Reads BitsAllocated, BitsStored, HighBit and PixelRepresentation; not used for float pixels.
    pub fn of(fields: Fields<'_>) -> Result<Bits, VolumeError> {
        let allocated = fields.number(Tag(0x0028, 0x0100), "BitsAllocated")?;
        if ![8.0, 16.0, 32.0, 64.0].contains(&allocated) {
            return Err(bad_width(fields.path, allocated));
        }
        let stored = fields.optional(Tag(0x0028, 0x0101), "BitsStored")?.unwrap_or(allocated);
        let high = fields.optional(Tag(0x0028, 0x0102), "HighBit")?.unwrap_or(stored - 1.0);
        let signed = fields.optional(Tag(0x0028, 0x0103), "PixelRepresentation")?.unwrap_or(0.0);
        let valid = (1.0..=allocated).contains(&stored) && (stored - 1.0..allocated).contains(&high);
        if !valid || (signed != 0.0 && signed != 1.0) || stored.fract() != 0.0 || high.fract() != 0.0 {
            return Err(fields.wrong(
                Tag(0x0028, 0x0101),
                "BitsStored, HighBit, PixelRepresentation",
                format!("{stored}, {high}, {signed} of {allocated} bits"),
                "bits within a sample, and 0 or 1",
            ));
        }
        Ok(Bits {
            allocated: allocated as u32,
            stored: stored as u32,
            high: high as u32,
            signed: signed == 1.0,
        })
    }

    /// PixelPaddingValue and PixelPaddingRangeLimit as values of the pixels, in order (PS3.3 C.7.5.1.1.2).
    /// Their VR is that of the pixels, US or SS, but some files have the other, with the same bits.
    pub fn padding(self, fields: Fields<'_>) -> Result<Option<[f64; 2]>, VolumeError> {
        let value = |tag, name| -> Result<Option<f64>, VolumeError> {
            let Some(value) = fields.optional(tag, name)? else { return Ok(None) };
            // One of 16 bits in the other sign; a cast keeps the bits.
            Ok(Some(match (self.signed, value) {
                (true, 32768.0..=65535.0) if self.stored <= 16 => value - 65536.0,
                (false, -32768.0..0.0) if self.stored <= 16 => value + 65536.0,
                (_, value) => value,
            }))
        };
        let Some(first) = value(Tag(0x0028, 0x0120), "PixelPaddingValue")? else { return Ok(None) };
        let second = value(Tag(0x0028, 0x0121), "PixelPaddingRangeLimit")?.unwrap_or(first);
        Ok(Some([first.min(second), first.max(second)]))
    }

    /// The value of a stored sample: the bits up to and including `high`, sign-extended if signed; overlay
    /// bits above are dropped.
    fn value(self, sample: u32) -> f64 {
        let shifted = u64::from(sample) >> (self.high + 1 - self.stored);
        let bits = shifted & ((1 << self.stored) - 1);
        let sign = 1_u64 << (self.stored - 1);
        let number =
            if self.signed && bits & sign != 0 { bits as i64 - (1 << self.stored) } else { bits as i64 };
        number as f64
    }
}

/// Appends the pixels of a slice in Hounsfield units, row by row.
pub(super) fn append(slice: &Slice, file: &DicomFile, sink: &mut HuSink) -> Result<(), VolumeError> {
    let path = slice.path.as_path();
    let Some(pixels) = &file.pixels else {
        return Err(wrong(path, "no pixels".into(), "the pixels of the slice"));
    };
    let shape = Shape { rows: slice.rows, columns: slice.columns, bytes: slice.bits.allocated / 8 };
    if shape.bytes > 4 && !matches!(pixels, Pixels::Floats { .. }) {
        return Err(bad_width(path, slice.bits.allocated));
    }
    let bytes = |range: &Range<usize>| &file.bytes[range.clone()];
    match pixels {
        Pixels::Native { value, words } => {
            if file.transfer.codec != PixelCodec::Native {
                return Err(wrong(path, "uncompressed pixels".into(), file.transfer.name));
            }
            let width = shape.bytes as usize;
            let frame = match *words && file.transfer.big_endian {
                false => Cow::Borrowed(&bytes(value)[frame_of(path, value.len(), slice, width)?]),
                true => Cow::Owned(swapped_frame(path, bytes(value), slice, width)?),
            };
            for sample in frame.chunks_exact(width) {
                let mut word = [0; 4];
                word[..width].copy_from_slice(sample);
                push(slice, u32::from_le_bytes(word), sink);
            }
        }
        Pixels::Floats { value, scalar } => {
            let mut frame = &bytes(value)[frame_of(path, value.len(), slice, scalar.size())?];
            let endian = if file.transfer.big_endian { Endian::Big } else { Endian::Little };
            let layout = Layout { scalar: *scalar, endian, scale: slice.scale };
            layout.read(path, Codec::Raw.name(), &mut frame, shape.count(), sink)?;
        }
        Pixels::Fragments { offsets, fragments } => {
            let parts: Vec<&[u8]> = fragments.iter().map(bytes).collect();
            if file.transfer.codec == PixelCodec::Jpeg2000 {
                let packed = parts.iter().map(|part| part.len() as u64).sum();
                jpeg2000::check_file(path, slice.frames, shape, packed)?;
            }
            let frame = packed_frame(path, slice, bytes(offsets), &parts)?;
            for sample in unpacked(slice, file, &frame, shape)? {
                push(slice, sample, sink);
            }
        }
    }
    Ok(())
}

/// Appends one stored sample; padding becomes air.
fn push(slice: &Slice, sample: u32, sink: &mut HuSink) {
    let value = slice.bits.value(sample);
    match slice.padding {
        Some([low, high]) if (low..=high).contains(&value) => sink.push_padding(value, slice.scale),
        _ => sink.push(value, slice.scale),
    }
}

fn bad_width(path: &Path, allocated: impl ToString) -> VolumeError {
    VolumeError::unsupported(path, "(0028,0100) BitsAllocated", allocated.to_string(), "8, 16 or 32")
}

fn wrong(path: &Path, given: String, expected: &str) -> VolumeError {
    VolumeError::header(path, FIELD, given, expected)
}

/// The slice's frame in a big-endian file, in little-endian order: the words that hold it are swapped.
/// Samples of 32 bits in words have no defined order there.
fn swapped_frame(path: &Path, all: &[u8], slice: &Slice, width: usize) -> Result<Vec<u8>, VolumeError> {
    if width > 2 {
        return Err(wrong(path, "32-bit samples in a big-endian file".into(), "a little-endian file"));
    }
    let words = all.as_chunks::<2>().0;
    let frame = frame_of(path, 2 * words.len(), slice, width)?;
    let first = frame.start / 2;
    let bytes = words[first..frame.end.div_ceil(2)].iter().flat_map(|[high, low]| [*low, *high]);
    Ok(bytes.skip(frame.start - 2 * first).take(frame.len()).collect())
}

/// The place of the slice's frame in uncompressed pixels of `length` bytes.
fn frame_of(path: &Path, length: usize, slice: &Slice, width: usize) -> Result<Range<usize>, VolumeError> {
    let bytes = (slice.rows * slice.columns) as u64 * width as u64;
    let start = slice.frame as u64 * bytes;
    let end = start + bytes;
    if end > length as u64 {
        return Err(VolumeError::truncated(path, FIELD, [length as u64, end]));
    }
    Ok(start as usize..end as usize)
}

/// The compressed data of the slice's frame: all fragments for a single frame, one fragment per frame, or the
/// fragments given by the basic offset table (PS3.5 annex A.4).
fn packed_frame<'a>(
    path: &Path,
    slice: &Slice,
    offsets: &[u8],
    fragments: &[&'a [u8]],
) -> Result<Cow<'a, [u8]>, VolumeError> {
    if slice.frames == 1 {
        return Ok(match fragments {
            [one] => Cow::Borrowed(*one),
            several => Cow::Owned(several.concat()),
        });
    }
    if fragments.len() == slice.frames {
        return Ok(Cow::Borrowed(fragments[slice.frame]));
    }
    let offset = |frame: usize| -> Option<u64> {
        Some(u64::from(u32::from_le_bytes(*offsets.get(4 * frame..)?.first_chunk::<4>()?)))
    };
    let missing = || {
        let given = format!("{} fragments for {} frames", fragments.len(), slice.frames);
        wrong(path, given, "one fragment per frame, or a basic offset table")
    };
    if offsets.len() != 4 * slice.frames {
        return Err(missing());
    }
    let begin = offset(slice.frame).ok_or_else(missing)?;
    let end = offset(slice.frame + 1).unwrap_or(u64::MAX);
    let mut at = 0_u64;
    let mut frame = Vec::new();
    for fragment in fragments {
        if (begin..end).contains(&at) {
            frame.extend_from_slice(fragment);
        }
        // Each follows a tag and a length.
        at += fragment.len() as u64 + 8;
    }
    Ok(Cow::Owned(frame))
}

fn unpacked(slice: &Slice, file: &DicomFile, data: &[u8], shape: Shape) -> Result<Vec<u32>, VolumeError> {
    let path = slice.path.as_path();
    let samples = match file.transfer.codec {
        PixelCodec::Native | PixelCodec::Unsupported => {
            return Err(wrong(path, "compressed pixels".into(), file.transfer.name));
        }
        PixelCodec::Rle => codec::rle(path, data, shape),
        PixelCodec::Jpeg => codec::jpeg(path, data, shape),
        PixelCodec::JpegLs => codec::jpeg_ls(path, data, shape),
        PixelCodec::Jpeg2000 => jpeg2000::jpeg_2000(path, data, shape, slice.bits),
    }?;
    if samples.len() < shape.count() {
        return Err(VolumeError::truncated(
            path,
            FIELD,
            [samples.len() as u64 * u64::from(shape.bytes), shape.count() as u64 * u64::from(shape.bytes)],
        ));
    }
    Ok(samples)
}
