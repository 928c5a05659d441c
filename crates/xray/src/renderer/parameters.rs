//! Rendering parameters and the report of a frame.

use scene::{AntiScatterGrid, Scatter, Spectrum};

use crate::detector::DetectorParameters;
use crate::display::{DisplayParameters, WindowLimits};
use crate::error::{DrrError, check_range};
use crate::slice_ordered::SliceOrderedOptions;

/// Projector for the anatomy's line integrals, from most exact to fastest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projector {
    /// Exact for voxels of constant attenuation ([`siddon`](crate::siddon)). The reference, a thousand times
    /// slower than the default.
    Siddon,
    /// Bilinear interpolation per plane, ray by ray ([`joseph`](crate::joseph)).
    Joseph,
    /// Sums all slices in memory order, then warps the result ([`slice_ordered`](crate::slice_ordered)). Its
    /// difference from Joseph is small compared with the discretisation error of the voxels. Keeps a copy of
    /// the volume for each axis it reads slices across, created when a frame needs it.
    SliceOrdered {
        /// Samples per voxel of the farthest slice, 0.8 to 4: more samples are slower and closer to Joseph.
        oversampling: f64,
        /// Sharpens the image to compensate for the blur of interpolation.
        sharpen: bool,
    },
    /// Same as `SliceOrdered`, on a volume of block means stored as bytes.
    Preview {
        /// Voxels per axis averaged into one, 2 to 8.
        reduction: u32,
    },
}

impl Projector {
    /// One sample per voxel, sharpened.
    pub const SLICE_ORDERED: Self = Self::SliceOrdered { oversampling: 1.0, sharpen: true };
    /// Two voxels per axis averaged into one.
    pub const PREVIEW: Self = Self::Preview { reduction: 2 };

    /// Options of the sum over slices; `None` if rays are traced individually.
    ///
    /// # Errors
    /// The oversampling or the reduction is out of range.
    pub(super) fn slice_ordered(self) -> Result<Option<SliceOrderedOptions>, DrrError> {
        let options = match self {
            Self::Siddon | Self::Joseph => return Ok(None),
            Self::SliceOrdered { oversampling, sharpen } => {
                SliceOrderedOptions { oversampling, sharpen, ..SliceOrderedOptions::default() }
            }
            Self::Preview { reduction } => {
                check_range("reduction", f64::from(reduction), 2.0, 8.0, "2 to 8")?;
                SliceOrderedOptions { reduction, ..SliceOrderedOptions::default() }
            }
        };
        options.validate()?;
        Ok(Some(options))
    }
}

impl Default for Projector {
    fn default() -> Self {
        Self::SLICE_ORDERED
    }
}

/// Rendering parameters: everything except the volume, the C-arm and the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrrParameters {
    /// Projector for the line integrals.
    pub projector: Projector,
    /// Photon energy, 30 to 120 keV. 60 is about the mean of a 90 kV beam.
    pub energy_kev: f64,
    /// A spectrum instead of one energy; `energy_kev` then has no effect.
    pub spectrum: Option<Spectrum>,
    /// Scattered radiation; `None` for none.
    pub scatter: Option<Scatter>,
    /// Anti-scatter grid; `None` for none.
    pub grid: Option<AntiScatterGrid>,
    /// CT values below this count as air and attenuate nothing.
    pub air_below_hu: i16,
    /// Hounsfield value that fills a removed voxel: air by default, about 0 for irrigation.
    pub fill_hu: i16,
    /// Worker threads, 1 to 64. The number does not affect the frame.
    pub threads: usize,
    /// The detector.
    pub detector: DetectorParameters,
    /// The display.
    pub display: DisplayParameters,
}

impl Default for DrrParameters {
    fn default() -> Self {
        Self {
            projector: Projector::default(),
            energy_kev: 60.0,
            spectrum: None,
            scatter: None,
            grid: None,
            air_below_hu: -900,
            fill_hu: -1000,
            threads: 2,
            detector: DetectorParameters::default(),
            display: DisplayParameters::default(),
        }
    }
}

/// How much of the anatomy was recomputed for a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderKind {
    /// All of it: a new C-arm, or enough removed voxels that a full render is faster.
    Full,
    /// The pixels that newly removed voxels change.
    Incremental,
    /// Nothing had changed.
    Cached,
}

/// Work done for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameReport {
    /// How much of the anatomy was recomputed.
    pub kind: RenderKind,
    /// Pixels with recomputed anatomy.
    pub rays_traced: usize,
    /// Pixels that the tool covers.
    pub tool_pixels: usize,
    /// Attenuation at the two ends of the display scale.
    pub window: WindowLimits,
}

impl FrameReport {
    /// Report of a frame that has not been rendered yet.
    pub(super) const NONE: Self = Self {
        kind: RenderKind::Cached,
        rays_traced: 0,
        tool_pixels: 0,
        window: WindowLimits { low: 0.0, high: 1.0 },
    };
}
