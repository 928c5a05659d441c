//! One DICOM file of a CT series: the header fields needed, and its pixels.

use crate::dicom_scan::{PixelCodec, Transfer, scan};
use crate::error::VolumeError;
use crate::input;
use crate::scalar::{HuSink, Scale};
use dicom_object::file::ReadPreamble;
use dicom_object::mem::InMemDicomObject;
use dicom_object::{DefaultDicomObject, OpenFileOptions, Tag};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest DICOM file accepted: one slice of 16 384 × 16 384 16-bit pixels.
const MAX_FILE_BYTES: u64 = 1 << 29;

const PIXEL_DATA: Tag = Tag(0x7fe0, 0x0010);

/// A slice's header, not yet checked against other slices. Lengths in millimetres, as in DICOM.
#[derive(Clone, Debug)]
pub(crate) struct Slice {
    pub path: PathBuf,
    pub transfer: Transfer,
    pub series_uid: String,
    pub modality: String,
    pub rows: usize,
    pub columns: usize,
    pub position_mm: [f64; 3],
    /// Direction of increasing column index, then of increasing row index, LPS.
    pub orientation: [f64; 6],
    /// Distance between rows, then between columns.
    pub pixel_spacing_mm: [f64; 2],
    pub slice_thickness_mm: Option<f64>,
    pub gantry_tilt_deg: Option<f64>,
    pub scale: Scale,
    bits: Bits,
}

#[derive(Clone, Copy, Debug)]
struct Bits {
    allocated: u32,
    stored: u32,
    high: u32,
    signed: bool,
}

/// Reads and checks the header of a slice. `None` for a DICOM file that is not an image (a report, a structure set).
pub(crate) fn read_header(path: &Path) -> Result<Option<Slice>, VolumeError> {
    let bytes = read_bytes(path)?;
    let transfer = scan(path, &bytes)?;
    let object = parse(path, &bytes, true)?;
    let fields = Fields { path, object: &object };
    if fields.text(Tag(0x0028, 0x0010))?.is_none() || fields.text(Tag(0x0028, 0x0011))?.is_none() {
        return Ok(None);
    }
    fields.refuse_other_layouts()?;
    let size = |tag, name| -> Result<usize, VolumeError> {
        let value = fields.number(tag, name)?;
        let whole = (1.0..=65535.0).contains(&value).then_some(value as usize);
        whole.ok_or_else(|| fields.wrong(tag, name, value.to_string(), "1 to 65535"))
    };
    let slope = fields.optional(Tag(0x0028, 0x1053), "RescaleSlope")?.unwrap_or(1.0);
    let intercept = fields.optional(Tag(0x0028, 0x1052), "RescaleIntercept")?.unwrap_or(0.0);
    Ok(Some(Slice {
        path: path.into(),
        transfer,
        series_uid: fields.text(Tag(0x0020, 0x000e))?.unwrap_or_default(),
        modality: fields.text(Tag(0x0008, 0x0060))?.unwrap_or_default(),
        rows: size(Tag(0x0028, 0x0010), "Rows")?,
        columns: size(Tag(0x0028, 0x0011), "Columns")?,
        position_mm: fields.numbers(Tag(0x0020, 0x0032), "ImagePositionPatient")?,
        orientation: fields.numbers(Tag(0x0020, 0x0037), "ImageOrientationPatient")?,
        pixel_spacing_mm: fields.numbers(Tag(0x0028, 0x0030), "PixelSpacing")?,
        slice_thickness_mm: fields.optional(Tag(0x0018, 0x0050), "SliceThickness")?,
        gantry_tilt_deg: fields.optional(Tag(0x0018, 0x1120), "GantryDetectorTilt")?,
        scale: Scale::checked(
            path,
            "(0028,1053) RescaleSlope, (0028,1052) RescaleIntercept",
            slope,
            intercept,
        )?,
        bits: fields.bits()?,
    }))
}

/// The series of a DICOM file; `None` if it cannot be determined.
pub(crate) fn series_of(path: &Path) -> Option<String> {
    let bytes = read_bytes(path).ok()?;
    scan(path, &bytes).ok()?;
    let object = parse(path, &bytes, true).ok()?;
    Fields { path, object: &object }.text(Tag(0x0020, 0x000e)).ok().flatten()
}

/// Appends the pixels of a slice in Hounsfield units, row by row.
pub(crate) fn read_pixels(slice: &Slice, sink: &mut HuSink) -> Result<(), VolumeError> {
    let path = slice.path.as_path();
    let bytes = read_bytes(path)?;
    scan(path, &bytes)?;
    let object = parse(path, &bytes, false)?;
    let samples = stored_samples(slice, &object)?;
    let count = slice.rows * slice.columns;
    if samples.len() < count {
        let width = u64::from(slice.bits.allocated / 8);
        return Err(VolumeError::Truncated {
            path: path.into(),
            field: "(7fe0,0010) PixelData".into(),
            given_bytes: samples.len() as u64 * width,
            expected_bytes: count as u64 * width,
        });
    }
    for sample in samples.iter().take(count) {
        sink.push(slice.bits.value(*sample), slice.scale);
    }
    Ok(())
}

impl Bits {
    /// The number in a stored sample: the bits up to and including `high`, sign-extended if signed; drops overlay bits above.
    fn value(self, sample: u16) -> f64 {
        let shifted = u32::from(sample) >> (self.high + 1 - self.stored);
        let bits = shifted & ((1 << self.stored) - 1);
        let sign = 1 << (self.stored - 1);
        let number =
            if self.signed && bits & sign != 0 { bits as i32 - (1 << self.stored) } else { bits as i32 };
        f64::from(number)
    }
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, VolumeError> {
    let (file, length) = input::open(path)?;
    if length > MAX_FILE_BYTES {
        return Err(VolumeError::Unsupported {
            path: path.into(),
            field: "file size".into(),
            given: format!("{length} bytes"),
            expected: format!("at most {MAX_FILE_BYTES} bytes a slice"),
        });
    }
    let mut bytes = Vec::with_capacity(length as usize);
    file.take(length).read_to_end(&mut bytes).map_err(input::io_error(path, "read"))?;
    Ok(bytes)
}

fn parse(path: &Path, bytes: &[u8], header_only: bool) -> Result<DefaultDicomObject, VolumeError> {
    let mut options = OpenFileOptions::new().read_preamble(ReadPreamble::Always);
    if header_only {
        options = options.read_until(PIXEL_DATA);
    }
    options.from_reader(bytes).map_err(|error| VolumeError::Header {
        path: path.into(),
        field: "data set".into(),
        given: chain(&error),
        expected: "a well-formed DICOM data set".into(),
    })
}

/// An error and its causes on one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text.push_str(": ");
        text.push_str(&inner.to_string());
        cause = inner.source();
    }
    text
}

struct Fields<'a> {
    path: &'a Path,
    object: &'a InMemDicomObject,
}

impl Fields<'_> {
    fn wrong(&self, tag: Tag, name: &str, given: String, expected: &str) -> VolumeError {
        VolumeError::Header {
            path: self.path.into(),
            field: format!("({:04x},{:04x}) {name}", tag.group(), tag.element()),
            given,
            expected: expected.into(),
        }
    }

    /// The value as text; `None` if the element is absent or empty.
    fn text(&self, tag: Tag) -> Result<Option<String>, VolumeError> {
        let Ok(element) = self.object.element(tag) else { return Ok(None) };
        match element.to_str() {
            Ok(text) => {
                let text = text.trim_end_matches('\0').trim();
                Ok((!text.is_empty()).then(|| text.to_string()))
            }
            Err(error) => Err(self.wrong(tag, "", chain(&error), "a value")),
        }
    }

    fn numbers<const N: usize>(&self, tag: Tag, name: &str) -> Result<[f64; N], VolumeError> {
        let expected = format!("{N} finite numbers");
        let Some(text) = self.text(tag)? else {
            return Err(self.wrong(tag, name, "nothing".into(), &expected));
        };
        let parsed: Option<Vec<f64>> =
            text.split('\\').map(|word| word.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
        let array = parsed.and_then(|values| <[f64; N]>::try_from(values).ok());
        array.ok_or_else(|| self.wrong(tag, name, format!("`{text}`"), &expected))
    }

    fn number(&self, tag: Tag, name: &str) -> Result<f64, VolumeError> {
        self.numbers::<1>(tag, name).map(|[value]| value)
    }

    fn optional(&self, tag: Tag, name: &str) -> Result<Option<f64>, VolumeError> {
        if self.text(tag)?.is_none() { Ok(None) } else { self.number(tag, name).map(Some) }
    }

    /// Refuses colour images, multiple frames and transformed values before reading any pixel.
    fn refuse_other_layouts(&self) -> Result<(), VolumeError> {
        let samples = self.optional(Tag(0x0028, 0x0002), "SamplesPerPixel")?.unwrap_or(1.0);
        let photometric = self.text(Tag(0x0028, 0x0004))?.unwrap_or_else(|| "MONOCHROME2".into());
        if samples != 1.0 || !photometric.starts_with("MONOCHROME") {
            return Err(VolumeError::NotScalar {
                path: self.path.into(),
                field: "(0028,0002) SamplesPerPixel, (0028,0004) PhotometricInterpretation".into(),
                given: format!("{samples}, {photometric}"),
            });
        }
        let frames = self.optional(Tag(0x0028, 0x0008), "NumberOfFrames")?.unwrap_or(1.0);
        if frames != 1.0 {
            return Err(VolumeError::Unsupported {
                path: self.path.into(),
                field: "(0028,0008) NumberOfFrames".into(),
                given: frames.to_string(),
                expected: "one slice a file; convert an enhanced multi-frame CT to NIfTI or to single slices"
                    .into(),
            });
        }
        if self.object.element(Tag(0x0028, 0x3000)).is_ok() {
            return Err(VolumeError::Unsupported {
                path: self.path.into(),
                field: "(0028,3000) ModalityLUTSequence".into(),
                given: "a look-up table".into(),
                expected: "RescaleSlope and RescaleIntercept".into(),
            });
        }
        Ok(())
    }

    fn bits(&self) -> Result<Bits, VolumeError> {
        let allocated = self.number(Tag(0x0028, 0x0100), "BitsAllocated")?;
        if allocated != 8.0 && allocated != 16.0 {
            return Err(VolumeError::Unsupported {
                path: self.path.into(),
                field: "(0028,0100) BitsAllocated".into(),
                given: allocated.to_string(),
                expected: "8 or 16".into(),
            });
        }
        let stored = self.optional(Tag(0x0028, 0x0101), "BitsStored")?.unwrap_or(allocated);
        let high = self.optional(Tag(0x0028, 0x0102), "HighBit")?.unwrap_or(stored - 1.0);
        let signed = self.optional(Tag(0x0028, 0x0103), "PixelRepresentation")?.unwrap_or(0.0);
        let valid = (1.0..=allocated).contains(&stored) && (stored - 1.0..allocated).contains(&high);
        if !valid || (signed != 0.0 && signed != 1.0) || stored.fract() != 0.0 || high.fract() != 0.0 {
            return Err(self.wrong(
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
}

/// The samples as stored, one u16 each, decompressed if necessary.
fn stored_samples(slice: &Slice, object: &DefaultDicomObject) -> Result<Vec<u16>, VolumeError> {
    use dicom_core::value::{PrimitiveValue, Value};
    let path = slice.path.as_path();
    let wrong = |given: String, expected: &str| VolumeError::Header {
        path: path.into(),
        field: "(7fe0,0010) PixelData".into(),
        given,
        expected: expected.into(),
    };
    let element =
        object.element(PIXEL_DATA).map_err(|_| wrong("nothing".into(), "the pixels of the slice"))?;
    let wide = slice.bits.allocated == 16;
    match (element.value(), slice.transfer.codec) {
        (Value::Primitive(value), PixelCodec::Native) => {
            use PrimitiveValue::{U8, U16};
            // OW is read as words in the right byte order, OB as bytes; either may hold 8- or 16-bit samples.
            match (value, wide) {
                (U16(words), true) => Ok(words.to_vec()),
                (U16(words), false) => {
                    Ok(words.iter().flat_map(|w| w.to_le_bytes()).map(u16::from).collect())
                }
                (U8(bytes), true) => {
                    Ok(bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect())
                }
                (U8(bytes), false) => Ok(bytes.iter().map(|b| u16::from(*b)).collect()),
                _ => Err(wrong("values that are neither bytes nor words".into(), "OB or OW")),
            }
        }
        (Value::PixelSequence(sequence), PixelCodec::Rle) => match sequence.fragments() {
            [fragment] => decode_rle(fragment, slice.rows * slice.columns, wide)
                .ok_or_else(|| corrupt(path, "RLE", "the segments do not hold the pixels".into())),
            other => {
                Err(wrong(format!("{} fragments", other.len()), "one fragment for the one frame of a slice"))
            }
        },
        (Value::PixelSequence(sequence), PixelCodec::Jpeg) => {
            decode_jpeg(slice, &sequence.fragments().concat())
        }
        (_, codec) => Err(wrong(format!("pixels that do not fit {codec:?} encoding"), slice.transfer.name)),
    }
}

fn corrupt(path: &Path, codec: &'static str, reason: String) -> VolumeError {
    VolumeError::Corrupt { path: path.into(), codec, reason }
}

/// RLE lossless (PS3.5 annex G): a header of 16 u32, then one PackBits segment a byte plane, most significant first.
fn decode_rle(fragment: &[u8], count: usize, wide: bool) -> Option<Vec<u16>> {
    let word = |i: usize| Some(u32::from_le_bytes(fragment.get(4 * i..4 * i + 4)?.try_into().ok()?) as usize);
    let planes = if wide { 2 } else { 1 };
    if word(0)? != planes {
        return None;
    }
    // PackBits turns 128 bytes into 2 at best, so a header cannot promise more than that.
    if count > fragment.len().checked_mul(128)? {
        return None;
    }
    let mut samples = vec![0_u16; count];
    for plane in 0..planes {
        let start = word(1 + plane)?;
        let end = if plane + 1 < planes { word(2 + plane)? } else { fragment.len() };
        let segment = fragment.get(start..end)?;
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
                *sample = (*sample << 8) | u16::from(byte);
            }
            at += if repeat { 1 } else { length };
            out += length;
        }
    }
    Some(samples)
}

/// Most pixels per byte of JPEG data: 8 in a lossless image, where every pixel takes at least a bit; 512 in one coded in blocks of 64,
/// where a block's first coefficient takes at least a bit (ITU-T T.81, annexes F to H).
const JPEG_PIXELS_PER_BYTE: u64 = 512;

/// Whether the data end with the end-of-image marker (EOI, `ff d9`). A fragment is padded to an even length, by some programs further.
fn is_ended(data: &[u8]) -> bool {
    let padding = data.iter().rev().take_while(|byte| **byte == 0).count();
    data[..data.len() - padding].ends_with(&[0xff, 0xd9])
}

/// JPEG baseline, extended and lossless, one frame.
fn decode_jpeg(slice: &Slice, data: &[u8]) -> Result<Vec<u16>, VolumeError> {
    use jpeg_decoder::PixelFormat;
    let path = slice.path.as_path();
    let mut decoder = jpeg_decoder::Decoder::new(data);
    decoder.read_info().map_err(|e| corrupt(path, "JPEG", e.to_string()))?;
    let info = decoder.info().ok_or_else(|| corrupt(path, "JPEG", "no image header".into()))?;
    let size = (usize::from(info.height), usize::from(info.width));
    let wide = match info.pixel_format {
        PixelFormat::L8 => false,
        PixelFormat::L16 => true,
        other => return Err(corrupt(path, "JPEG", format!("{other:?} pixels in a grey image"))),
    };
    if size != (slice.rows, slice.columns) {
        let reason = format!(
            "{} x {} pixels inside, {} x {} in the header",
            size.0, size.1, slice.rows, slice.columns
        );
        return Err(corrupt(path, "JPEG", reason));
    }
    // If data are missing, the decoder invents pixels, and allocates them first.
    let pixels = slice.rows as u64 * slice.columns as u64;
    if pixels > data.len() as u64 * JPEG_PIXELS_PER_BYTE {
        let reason = format!("{} bytes cannot hold {pixels} pixels", data.len());
        return Err(corrupt(path, "JPEG", reason));
    }
    if !is_ended(data) {
        return Err(corrupt(path, "JPEG", "the data end without the mark of their end".into()));
    }
    let bytes = decoder.decode().map_err(|e| corrupt(path, "JPEG", e.to_string()))?;
    Ok(if wide {
        // The decoder returns 16-bit samples in the machine's byte order.
        bytes.chunks_exact(2).map(|b| u16::from_ne_bytes([b[0], b[1]])).collect()
    } else {
        bytes.iter().map(|b| u16::from(*b)).collect()
    })
}
