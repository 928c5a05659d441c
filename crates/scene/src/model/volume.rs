//! `[volume]` and `[[predrill]]`: the bone.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::FARTHEST_MM;

/// The bone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// A synthetic volume; either this or `path`.
    pub phantom: Option<Phantom>,
    /// A volume file or DICOM folder, relative to the scene file's folder; either this or `phantom`.
    #[schemars(extend("x-kind" = "path"))]
    pub path: Option<PathBuf>,
    /// True if the file is a 0/1 mask of bone, to be filled with synthetic Hounsfield units.
    #[serde(default)]
    pub mask: bool,
    /// The bone's label in a segmentation with several labels: its value, or the name of a segment in a
    /// `.seg.nrrd` from 3D Slicer.
    pub label: Option<Label>,
    /// SeriesInstanceUID of the series to read, if the DICOM folder holds several; `UID#2` for the second of
    /// its phases; `all` to join all series of the folder.
    pub series: Option<String>,
    /// Resamples unevenly spaced or sheared slices (tilted gantry) to a rectangular grid; if absent, they are
    /// refused.
    pub resample: Option<Resample>,
    /// Hounsfield units per grey value of a file without Hounsfield units, as of a micro-CT: HU = `slope` ×
    /// grey + `intercept`. Grey is what viewers show: after the file's own RescaleSlope (DICOM) or
    /// `scl_slope` (NIfTI). May be negative, but not 0. Two voxels of known density give both keys.
    #[serde(default = "Volume::default_slope")]
    #[schemars(range(min = -1e6, max = 1e6))]
    pub slope: f64,
    /// Hounsfield units of grey value 0: see `slope`.
    #[serde(default = "Volume::default_intercept")]
    #[schemars(range(min = -1e6, max = 1e6))]
    pub intercept: f64,
    /// Resamples a file's volume to cubic voxels of this size: thick slices give a rough tunnel wall.
    #[schemars(range(min = 0.05, max = 5.0))]
    pub resample_mm: Option<f64>,
    /// Voxel size of the phantom.
    #[serde(default = "Volume::default_spacing_mm")]
    #[schemars(range(min = 0.05, max = 2.0))]
    pub spacing_mm: f64,
    /// Voxels at or above this are bone.
    #[serde(default = "Volume::default_bone_threshold_hu")]
    #[schemars(range(min = -1000, max = 3000))]
    pub bone_threshold_hu: i16,
    /// Density of the block's far half over that of the near half.
    #[serde(default = "Volume::default_block_density_ratio")]
    #[schemars(range(min = 0.1, max = 20.0))]
    pub block_density_ratio: f64,
}

defaults!(Volume {
    default_slope: f64 = 1.0,
    default_intercept: f64 = 0.0,
    default_spacing_mm: f64 = 0.5,
    default_bone_threshold_hu: i16 = 150,
    default_block_density_ratio: f64 = 1.0,
});

/// A built-in synthetic volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Phantom {
    /// A right proximal femur.
    Femur,
    /// A block whose two halves have different densities.
    Block,
}

/// A label of a segmentation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected an integer of -32768 to 32767, or a segment's name")]
pub enum Label {
    /// Value of its voxels.
    Value(i16),
    /// Name of its segment.
    Name(String),
}

/// How a file's slices are resampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Resample {
    /// To a rectangular grid with the smallest distance between two slices, linearly.
    Rectify,
}

/// Largest diameter of a predrilled hole, mm.
pub const WIDEST_HOLE_MM: f64 = 50.0;

/// A round-ended hole that exists before the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Predrill {
    /// One end, patient frame.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub from_mm: [f64; 3],
    /// Other end, patient frame.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub to_mm: [f64; 3],
    /// Diameter.
    #[schemars(range(min = 0.5, max = WIDEST_HOLE_MM))]
    pub diameter_mm: f64,
}
