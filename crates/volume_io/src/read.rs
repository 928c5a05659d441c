//! Reads a volume of any supported format. The content decides the format; the name only if the content is
//! ambiguous.

use crate::error::VolumeError;
use crate::input::{self, Codec, lower_name};
use crate::options::{ReadOptions, SliceHandling};
use crate::volume::VolumeInfo;
use crate::{dicom, metaimage, nifti, nifti_header, nrrd, rectify};
use std::path::Path;
use voxel_grid::Volume;

/// Reads a CT volume; see [`read_with_info`].
///
/// # Errors
/// As [`read_with_info`].
pub fn read(path: impl AsRef<Path>) -> Result<Volume, VolumeError> {
    read_with_info(path).map(|(volume, _)| volume)
}

/// Reads a CT volume and reports what was found and what was assumed.
///
/// Reads NIfTI-1/2 (.nii, .hdr/.img, plain or gzip), NRRD (attached or detached, one data file or several;
/// raw, gzip, bzip2, hex, text), MetaImage (.mha, .mhd; raw, zlib, text) and DICOM CT (a folder, or any one
/// file of a series; classic and enhanced; uncompressed, deflated, RLE, JPEG, JPEG-LS, JPEG 2000). Geometry
/// is converted to LPS and metres; voxels stay in their order. Slope and intercept are applied; fractions are
/// rounded (halves away from zero) and values beyond `i16` clamped, both counted in the notes. A file without
/// units is read as millimetres.
///
/// # Errors
/// Every cause is a variant of [`VolumeError`], and names the file, the field, the value found and what was
/// expected.
pub fn read_with_info(path: impl AsRef<Path>) -> Result<(Volume, VolumeInfo), VolumeError> {
    read_as(path, &ReadOptions::default())
}

/// As [`read_with_info`], with options.
///
/// # Errors
/// As [`read_with_info`].
pub fn read_as(path: impl AsRef<Path>, options: &ReadOptions) -> Result<(Volume, VolumeInfo), VolumeError> {
    let path = path.as_ref();
    if std::fs::metadata(path).map_err(input::io_error(path, "open"))?.is_dir() {
        return dicom::read_folder(path, options);
    }
    let head = input::head(path, 0, Codec::Raw, 512)?;
    let name = lower_name(path);
    let ends = |suffixes: &[&str]| suffixes.iter().any(|suffix| name.ends_with(suffix));
    if head.starts_with(b"NRRD") {
        return on_a_grid(nrrd::read(path, options), options);
    }
    if dicom::is_part10(&head) {
        return dicom::read_file(path, options);
    }
    if ends(&[".img", ".img.gz"]) {
        return match nifti::header_of(path) {
            Some(header) => on_a_grid(nifti::read(&header, options), options),
            None => {
                Err(refused(path, "the voxels of a NIfTI pair, without the .hdr file beside them".into()))
            }
        };
    }
    if head.starts_with(&[0x1f, 0x8b]) {
        let inner = input::head(path, 0, Codec::Gzip, 4)?;
        if nifti_header::sniff(&inner).is_some() || ends(&[".nii.gz", ".hdr.gz"]) {
            return on_a_grid(nifti::read(path, options), options);
        }
        return Err(refused(path, format!("gzip data that start with {inner:02x?}")));
    }
    if nifti_header::sniff(&head).is_some() || ends(&[".nii", ".hdr"]) {
        return on_a_grid(nifti::read(path, options), options);
    }
    if ends(&[".mha", ".mhd"]) || head.starts_with(b"ObjectType") || head.starts_with(b"NDims") {
        return on_a_grid(metaimage::read(path, options), options);
    }
    // Last, because a data set without a preamble is hard to recognize.
    if dicom::is_dicom(&head) {
        return dicom::read_file(path, options);
    }
    if ends(&[".dcm", ".ima", ".dicom"]) {
        return Err(refused(
            path,
            "not a DICOM file: no `DICM` after 128 bytes, and no data set at the start".into(),
        ));
    }
    if ends(&[".nrrd", ".nhdr"]) {
        return Err(refused(path, "no NRRD magic at the start".into()));
    }
    Err(refused(path, format!("a file that starts with {:02x?}", head.get(..8).unwrap_or(&head))))
}

/// Wraps the result of a format without series and loose slices, with a note on options that apply only to
/// DICOM.
fn on_a_grid(
    read: Result<(Volume, VolumeInfo), VolumeError>,
    options: &ReadOptions,
) -> Result<(Volume, VolumeInfo), VolumeError> {
    let (volume, mut info) = read?;
    let is_rectified = info.notes.iter().any(|note| note.starts_with(rectify::NOTE));
    let for_dicom = [
        (options.series.is_some(), "--series", "volume.series"),
        (options.slices != SliceHandling::AsTheyLie && !is_rectified, "--rectify", "volume.resample"),
    ];
    for (_, flag, key) in for_dicom.iter().filter(|(is_given, ..)| *is_given) {
        info.notes.push(format!("`{flag}` (in a scene `{key}`) has no effect on this file"));
    }
    Ok((volume, info))
}

fn refused(path: &Path, given: String) -> VolumeError {
    VolumeError::not_a_volume(path, given)
}
