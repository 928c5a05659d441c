//! What a caller may ask of the readers.

use crate::error::VolumeError;
use crate::input::DataFiles;
use std::path::Path;

/// How a volume is to be read; the default refuses whatever would need a choice.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Where a header's data files and a folder's links may lie.
    pub data_files: DataFiles,
    /// The SeriesInstanceUID (0020,000e) to read from a DICOM folder that holds several; files of another
    /// format have none.
    pub series: Option<String>,
    /// What becomes of slices that are unevenly spaced or stacked askew.
    pub slices: Slices,
    /// Read one label of a segmentation, as 1 inside and 0 outside.
    pub label: Option<Label>,
}

impl ReadOptions {
    /// Keeps the label to be read, if any, of a file whose labels are numbers alone.
    pub(crate) fn keep_label(&self, path: &Path, hu: &mut [i16]) -> Result<(), VolumeError> {
        match &self.label {
            None => Ok(()),
            Some(Label::Value(value)) => crate::mask::keep_label(path, hu, *value),
            Some(Label::Name(name)) => Err(VolumeError::NoSuchLabel {
                path: path.into(),
                given: format!("label \"{name}\""),
                there: "numbers alone; only a .seg.nrrd has names".into(),
            }),
        }
    }
}

/// What becomes of slices that lie on no rectangular grid: unevenly spaced, or stacked at an angle (a tilted
/// gantry).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Slices {
    /// Refused, with where they lie.
    #[default]
    AsTheyLie,
    /// Resampled to a rectangular grid by linear interpolation; the notes state the error.
    Rectify,
}

/// One label of a segmentation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Label {
    /// The voxels with this value.
    Value(i16),
    /// The segment of this name in a 3D Slicer segmentation (`.seg.nrrd`).
    Name(String),
}
