//! Options of the readers.

use crate::error::VolumeError;
use crate::input::DataFiles;
use crate::scalar::{HuSink, Scale};
use std::path::Path;

/// How to read a volume; the default refuses everything ambiguous.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Where a header's data files and a folder's links may be.
    pub data_files: DataFiles,
    /// The SeriesInstanceUID (0020,000e) to read from a DICOM folder with several series; ignored for other
    /// formats.
    pub series: Option<String>,
    /// How to treat unevenly spaced or sheared slices.
    pub slices: SliceHandling,
    /// Reads one label of a segmentation, as 1 inside and 0 outside.
    pub label: Option<Label>,
    /// Converts grey values to Hounsfield units, as of a micro-CT.
    pub grey: Option<GreyScale>,
}

/// Hounsfield units of grey values: HU = slope × grey + intercept. Grey is the value after the file's own
/// rescale (RescaleSlope of DICOM, `scl_slope` of NIfTI), as viewers show it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GreyScale {
    /// Hounsfield units per grey value; not zero.
    pub slope: f64,
    /// Hounsfield units of grey value 0.
    pub intercept: f64,
}

impl ReadOptions {
    /// Returns an empty destination for voxels, which converts grey values.
    ///
    /// # Errors
    /// `Header` if the slope is 0 or a number is not finite.
    pub(crate) fn sink(&self, path: &Path) -> Result<HuSink, VolumeError> {
        let grey = self.grey.map(|grey| Scale::checked(path, "grey scale", grey.slope, grey.intercept));
        let grey = grey.transpose()?.filter(|grey| *grey != Scale::IDENTITY);
        Ok(HuSink::converting(grey))
    }

    /// Keeps only the selected label, if any, in a file whose labels are plain numbers.
    pub(crate) fn keep_label(&self, path: &Path, hu: &mut [i16]) -> Result<(), VolumeError> {
        match &self.label {
            None => Ok(()),
            Some(Label::Value(value)) => crate::mask::keep_label(path, hu, *value),
            Some(Label::Name(name)) => Err(VolumeError::NoSuchLabel {
                path: path.into(),
                given: format!("label \"{name}\" not found"),
                there: "numeric labels only; named labels need a .seg.nrrd".into(),
            }),
        }
    }
}

/// How to treat slices that are not on a rectangular grid: unevenly spaced, or stacked at an angle (tilted
/// gantry).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SliceHandling {
    /// Refuses them, with their positions.
    #[default]
    AsTheyLie,
    /// Resamples them to a rectangular grid by linear interpolation; the notes state the error.
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
