//! The error type of this crate. Each variant is one cause, and names the file, the field, the value found,
//! what was expected, and what to do.

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

    /// Name and value, with the kind of field.
    fn of_kind(&self, kind: &str) -> String {
        format!(
            "{}: {kind}`{}`: found {}",
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
        "{}: not a volume: {}; expected NIfTI (.nii, .nii.gz, .hdr/.img), NRRD (.nrrd, .nhdr), MetaImage \
         (.mha, .mhd) or a DICOM series \
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
        "{}: `{}` is truncated: {given_bytes} bytes found, {expected_bytes} needed; copy or export the file \
         again", foreign_path(.path), foreign(.field)
    )]
    Truncated {
        /// File.
        path: PathBuf,
        /// Truncated part of the file.
        field: String,
        /// Bytes found.
        given_bytes: u64,
        /// Bytes the header requires.
        expected_bytes: u64,
    },
    /// A compressed stream cannot be decoded.
    #[error("{}: cannot decode the {codec} data: {}; copy or export the file \
             again", foreign_path(.path), foreign(.reason))]
    Corrupt {
        /// File.
        path: PathBuf,
        /// Codec name.
        codec: &'static str,
        /// The decoder's message.
        reason: String,
    },
    /// A header names a data file outside its own folder. Refused, because it could expose any of the user's
    /// files as an image.
    #[error(
        "{0}, which is outside the header's folder; move the file there, or allow it (`--allow-elsewhere`)"
    )]
    Elsewhere(Field),
    /// More voxels than this crate accepts (or dimensions whose product overflows).
    #[error(
        "{0}; expected at most {MAX_VOXELS} voxels in total and {MAX_VOXELS_ALONG_AXIS} along each axis; \
         crop or resample the volume"
    )]
    TooLarge(Field),
    /// Out of memory: the machine, or the process's limit, has too little for the voxels.
    #[error(
        "{}: out of memory: {voxels} voxels need {needed_bytes} bytes; crop or resample the \
         volume", foreign_path(.path)
    )]
    Memory {
        /// File.
        path: PathBuf,
        /// Number of voxels.
        voxels: usize,
        /// Bytes needed, two per voxel.
        needed_bytes: u64,
    },
    /// Not a three-dimensional image.
    #[error("{0}; expected one three-dimensional volume; extract one volume first")]
    NotThreeDimensional(Field),
    /// Colour, complex, vector or tensor voxels.
    #[error("{0}; expected one real number per voxel; convert to a scalar image first")]
    NotScalar(Field),
    /// A voxel spacing that is zero, negative, infinite or not a number.
    #[error("{0}; expected three distances between {MIN_SPACING_M:e} m and {MAX_SPACING_M} m")]
    Spacing(Field),
    /// The axes do not span space, or are not finite.
    #[error("{0}; expected three linearly independent, finite axis directions")]
    SingularDirection(Field),
    /// The axes are not perpendicular: a sheared affine, or a CT taken with a tilted gantry. Holds the
    /// tolerance, a cosine.
    #[error(
        "{0}; expected perpendicular axes (cosine at most {1}); resample a tilted gantry's slices, of DICOM \
         or NIfTI (`--rectify`, in a scene `volume.resample = \"rectify\"`); resample any other sheared \
         volume with another program"
    )]
    Sheared(Field, f64),
    /// Unevenly spaced slices. Holds the tolerance in metres.
    #[error(
        "{0}; expected equally spaced slices (within {within_mm:.4} mm); resample them (`--rectify`, in a scene \
         `volume.resample = \"rectify\"`)",
        within_mm = .1 * 1e3
    )]
    VariableSpacing(Field, f64),
    /// A gap in an otherwise regular series.
    #[error(
        "{0}: slices are missing; export the series again, or fill the gap (`--rectify`, in a scene \
         `volume.resample = \
         \"rectify\"`)"
    )]
    MissingSlices(Field),
    /// A gap too wide to interpolate. Holds the limit, in typical slice distances.
    #[error(
        "{0}: slices are missing, and the gap is too wide to interpolate (more than {1} slice distances); \
         export the series again, or move the slices beyond the gap to another folder"
    )]
    Gap(Field, f64),
    /// Two slices at the same position.
    #[error("{0}; expected one slice per position; remove the duplicates")]
    DuplicateSlices(Field),
    /// Slices that do not belong together.
    #[error("{0}; expected the same value in all slices; put each series in its own folder")]
    MixedSeries(Field),
    /// A folder with several series and none selected, or a selected series that is not there.
    #[error("{}: {given}; select one of its series with `--series UID`, or join them with `--series all` \
             (in a scene `volume.series`): {series}", foreign_path(.path))]
    SeveralSeries {
        /// The folder.
        path: PathBuf,
        /// The selection, or its absence.
        given: String,
        /// Each with its UID, number of slices, modality and description, escaped.
        series: String,
    },
    /// A series with several slices at each position and none of its phases selected, or a selected phase
    /// that is not there.
    #[error("{}: {given}; select one with `--series UID#N` (in a scene `volume.series`): {phases}",
            foreign_path(.path))]
    SeveralPhases {
        /// The folder or file.
        path: PathBuf,
        /// The selection, or its absence.
        given: String,
        /// Each with its number and its number of slices.
        phases: String,
    },
    /// A label that is not in the segmentation, or that is ambiguous.
    #[error("{}: {}; available: {}", foreign_path(.path), foreign(.given), foreign(.there))]
    NoSuchLabel {
        /// File.
        path: PathBuf,
        /// What is wrong with the requested label.
        given: String,
        /// Labels of the file.
        there: String,
    },
    /// An argument from the caller (not from a file) is invalid.
    #[error("`{}` is {}; expected {expected}", foreign(.field), foreign(.given))]
    Argument {
        /// Name of the argument.
        field: &'static str,
        /// The value.
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
