//! Lists the files that a volume is read from, without reading its voxels: for callers that cache decoded
//! volumes by file content.

use crate::error::VolumeError;
use crate::input::{self, Codec, lower_name};
use crate::nifti_header::NIFTI2_SIZE;
use crate::options::ReadOptions;
use crate::{dicom, metaimage, nifti_header, nrrd};
use std::path::{Path, PathBuf};

/// The files of a volume.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sources {
    /// Every file whose content the reader uses, in a fixed order.
    pub files: Vec<PathBuf>,
    /// What else determines the volume or its notes: the names that decide the format, and the number of
    /// ignored files in a folder.
    pub names: Vec<String>,
    /// Whether reading decodes more than plain voxels in one piece: compressed data, or one file per slice.
    pub are_encoded: bool,
}

/// Lists the files that [`read_as`](crate::read_as) reads for `path`: together with the options they
/// determine the volume and its notes. `None` if that is known only while reading: a header with its voxels
/// in another file, or one DICOM file of a series.
///
/// # Errors
/// As [`read_as`](crate::read_as), for errors of a header or a folder.
pub fn sources(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Option<Sources>, VolumeError> {
    let path = path.as_ref();
    if std::fs::metadata(path).map_err(input::io_error(path, "open"))?.is_dir() {
        return dicom::sources(path, options).map(Some);
    }
    let head = input::head(path, 0, Codec::Raw, 512)?;
    let name = lower_name(path);
    let are_encoded = if head.starts_with(b"NRRD") {
        nrrd::attached_encoding(path, options)?.map(|encoding| encoding != "raw")
    } else if dicom::is_part10(&head) || name.ends_with(".img") || name.ends_with(".img.gz") {
        None
    } else if head.starts_with(&[0x1f, 0x8b]) || nifti_header::sniff(&head).is_some() {
        is_one_nifti(path, &head).then(|| head.starts_with(&[0x1f, 0x8b]))
    } else if head.starts_with(b"ObjectType") || head.starts_with(b"NDims") {
        metaimage::is_local_compressed(path, options)?
    } else {
        None
    };
    let files = vec![path.to_owned()];
    Ok(are_encoded.map(|are_encoded| Sources { files, names: vec![name], are_encoded }))
}

/// Whether a NIfTI file holds its voxels.
fn is_one_nifti(path: &Path, head: &[u8]) -> bool {
    let codec = if head.starts_with(&[0x1f, 0x8b]) { Codec::Gzip } else { Codec::Raw };
    let header = input::head(path, 0, codec, NIFTI2_SIZE).and_then(|bytes| nifti_header::parse(path, &bytes));
    header.is_ok_and(|header| header.single_file)
}
