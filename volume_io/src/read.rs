//! Reads a volume of any supported format. The content decides the format; the name only where the content cannot.

use crate::error::VolumeError;
use crate::input::{self, Codec, DataFiles, lower_name};
use crate::volume::{Volume, VolumeInfo};
use crate::{dicom_scan, dicom_series, metaimage, nifti, nifti_header, nrrd};
use std::path::Path;

/// Reads a CT volume; see [`read_with_info`].
///
/// # Errors
/// As [`read_with_info`].
pub fn read(path: impl AsRef<Path>) -> Result<Volume, VolumeError> {
    read_with_info(path).map(|(volume, _)| volume)
}

/// Reads a CT volume and reports what was found and what was assumed.
///
/// Reads NIfTI-1/2 (.nii, .hdr/.img, plain or gzip), NRRD (attached or detached; raw, gzip, bzip2, text), MetaImage (.mha, .mhd; raw, zlib,
/// text) and DICOM CT series (a folder, or any one of its files; uncompressed, RLE, JPEG). Geometry is converted to LPS and metres; voxels
/// stay in their order. Slope and intercept are applied; fractions are rounded (halves away from zero) and values beyond `i16` clamped,
/// both counted in the notes. A file without units is read as millimetres.
///
/// # Errors
/// Every cause is a variant of [`VolumeError`], and names the file, the field, the value found and what is expected.
pub fn read_with_info(path: impl AsRef<Path>) -> Result<(Volume, VolumeInfo), VolumeError> {
    read_where(path, DataFiles::Beside)
}

/// As [`read_with_info`]; `files` sets where a header's data files and a folder's links may point.
///
/// # Errors
/// As [`read_with_info`].
pub fn read_where(path: impl AsRef<Path>, files: DataFiles) -> Result<(Volume, VolumeInfo), VolumeError> {
    let path = path.as_ref();
    if std::fs::metadata(path).map_err(input::io_error(path, "open"))?.is_dir() {
        return dicom_series::read_folder(path, files);
    }
    let head = input::head(path, 0, Codec::Raw, 512)?;
    let name = lower_name(path);
    let ends = |suffixes: &[&str]| suffixes.iter().any(|suffix| name.ends_with(suffix));
    if head.starts_with(b"NRRD") {
        return nrrd::read(path, files);
    }
    if dicom_scan::is_part10(&head) {
        return dicom_series::read_file(path, files);
    }
    if ends(&[".img", ".img.gz"]) {
        return match nifti::header_of(path) {
            Some(header) => nifti::read(&header, files),
            None => Err(refused(path, "the voxels of a NIfTI pair, but no .hdr file is beside them".into())),
        };
    }
    if head.starts_with(&[0x1f, 0x8b]) {
        let inner = input::head(path, 0, Codec::Gzip, 4)?;
        if nifti_header::sniff(&inner).is_some() || ends(&[".nii.gz", ".hdr.gz"]) {
            return nifti::read(path, files);
        }
        return Err(refused(path, format!("gzip data that start with {inner:02x?}")));
    }
    if nifti_header::sniff(&head).is_some() || ends(&[".nii", ".hdr"]) {
        return nifti::read(path, files);
    }
    if ends(&[".mha", ".mhd"]) || head.starts_with(b"ObjectType") || head.starts_with(b"NDims") {
        return metaimage::read(path, files);
    }
    if ends(&[".dcm", ".ima", ".dicom"]) {
        return Err(refused(path, "no `DICM` after 128 bytes (not a DICOM Part 10 file)".into()));
    }
    if ends(&[".nrrd", ".nhdr"]) {
        return Err(refused(path, "no `NRRD` at the start".into()));
    }
    Err(refused(path, format!("a file that starts with {:02x?}", head.get(..8).unwrap_or(&head))))
}

fn refused(path: &Path, given: String) -> VolumeError {
    VolumeError::NotAVolume { path: path.into(), given }
}
