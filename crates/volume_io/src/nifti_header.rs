//! The NIfTI-1 and NIfTI-2 headers: fields, checks and the affine.
//!
//! Sources: nifti1.h and nifti2.h (NIfTI DFWG, 2003 and 2011). Parsed here because the `nifti` crate does not
//! read NIfTI-2 and because every field must be checked before any data is read; the tests compare the result
//! with the `nifti` crate.

use crate::error::{Field, VolumeError};
use crate::scalar::{Endian, Layout, Scalar, Scale};
use std::path::Path;

/// Bytes of a NIfTI-1 header.
pub(crate) const NIFTI1_SIZE: usize = 348;
/// Bytes of a NIfTI-2 header.
pub(crate) const NIFTI2_SIZE: usize = 540;

/// A checked NIfTI header. Geometry is still RAS and in the file's unit.
pub(crate) struct NiftiHeader {
    /// 1 or 2.
    pub version: u8,
    pub endian: Endian,
    pub dims: [usize; 3],
    pub layout: Layout,
    /// Bytes before the voxels.
    pub data_offset: u64,
    /// Whether the voxels follow in the same file (`n+1`, `n+2`) or are in an .img file (`ni1`, `ni2`).
    pub single_file: bool,
    /// Metres per unit.
    pub unit_m: f64,
    pub unit_name: &'static str,
    /// Rows of the voxel-to-RAS affine.
    pub affine: [[f64; 4]; 3],
    pub notes: Vec<String>,
}

/// Version and byte order from the first four bytes.
pub(crate) fn sniff(bytes: &[u8]) -> Option<(u8, Endian)> {
    let first: [u8; 4] = bytes.get(..4)?.try_into().ok()?;
    for endian in [Endian::Little, Endian::Big] {
        let size =
            if endian == Endian::Little { i32::from_le_bytes(first) } else { i32::from_be_bytes(first) };
        match size {
            348 => return Some((1, endian)),
            540 => return Some((2, endian)),
            _ => {}
        }
    }
    None
}

/// Reads fields at byte offsets; bytes past the end read as zero (the caller checks the length first).
struct Fields<'a> {
    bytes: &'a [u8],
    endian: Endian,
}

impl Fields<'_> {
    fn raw<const N: usize>(&self, at: usize) -> [u8; N] {
        let mut out = [0; N];
        if let Some(slice) = self.bytes.get(at..at + N) {
            out.copy_from_slice(slice);
        }
        if self.endian == Endian::Big {
            out.reverse();
        }
        out
    }
    fn i16(&self, at: usize) -> i64 {
        i64::from(i16::from_le_bytes(self.raw(at)))
    }
    fn i32(&self, at: usize) -> i64 {
        i64::from(i32::from_le_bytes(self.raw(at)))
    }
    fn i64(&self, at: usize) -> i64 {
        i64::from_le_bytes(self.raw(at))
    }
    fn f32(&self, at: usize) -> f64 {
        f64::from(f32::from_le_bytes(self.raw(at)))
    }
    fn f64(&self, at: usize) -> f64 {
        f64::from_le_bytes(self.raw(at))
    }
}

/// The fields common to both versions, unchecked.
struct RawHeader {
    magic: [u8; 4],
    dim: [i64; 8],
    datatype: i64,
    bitpix: i64,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    intercept: f64,
    qform_code: i64,
    sform_code: i64,
    quatern: [f64; 3],
    qoffset: [f64; 3],
    srow: [[f64; 4]; 3],
    xyzt_units: i64,
}

impl RawHeader {
    fn version1(f: &Fields) -> Self {
        Self {
            magic: [0, 1, 2, 3].map(|i| f.bytes.get(344 + i).copied().unwrap_or(0)),
            dim: [0, 1, 2, 3, 4, 5, 6, 7].map(|i| f.i16(40 + 2 * i)),
            datatype: f.i16(70),
            bitpix: f.i16(72),
            pixdim: [0, 1, 2, 3, 4, 5, 6, 7].map(|i| f.f32(76 + 4 * i)),
            vox_offset: f.f32(108),
            slope: f.f32(112),
            intercept: f.f32(116),
            xyzt_units: i64::from(f.bytes.get(123).copied().unwrap_or(0)),
            qform_code: f.i16(252),
            sform_code: f.i16(254),
            quatern: [0, 1, 2].map(|i| f.f32(256 + 4 * i)),
            qoffset: [0, 1, 2].map(|i| f.f32(268 + 4 * i)),
            srow: [0, 1, 2].map(|row| [0, 1, 2, 3].map(|i| f.f32(280 + 16 * row + 4 * i))),
        }
    }

    fn version2(f: &Fields) -> Self {
        Self {
            magic: [0, 1, 2, 3].map(|i| f.bytes.get(4 + i).copied().unwrap_or(0)),
            datatype: f.i16(12),
            bitpix: f.i16(14),
            dim: [0, 1, 2, 3, 4, 5, 6, 7].map(|i| f.i64(16 + 8 * i)),
            pixdim: [0, 1, 2, 3, 4, 5, 6, 7].map(|i| f.f64(104 + 8 * i)),
            vox_offset: f.i64(168) as f64,
            slope: f.f64(176),
            intercept: f.f64(184),
            qform_code: f.i32(344),
            sform_code: f.i32(348),
            quatern: [0, 1, 2].map(|i| f.f64(352 + 8 * i)),
            qoffset: [0, 1, 2].map(|i| f.f64(376 + 8 * i)),
            srow: [0, 1, 2].map(|row| [0, 1, 2, 3].map(|i| f.f64(400 + 32 * row + 8 * i))),
            xyzt_units: f.i32(500),
        }
    }
}

/// Reads and checks a header from the first bytes of a file.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<NiftiHeader, VolumeError> {
    let wrong =
        |field: &str, given: String, expected: &str| VolumeError::header(path, field, given, expected);
    let Some((version, endian)) = sniff(bytes) else {
        let given = format!("{:02x?}", bytes.get(..4).unwrap_or(bytes));
        return Err(wrong("sizeof_hdr", given, "348 (NIfTI-1) or 540 (NIfTI-2) in either byte order"));
    };
    let size = if version == 1 { NIFTI1_SIZE } else { NIFTI2_SIZE };
    if bytes.len() < size {
        return Err(VolumeError::truncated(path, "header", [bytes.len() as u64, size as u64]));
    }
    let fields = Fields { bytes, endian };
    let raw = if version == 1 { RawHeader::version1(&fields) } else { RawHeader::version2(&fields) };
    let single_file = match (&raw.magic, version) {
        (b"n+1\0", 1) | (b"n+2\0", 2) => true,
        (b"ni1\0", 1) | (b"ni2\0", 2) => false,
        _ => {
            let given = format!("{:?}", String::from_utf8_lossy(&raw.magic));
            return Err(wrong(
                "magic",
                given,
                "n+1, ni1, n+2 or ni2 (ANALYZE 7.5 has no orientation: convert it to NIfTI)",
            ));
        }
    };
    let scalar = voxel_type(path, raw.datatype)?;
    let mut notes = Vec::new();
    if raw.bitpix == 0 {
        notes.push(format!("bitpix is 0; assuming {}, by the datatype", 8 * scalar.size()));
    } else if raw.bitpix != 8 * scalar.size() as i64 {
        let expected = format!("{} for datatype {}", 8 * scalar.size(), raw.datatype);
        return Err(wrong("bitpix", raw.bitpix.to_string(), &expected));
    }
    let dims = dimensions(path, &raw.dim)?;
    let (unit_m, unit_name) = unit(path, raw.xyzt_units)?;
    let affine = affine(&raw, &mut notes);
    let least = if !single_file {
        0
    } else if version == 1 {
        352
    } else {
        544
    };
    let mut vox_offset = raw.vox_offset;
    if vox_offset == 0.0 && least > 0 {
        vox_offset = f64::from(least);
        notes.push(format!("vox_offset is 0; assuming {least}, the end of the header"));
    }
    let whole = raw.vox_offset.is_finite() && libm::floor(raw.vox_offset) == raw.vox_offset;
    if !(whole && vox_offset >= f64::from(least) && raw.vox_offset <= 1e15) {
        let expected = format!("a whole number of bytes, at least {least}");
        return Err(wrong("vox_offset", raw.vox_offset.to_string(), &expected));
    }
    // nifti1.h: a slope of zero means that no scaling is stored; nibabel treats a NaN slope the same way.
    let scale = if raw.slope == 0.0 || raw.slope.is_nan() {
        Scale::IDENTITY
    } else {
        Scale::checked(path, "scl_slope, scl_inter", raw.slope, raw.intercept)?
    };
    Ok(NiftiHeader {
        version,
        endian,
        dims,
        layout: Layout { scalar, endian, scale },
        data_offset: vox_offset as u64,
        single_file,
        unit_m,
        unit_name,
        affine,
        notes,
    })
}

fn voxel_type(path: &Path, datatype: i64) -> Result<Scalar, VolumeError> {
    let not_scalar = |what: &str| {
        Err(VolumeError::NotScalar(Field::new(path, "datatype", format!("{datatype} ({what})"))))
    };
    Ok(match datatype {
        2 => Scalar::U8,
        4 => Scalar::I16,
        8 => Scalar::I32,
        16 => Scalar::F32,
        64 => Scalar::F64,
        256 => Scalar::I8,
        512 => Scalar::U16,
        768 => Scalar::U32,
        1024 => Scalar::I64,
        1280 => Scalar::U64,
        32 | 1792 | 2048 => return not_scalar("complex"),
        128 | 2304 => return not_scalar("RGB"),
        _ => {
            return Err(VolumeError::unsupported(
                path,
                "datatype",
                datatype.to_string(),
                "an integer of 8 to 64 bits or a float of 32 or 64 bits",
            ));
        }
    })
}

fn dimensions(path: &Path, dim: &[i64; 8]) -> Result<[usize; 3], VolumeError> {
    let rank = dim[0];
    if !(1..=7).contains(&rank) {
        return Err(VolumeError::header(path, "dim[0]", rank.to_string(), "1 to 7"));
    }
    let used = &dim[1..=rank as usize];
    let flat = used.iter().skip(3).all(|n| *n == 1);
    if rank < 3 || !flat {
        return Err(VolumeError::NotThreeDimensional(Field::new(path, "dim", format!("{used:?}"))));
    }
    let positive = |n: i64| usize::try_from(n).ok().filter(|n| *n > 0);
    match (positive(dim[1]), positive(dim[2]), positive(dim[3])) {
        (Some(i), Some(j), Some(k)) => Ok([i, j, k]),
        _ => Err(VolumeError::header(path, "dim", format!("{used:?}"), "positive sizes")),
    }
}

/// Metres per unit of length, from `xyzt_units`; bits 0 to 2 hold the spatial unit.
fn unit(path: &Path, xyzt_units: i64) -> Result<(f64, &'static str), VolumeError> {
    match xyzt_units & 0x07 {
        0 => Ok((1e-3, "mm (assumed: not stated in the file)")),
        1 => Ok((1.0, "m")),
        2 => Ok((1e-3, "mm")),
        3 => Ok((1e-6, "um")),
        other => Err(VolumeError::header(
            path,
            "xyzt_units",
            format!("spatial code {other}"),
            "0 (unknown), 1 (m), 2 (mm) or 3 (um)",
        )),
    }
}

/// The voxel-to-RAS affine: sform if its code is set, else qform, else voxel sizes alone (nifti1.h methods 3,
/// 2 and 1).
fn affine(raw: &RawHeader, notes: &mut Vec<String>) -> [[f64; 4]; 3] {
    let quaternion = (raw.qform_code > 0).then(|| quaternion_affine(raw));
    let is_empty = raw.srow.iter().all(|row| row[..3] == [0.0; 3]);
    if raw.sform_code > 0 && is_empty && quaternion.is_some() {
        notes.push("the sform is all zeros; using the qform".into());
    } else if raw.sform_code > 0 {
        if let Some(q) = quaternion {
            let size = raw.pixdim[1..4].iter().fold(0.0_f64, |a, b| a.max(b.abs()));
            let differs = raw.srow.iter().flatten().zip(q.iter().flatten()).any(|(a, b)| {
                let difference = (a - b).abs();
                difference > 1e-3 * size
            });
            if differs {
                notes.push("sform and qform differ; using the sform".into());
            }
        }
        return raw.srow;
    }
    if let Some(q) = quaternion {
        return q;
    }
    notes.push(
        "neither sform nor qform is set; assuming the axes right, anterior, superior, from the origin".into(),
    );
    let size = &raw.pixdim;
    [[size[1], 0.0, 0.0, 0.0], [0.0, size[2], 0.0, 0.0], [0.0, 0.0, size[3], 0.0]]
}

/// nifti1.h method 2: rotation from the quaternion (b, c, d), voxel sizes, and the handedness `qfac` in
/// pixdim[0].
fn quaternion_affine(raw: &RawHeader) -> [[f64; 4]; 3] {
    let [b, c, d] = raw.quatern;
    let square = b * b + c * c + d * d;
    // Rounding to f32 can push the norm above 1; then a is 0 and the rest is normalised
    // (nifti_quatern_to_mat44).
    let (a, b, c, d) = if square > 1.0 - 1e-7 {
        let scale = 1.0 / square.sqrt();
        (0.0, b * scale, c * scale, d * scale)
    } else {
        ((1.0 - square).sqrt(), b, c, d)
    };
    let rotation = [
        [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - b * b - c * c],
    ];
    let qfac = if raw.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let size = [raw.pixdim[1], raw.pixdim[2], qfac * raw.pixdim[3]];
    [0, 1, 2].map(|row| {
        let r = rotation[row];
        [r[0] * size[0], r[1] * size[1], r[2] * size[2], raw.qoffset[row]]
    })
}
