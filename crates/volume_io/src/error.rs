//! The one error type of this crate. Each variant is one cause, and says which file and field, what was
//! given, what was expected, and what to do.

use foreign_text::{foreign, foreign_path};
use std::fmt;
use std::path::{Path, PathBuf};
use voxel_grid::{MAX_SPACING_M, MAX_VOXELS, MAX_VOXELS_ALONG_AXIS, MIN_SPACING_M};

/// A field of a file, and the value found in it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// File or folder.
    pub path: PathBuf,
    /// Its name as the format spells it.
    pub name: String,
    /// The value found.
    pub given: String,
}

impl Field {
    pub(crate) fn new(path: &Path, name: impl Into<String>, given: impl Into<String>) -> Field {
        Field { path: path.into(), name: name.into(), given: given.into() }
    }

    /// Name and value in words, with what kind of field it is.
    fn of_kind(&self, kind: &str) -> String {
        format!(
            "{}: {kind}`{}`: given {}",
            foreign_path(&self.path),
            foreign(&self.name),
            foreign(&self.given)
        )
    }
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.of_kind(""))
    }
}

/// Why a volume could not be read, written or built.
#[derive(Debug, thiserror::Error)]
pub enum VolumeError {
    /// The operating system refused a file operation.
    #[error("{}: {action} failed: {source}", foreign_path(.path))]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What was attempted, for example `open`.
        action: &'static str,
        /// The system's own error.
        source: std::io::Error,
    },
    /// A file could not be written.
    #[error(transparent)]
    Output(#[from] output_file::OutputError),
    /// Not a format that this crate reads.
    #[error(
        "{}: not a volume: {}; expected NIfTI (.nii, .nii.gz, .hdr/.img), NRRD (.nrrd, .nhdr), MetaImage (.mha, .mhd) or a DICOM series \
         (a folder or one of its files)", foreign_path(.path), foreign(.given)
    )]
    NotAVolume {
        /// File or folder.
        path: PathBuf,
        /// What was found there.
        given: String,
    },
    /// A header field is missing, malformed or contradicts another.
    #[error("{}; expected {expected}", .field.of_kind("header field "))]
    Header {
        /// The field.
        field: Field,
        /// What a valid file contains there.
        expected: String,
    },
    /// Valid in the format, but not supported by this crate.
    #[error("{}, which is not supported; expected {expected}", .field.of_kind("field "))]
    Unsupported {
        /// The field.
        field: Field,
        /// What is supported, and how to convert.
        expected: String,
    },
    /// The header promises more data than the file contains.
    #[error(
        "{}: `{}` is truncated: {given_bytes} bytes are there, {expected_bytes} are needed; copy or export the file again", foreign_path(.path), foreign(.field)
    )]
    Truncated {
        /// File.
        path: PathBuf,
        /// What is too short.
        field: String,
        /// Bytes found.
        given_bytes: u64,
        /// Bytes the header requires.
        expected_bytes: u64,
    },
    /// A compressed stream cannot be decoded.
    #[error("{}: the {codec} data does not decode: {}; copy or export the file again", foreign_path(.path), foreign(.reason))]
    Corrupt {
        /// File.
        path: PathBuf,
        /// Codec name.
        codec: &'static str,
        /// The decoder's message.
        reason: String,
    },
    /// A header names a data file outside its own folder. Refused, because it could turn any of the user's
    /// files into a picture.
    #[error(
        "{0}, which leads out of the header's folder; expected a file in it; move it there, or allow it (`--allow-elsewhere`)"
    )]
    Elsewhere(Field),
    /// More voxels than this crate accepts (or dimensions whose product overflows).
    #[error(
        "{0}; expected at most {MAX_VOXELS} voxels in all and {MAX_VOXELS_ALONG_AXIS} along each axis; crop or resample the volume"
    )]
    TooLarge(Field),
    /// The machine, or the process's limit, has too little memory for the voxels.
    #[error(
        "{}: {voxels} voxels need {needed_bytes} bytes of memory, more than there is; crop or resample the volume", foreign_path(.path)
    )]
    Memory {
        /// File.
        path: PathBuf,
        /// Their number.
        voxels: usize,
        /// Two bytes each.
        needed_bytes: u64,
    },
    /// Not a three-dimensional image.
    #[error("{0}; expected one three-dimensional volume; extract one volume first")]
    NotThreeDimensional(Field),
    /// Colour, complex, vector or tensor voxels.
    #[error("{0}; expected one real number a voxel; convert to a scalar image first")]
    NotScalar(Field),
    /// A voxel spacing that is zero, negative, infinite or not a number.
    #[error("{0}; expected three distances between {MIN_SPACING_M:e} m and {MAX_SPACING_M} m")]
    Spacing(Field),
    /// The axes do not span space, or are not finite.
    #[error("{0}; expected three linearly independent, finite axis directions")]
    SingularDirection(Field),
    /// The axes are not at right angles: a sheared affine, or a CT taken with a tilted gantry. With the
    /// tolerance, a cosine.
    #[error(
        "{0}; expected axes at right angles within {1}; resample a tilted gantry's slices (`--rectify`, in a scene `volume.resample = \
         \"rectify\"`), a sheared volume before"
    )]
    Sheared(Field, f64),
    /// Unevenly spaced slices. With the tolerance in metres.
    #[error(
        "{0}; expected slices at equal distances within {1} m; resample them (`--rectify`, in a scene `volume.resample = \"rectify\"`)"
    )]
    VariableSpacing(Field, f64),
    /// A gap in an otherwise regular series.
    #[error(
        "{0}; expected every slice of the series; export it again, or fill the gap (`--rectify`, in a scene `volume.resample = \
         \"rectify\"`)"
    )]
    MissingSlices(Field),
    /// Two slices at the same position.
    #[error("{0}; expected one slice a position; remove the copies")]
    DuplicateSlices(Field),
    /// Slices that do not belong together.
    #[error("{0}; expected one value in all slices; put one series in a folder")]
    MixedSeries(Field),
    /// A folder with the slices of several series and no choice between them, or a choice that is not there.
    #[error("{}: given {given}; expected one of its series: {series}; name one (`--series UID`, in a scene `volume.series`)", foreign_path(.path))]
    SeveralSeries {
        /// The folder.
        path: PathBuf,
        /// What was asked for.
        given: String,
        /// Each with its UID, number of slices, modality and description, escaped.
        series: String,
    },
    /// A label that is not in the segmentation, or that does not say enough.
    #[error("{}: given {}; there: {}", foreign_path(.path), foreign(.given), foreign(.there))]
    NoSuchLabel {
        /// File.
        path: PathBuf,
        /// The label asked for.
        given: String,
        /// What the file has.
        there: String,
    },
    /// An argument from the caller (not from a file) is unusable.
    #[error("`{}`: given {}; expected {expected}", foreign(.field), foreign(.given))]
    Argument {
        /// Name of the argument.
        field: &'static str,
        /// The value given.
        given: String,
        /// What is expected.
        expected: String,
    },
}

impl VolumeError {
    pub(crate) fn header(
        path: &Path,
        name: impl Into<String>,
        given: impl Into<String>,
        expected: impl Into<String>,
    ) -> VolumeError {
        VolumeError::Header { field: Field::new(path, name, given), expected: expected.into() }
    }

    pub(crate) fn unsupported(
        path: &Path,
        name: impl Into<String>,
        given: impl Into<String>,
        expected: impl Into<String>,
    ) -> VolumeError {
        VolumeError::Unsupported { field: Field::new(path, name, given), expected: expected.into() }
    }

    pub(crate) fn argument(
        field: &'static str,
        given: impl Into<String>,
        expected: impl Into<String>,
    ) -> VolumeError {
        VolumeError::Argument { field, given: given.into(), expected: expected.into() }
    }

    pub(crate) fn truncated(
        path: &Path,
        field: impl Into<String>,
        [given, expected]: [u64; 2],
    ) -> VolumeError {
        let (given_bytes, expected_bytes) = (given, expected);
        VolumeError::Truncated { path: path.into(), field: field.into(), given_bytes, expected_bytes }
    }

    pub(crate) fn not_a_volume(path: &Path, given: impl Into<String>) -> VolumeError {
        VolumeError::NotAVolume { path: path.into(), given: given.into() }
    }
}
