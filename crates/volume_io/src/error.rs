//! The one error type of this crate. Each variant is one cause, and says which file and field, what was given, what was expected, and what
//! to do.

use foreign_text::{foreign, foreign_path};
use std::path::PathBuf;
use voxel_grid::{MAX_SPACING_M, MAX_VOXELS_ALONG_AXIS, MIN_SPACING_M};

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
        "{}: not a volume: {}; expected NIfTI (.nii, .nii.gz, .hdr/.img), NRRD (.nrrd, .nhdr), MetaImage (.mha, .mhd) or a DICOM series (a folder or one of its files)", foreign_path(.path), foreign(.given)
    )]
    NotAVolume {
        /// File or folder.
        path: PathBuf,
        /// What was found there.
        given: String,
    },
    /// A header field is missing, malformed or contradicts another.
    #[error("{}: header field `{}`: given {}; expected {expected}", foreign_path(.path), foreign(.field), foreign(.given))]
    Header {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The value found.
        given: String,
        /// What a valid file contains there.
        expected: String,
    },
    /// Valid in the format, but not supported by this crate.
    #[error("{}: field `{}`: given {}, which is not supported; expected {expected}", foreign_path(.path), foreign(.field), foreign(.given))]
    Unsupported {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The value found.
        given: String,
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
    /// A header names a data file outside its own folder. Refused, because it could turn any of the user's files into a picture.
    #[error(
        "{}: `{}`: given {}, which leads out of the header's folder; expected a file in it; move it there, or allow it (`--allow-elsewhere`)", foreign_path(.path),
        foreign(.field),
        foreign(.given)
    )]
    Elsewhere {
        /// The header, or the folder of a series.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The name found.
        given: String,
    },
    /// More voxels than this crate accepts (or dimensions whose product overflows).
    #[error(
        "{}: `{}`: given {}; expected at most {limit} voxels in all and {MAX_VOXELS_ALONG_AXIS} along each axis; crop or resample the volume", foreign_path(.path), foreign(.field), foreign(.given)
    )]
    TooLarge {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The dimensions found.
        given: String,
        /// The limit, [`voxel_grid::MAX_VOXELS`].
        limit: usize,
    },
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
    #[error(
        "{}: `{}`: given {}; expected one three-dimensional volume; extract one volume first", foreign_path(.path), foreign(.field), foreign(.given)
    )]
    NotThreeDimensional {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The dimensions found.
        given: String,
    },
    /// Colour, complex, vector or tensor voxels.
    #[error(
        "{}: `{}`: given {}; expected one real number a voxel; convert to a scalar image first", foreign_path(.path), foreign(.field), foreign(.given)
    )]
    NotScalar {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The voxel type found.
        given: String,
    },
    /// A voxel spacing that is zero, negative, infinite or not a number.
    #[error("{}: `{}`: given {}; expected three distances between {MIN_SPACING_M:e} m and {MAX_SPACING_M} m", foreign_path(.path), foreign(.field), foreign(.given))]
    Spacing {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The value found.
        given: String,
    },
    /// The axes do not span space, or are not finite.
    #[error("{}: `{}`: given {}; expected three linearly independent, finite axis directions", foreign_path(.path), foreign(.field), foreign(.given))]
    SingularDirection {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The value found.
        given: String,
    },
    /// The axes are not at right angles: a sheared affine, or a CT taken with a tilted gantry.
    #[error(
        "{}: `{}`: given {}; expected axes at right angles within {tolerance}; resample a tilted gantry's slices (`--rectify`, in a scene `volume.resample = \"rectify\"`), a sheared volume before", foreign_path(.path), foreign(.field), foreign(.given)
    )]
    Sheared {
        /// File.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The angles or vectors found.
        given: String,
        /// The tolerance, a cosine.
        tolerance: f64,
    },
    /// Unevenly spaced slices.
    #[error(
        "{}: `{}`: given {}; expected slices at equal distances within {tolerance_m} m; resample them (`--rectify`, in a scene `volume.resample = \"rectify\"`)", foreign_path(.path), foreign(.field), foreign(.given)
    )]
    VariableSpacing {
        /// Folder or file.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The distances found.
        given: String,
        /// Tolerance in metres.
        tolerance_m: f64,
    },
    /// A gap in an otherwise regular series.
    #[error("{}: `{}`: given {}; expected every slice of the series; export it again, or fill the gap (`--rectify`, in a scene `volume.resample = \"rectify\"`)", foreign_path(.path), foreign(.field), foreign(.given))]
    MissingSlices {
        /// Folder or file.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// Where the gap is.
        given: String,
    },
    /// Two slices at the same position.
    #[error("{}: `{}`: given {}; expected one slice a position; remove the copies", foreign_path(.path), foreign(.field), foreign(.given))]
    DuplicateSlices {
        /// Folder or file.
        path: PathBuf,
        /// Field name as the format spells it.
        field: String,
        /// The two files.
        given: String,
    },
    /// Slices that do not belong together.
    #[error("{}: `{}`: given {}; expected one value in all slices; put one series in a folder", foreign_path(.path), foreign(.field), foreign(.given))]
    MixedSeries {
        /// Folder or file.
        path: PathBuf,
        /// The field that differs.
        field: String,
        /// The values found.
        given: String,
    },
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
