//! Converts stored numbers to Hounsfield units: voxel types, byte orders, scaling, rounding, clamping.

use crate::error::VolumeError;
use crate::input::{self, Codec, read_full};
use std::io::Read;
use std::path::Path;

/// A stored voxel type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

/// A stored byte order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Endian {
    Little,
    Big,
}

impl Endian {
    pub fn name(self) -> &'static str {
        match self {
            Endian::Little => "little-endian",
            Endian::Big => "big-endian",
        }
    }
}

impl Scalar {
    /// Bytes per voxel.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Scalar::I8 => "int8",
            Scalar::U8 => "uint8",
            Scalar::I16 => "int16",
            Scalar::U16 => "uint16",
            Scalar::I32 => "int32",
            Scalar::U32 => "uint32",
            Scalar::I64 => "int64",
            Scalar::U64 => "uint64",
            Scalar::F32 => "float32",
            Scalar::F64 => "float64",
        }
    }

    /// Name, with the byte order if it matters.
    pub fn describe(self, endian: Endian) -> String {
        if self.size() == 1 { self.name().into() } else { format!("{} {}", self.name(), endian.name()) }
    }

    /// Appends the little-endian numbers in `bytes`; 64-bit integers are rounded to f64.
    fn append(self, bytes: &[u8], scale: Scale, sink: &mut HuSink) {
        match self {
            // The usual CT: nothing to scale, round or clamp.
            Scalar::I16 if scale == Scale::IDENTITY && sink.grey.is_none() => {
                sink.hu.extend(bytes.as_chunks().0.iter().map(|b| i16::from_le_bytes(*b)));
            }
            Scalar::I8 => sink.extend(bytes, scale, |b: [u8; 1]| f64::from(i8::from_le_bytes(b))),
            Scalar::U8 => sink.extend(bytes, scale, |[byte]| f64::from(byte)),
            Scalar::I16 => sink.extend(bytes, scale, |b| f64::from(i16::from_le_bytes(b))),
            Scalar::U16 => sink.extend(bytes, scale, |b| f64::from(u16::from_le_bytes(b))),
            Scalar::I32 => sink.extend(bytes, scale, |b| f64::from(i32::from_le_bytes(b))),
            Scalar::U32 => sink.extend(bytes, scale, |b| f64::from(u32::from_le_bytes(b))),
            Scalar::F32 => sink.extend(bytes, scale, |b| f64::from(f32::from_le_bytes(b))),
            Scalar::I64 => sink.extend(bytes, scale, |b| i64::from_le_bytes(b) as f64),
            Scalar::U64 => sink.extend(bytes, scale, |b| u64::from_le_bytes(b) as f64),
            Scalar::F64 => sink.extend(bytes, scale, f64::from_le_bytes),
        }
    }
}

/// Conversion HU = slope × stored + intercept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scale {
    pub slope: f64,
    pub intercept: f64,
}

impl Scale {
    pub const IDENTITY: Self = Self { slope: 1.0, intercept: 0.0 };

    fn of(self, value: f64) -> f64 {
        if self == Scale::IDENTITY { value } else { self.slope * value + self.intercept }
    }

    /// Refuses a slope of zero and any non-finite number.
    pub fn checked(path: &Path, field: &str, slope: f64, intercept: f64) -> Result<Self, VolumeError> {
        if slope.is_finite() && intercept.is_finite() && slope != 0.0 {
            return Ok(Self { slope, intercept });
        }
        Err(VolumeError::header(
            path,
            field,
            format!("slope {slope}, intercept {intercept}"),
            "finite numbers and a slope that is not zero",
        ))
    }
}

/// Collects voxels as `i16` and counts those that had to be changed.
#[derive(Debug, Default)]
pub(crate) struct HuSink {
    pub hu: Vec<i16>,
    /// From scaled values to Hounsfield units; `None` if they are Hounsfield units.
    grey: Option<Scale>,
    clamped: u64,
    rounded: u64,
    not_a_number: u64,
    padding: u64,
}

/// Hounsfield units of air.
const AIR_HU: i16 = -1000;

impl HuSink {
    /// Creates an empty sink that converts scaled values to Hounsfield units.
    pub fn converting(grey: Option<Scale>) -> HuSink {
        HuSink { grey, ..HuSink::default() }
    }

    /// Appends one stored number. Halves round away from zero; NaN becomes air.
    pub fn push(&mut self, stored: f64, scale: Scale) {
        let value = self.hu_of(stored, scale);
        // Most numbers are integer HU already.
        let direct = value as i16;
        if f64::from(direct) == value {
            self.hu.push(direct);
            return;
        }
        if value.is_nan() {
            self.not_a_number += 1;
            self.hu.push(AIR_HU);
            return;
        }
        let whole = libm::round(value);
        let kept = whole.clamp(f64::from(i16::MIN), f64::from(i16::MAX));
        if kept != whole {
            self.clamped += 1;
        } else if whole != value {
            self.rounded += 1;
        }
        self.hu.push(kept as i16);
    }

    fn hu_of(&self, stored: f64, scale: Scale) -> f64 {
        let value = scale.of(stored);
        self.grey.map_or(value, |grey| grey.of(value))
    }

    /// Appends a stored number that its file declares to be padding: air, where it would be denser.
    pub fn push_padding(&mut self, stored: f64, scale: Scale) {
        if self.hu_of(stored, scale) <= f64::from(AIR_HU) {
            return self.push(stored, scale);
        }
        self.padding += 1;
        self.hu.push(AIR_HU);
    }

    /// Appends numbers of `N` bytes each.
    fn extend<const N: usize>(&mut self, bytes: &[u8], scale: Scale, number: impl Fn([u8; N]) -> f64) {
        for &chunk in bytes.as_chunks().0 {
            self.push(number(chunk), scale);
        }
    }

    /// Reserves memory for `count` more voxels.
    ///
    /// # Errors
    /// `Memory` if there is too little.
    fn reserve(&mut self, path: &Path, count: usize, all: usize) -> Result<(), VolumeError> {
        self.hu.try_reserve(count).map_err(|_| VolumeError::Memory {
            path: path.into(),
            voxels: all,
            needed_bytes: (all * size_of::<i16>()) as u64,
        })
    }

    /// Returns the voxels; adds a note for each kind of change.
    pub fn finish(self, notes: &mut Vec<String>) -> Vec<i16> {
        if let Some(Scale { slope, intercept }) = self.grey {
            notes.push(format!("Hounsfield units are {slope} x the file's values + {intercept}"));
        }
        let mut note = |count: u64, what: &str| {
            if count > 0 {
                notes.push(format!("{count} of {} voxels {what}", self.hu.len()));
            }
        };
        note(self.clamped, "were outside -32768..32767 and were clamped");
        note(self.rounded, "were rounded to integer HU");
        note(self.not_a_number, "were not a number and were set to -1000 HU");
        note(self.padding, "were padding (PixelPaddingValue) and were set to -1000 HU");
        self.hu
    }
}

/// How voxels are stored.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    pub scalar: Scalar,
    pub endian: Endian,
    pub scale: Scale,
}

impl Layout {
    /// Size of `count` voxels in bytes; `count` is at most [`voxel_grid::MAX_VOXELS`], so this cannot
    /// overflow.
    pub fn byte_count(self, count: usize) -> u64 {
        count as u64 * self.scalar.size() as u64
    }

    /// Reads `count` voxels of a data file into `sink`, from after `skip` decoded bytes to the end of the
    /// file. `field` is the header field that gives their number.
    pub fn read_file(
        self,
        (path, start, codec): (&Path, u64, Codec),
        skip: u64,
        (field, count): (&str, usize),
        sink: &mut HuSink,
        notes: &mut Vec<String>,
    ) -> Result<(), VolumeError> {
        let needed = skip.saturating_add(self.byte_count(count));
        let (mut reader, most) = input::open_stream(path, start, codec)?;
        if codec == Codec::Bzip2 && most < needed {
            let voxels = self.byte_count(count);
            return Err(VolumeError::unsupported(
                path,
                "encoding",
                format!("bzip2 data that would expand to {voxels} bytes of voxels"),
                "data that expand by a factor of at most 10000; store it as raw or gzip",
            ));
        }
        input::check_length(path, most, needed)?;
        input::skip(path, codec.name(), reader.as_mut(), skip)?;
        self.read(path, codec.name(), reader.as_mut(), count, sink)?;
        input::check_end(path, codec, reader.as_mut(), (field, needed, most), notes)
    }

    /// Reads `count` voxels from a stream into `sink`; memory grows with the data read, not with the size a
    /// header promises.
    pub fn read(
        self,
        path: &Path,
        codec: &'static str,
        reader: &mut dyn Read,
        count: usize,
        sink: &mut HuSink,
    ) -> Result<(), VolumeError> {
        let size = self.scalar.size();
        // A raw file's length has been checked already; a compressed stream may still hold less than its
        // upper bound.
        if codec == Codec::Raw.name() {
            sink.reserve(path, count, count)?;
        }
        let mut buffer = vec![0_u8; 1 << 16];
        let mut left = count;
        while left > 0 {
            let wanted = left.min(buffer.len() / size) * size;
            let got = read_full(path, codec, reader, &mut buffer[..wanted])?;
            if got < wanted {
                return Err(VolumeError::truncated(
                    path,
                    "voxel data",
                    [self.byte_count(count - left) + got as u64, self.byte_count(count)],
                ));
            }
            if self.endian == Endian::Big && size > 1 {
                buffer[..wanted].chunks_exact_mut(size).for_each(<[u8]>::reverse);
            }
            sink.reserve(path, wanted / size, count)?;
            self.scalar.append(&buffer[..wanted], self.scale, sink);
            left -= wanted / size;
        }
        Ok(())
    }
}
