//! Writes NRRD: gzip-compressed int16 in left-posterior-superior space, millimetres.

use crate::error::VolumeError;
use crate::hash::in_little_endian;
use crate::volume::check_length;
use flate2::Compression;
use flate2::write::GzEncoder;
use output_file::{OutputError, OutputFile};
use std::io::{BufWriter, Write};
use std::path::Path;
use voxel_grid::Volume;

/// Compression level of volumes. A pelvis of 49 million voxels takes a quarter of the time of level 6, gzip's
/// default, and 8 % more bytes.
pub(crate) const GZIP_LEVEL: Compression = Compression::new(2);

/// Writes `volume` to `path` as an attached, gzip-compressed NRRD in LPS and millimetres.
///
/// Voxels and sizes survive a round trip exactly; spacing, origin and direction to rounding (1e-15 relative),
/// because the format stores metres as millimetres and the product of direction and spacing.
///
/// # Errors
/// [`VolumeError::Output`] if the file exists or cannot be written; no partial file is left.
/// [`VolumeError::Header`] if the number of voxels does not match the grid.
pub fn write_nrrd(path: impl AsRef<Path>, volume: &Volume) -> Result<(), VolumeError> {
    let path = path.as_ref();
    check_length(path, volume)?;
    let mut file = OutputFile::create(path)?;
    write_into(&mut file, volume).map_err(OutputError::write(path))?;
    Ok(file.keep()?)
}

fn write_into(file: &mut OutputFile, volume: &Volume) -> std::io::Result<()> {
    let mut writer = BufWriter::with_capacity(1 << 16, file);
    writer.write_all(header(volume).as_bytes())?;
    let mut encoder = GzEncoder::new(writer, GZIP_LEVEL);
    in_little_endian(&volume.hu, |bytes| encoder.write_all(bytes))?;
    encoder.finish()?.flush()
}

fn header(volume: &Volume) -> String {
    let grid = &volume.grid;
    let [ni, nj, nk] = grid.dims();
    let vector = |v: [f64; 3]| format!("({:?},{:?},{:?})", v[0], v[1], v[2]);
    let axes = [0, 1, 2].map(|axis| {
        let length_mm = grid.spacing_m()[axis] * 1e3;
        vector(grid.axes()[axis].map(|x| x * length_mm))
    });
    let origin = vector(grid.origin_m().map(|o| o * 1e3));
    format!(
        "NRRD0005\n# Hounsfield units, written by Trabecula\ntype: int16\ndimension: 3\n\
         space: left-posterior-superior\nsizes: {ni} {nj} {nk}\nspace directions: {} {} {}\n\
         kinds: domain domain domain\nendian: little\nencoding: gzip\nspace units: \"mm\" \"mm\" \"mm\"\n\
         space origin: {origin}\n\n",
        axes[0], axes[1], axes[2]
    )
}
