//! Writes NIfTI-1: int16, with the geometry as sform, in right-anterior-superior space and millimetres.
//!
//! Source: nifti1.h (NIfTI Data Format Working Group, 2003).

use std::io::{BufWriter, Write};
use std::path::Path;

use crate::nrrd_write::GZIP_LEVEL;
use flate2::write::GzEncoder;
use output_file::{OutputError, OutputFile};

use crate::error::VolumeError;
use crate::hash::in_little_endian;
use crate::volume::check_length;
use voxel_grid::Volume;

/// Size of the header plus the empty extension flag after it.
const HEADER_BYTES: usize = 352;

/// Writes `volume` to `path` as a NIfTI-1 file, gzip-compressed if the name ends in `.gz`.
///
/// Voxels and sizes survive a round trip exactly. The format holds its geometry in single precision:
/// positions are accurate to a ten-millionth of their distance from the origin, 0.03 µm at 300 mm.
///
/// # Errors
/// [`VolumeError::Output`] if the file exists or cannot be written; no partial file is left.
/// [`VolumeError::Unsupported`] for more than 32767 voxels along an axis; [`VolumeError::Header`] if the
/// number of voxels does not match the grid.
pub fn write_nifti(path: impl AsRef<Path>, volume: &Volume) -> Result<(), VolumeError> {
    let path = path.as_ref();
    check_length(path, volume)?;
    let dims = volume.grid.dims().map(i16::try_from);
    let [Ok(ni), Ok(nj), Ok(nk)] = dims else {
        return Err(VolumeError::unsupported(
            path,
            "dim",
            format!("{:?}", volume.grid.dims()),
            "at most 32767 voxels along each axis; write NRRD instead",
        ));
    };
    let header = header(volume, [ni, nj, nk]);
    let mut file = OutputFile::create(path)?;
    let is_packed = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("gz"));
    let writer = BufWriter::with_capacity(1 << 16, &mut file);
    let written = match is_packed {
        true => {
            let mut encoder = GzEncoder::new(writer, GZIP_LEVEL);
            write_into(&mut encoder, &header, volume).and_then(|()| encoder.finish()?.flush())
        }
        false => {
            let mut writer = writer;
            write_into(&mut writer, &header, volume).and_then(|()| writer.flush())
        }
    };
    written.map_err(OutputError::write(path))?;
    Ok(file.keep()?)
}

fn write_into(out: &mut impl Write, header: &[u8], volume: &Volume) -> std::io::Result<()> {
    out.write_all(header)?;
    in_little_endian(&volume.hu, |bytes| out.write_all(bytes))
}

/// Offsets as in nifti1.h.
fn header(volume: &Volume, [ni, nj, nk]: [i16; 3]) -> [u8; HEADER_BYTES] {
    let mut bytes = [0; HEADER_BYTES];
    let mut put = |at: usize, field: &[u8]| bytes[at..at + field.len()].copy_from_slice(field);
    put(0, &348_i32.to_le_bytes());
    for (index, size) in [3, ni, nj, nk, 1, 1, 1, 1].into_iter().enumerate() {
        put(40 + 2 * index, &size.to_le_bytes());
    }
    // DT_INT16, 16 bits per voxel.
    put(70, &4_i16.to_le_bytes());
    put(72, &16_i16.to_le_bytes());
    let spacing_mm = volume.grid.spacing_m().map(|spacing_m| (1e3 * spacing_m) as f32);
    for (index, spacing_mm) in [1.0, spacing_mm[0], spacing_mm[1], spacing_mm[2]].into_iter().enumerate() {
        put(76 + 4 * index, &spacing_mm.to_le_bytes());
    }
    put(108, &(HEADER_BYTES as f32).to_le_bytes());
    // Values are stored unscaled: slope 1, intercept 0.
    put(112, &1.0_f32.to_le_bytes());
    // NIFTI_UNITS_MM.
    put(123, &[2]);
    put(148, b"Hounsfield units, written by Trabecula");
    // NIFTI_XFORM_SCANNER_ANAT for the sform; no qform, which cannot hold left-handed axes without its sign.
    put(254, &1_i16.to_le_bytes());
    let (spacing_m, origin_m, direction) =
        (volume.grid.spacing_m(), volume.grid.origin_m(), volume.grid.direction());
    for row in 0..3 {
        // NIfTI is RAS: x and y of LPS change sign.
        let sign = if row < 2 { -1.0 } else { 1.0 };
        let axis = |axis: usize| direction[row][axis] * spacing_m[axis];
        for (column, value) in [axis(0), axis(1), axis(2), origin_m[row]].into_iter().enumerate() {
            put(280 + 16 * row + 4 * column, &((sign * 1e3 * value) as f32).to_le_bytes());
        }
    }
    put(344, b"n+1\0");
    bytes
}
