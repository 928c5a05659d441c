//! What frames are rendered with, and how much of each was computed.

use crate::attenuation::HuLaw;
use crate::detector::DetectorParameters;
use crate::display::DisplayParameters;
use crate::error::{DrrError, check_range};
use crate::slice_ordered::SliceOrderedOptions;
use crate::spectrum::Spectrum;

/// How the anatomy's line integrals are computed, from the most exact to the fastest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projector {
    /// Exact for voxels of constant attenuation ([`siddon`](crate::siddon)): the reference, a thousand times slower than the default.
    Siddon,
    /// Bilinear interpolation plane by plane, ray by ray ([`joseph`](crate::joseph)).
    Joseph,
    /// All slices summed in the volume's own order, then warped ([`slice_ordered`](crate::slice_ordered)): its
    /// difference from Joseph is small compared with the error of the voxels themselves. Keeps a copy of the volume for each of two orders,
    /// made when a frame needs it.
    SliceOrdered {
        /// Samples for each voxel of the farthest slice, 0.8 to 4: more are slower, and closer to Joseph.
        oversampling: f64,
        /// Whether the image is sharpened against the blur of the interpolation.
        sharpen: bool,
    },
    /// As `SliceOrdered`, on a volume of block means stored in bytes.
    Preview {
        /// Voxels along each axis that are merged into one, 2 to 8.
        reduction: u32,
    },
}

impl Projector {
    /// One sample per voxel, sharpened.
    pub const SLICE_ORDERED: Self = Self::SliceOrdered { oversampling: 1.0, sharpen: true };
    /// Two voxels merged into one along each axis.
    pub const PREVIEW: Self = Self::Preview { reduction: 2 };

    /// Options of the sum over slices; `None` if rays are traced one by one.
    ///
    /// # Errors
    /// An oversampling or a reduction out of range.
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

/// How frames are rendered: everything but the volume, the C-arm and the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrrParameters {
    /// How line integrals are computed.
    pub projector: Projector,
    /// Photon energy, 30 to 120 keV. 60 is about the mean of a 90 kV beam.
    pub energy_kev: f64,
    /// Hounsfield units to attenuation.
    pub hu_law: HuLaw,
    /// Many energies instead of one; `energy_kev` and `hu_law` then have no effect.
    pub spectrum: Option<Spectrum>,
    /// Below this the CT is air and attenuates nothing.
    pub air_below_hu: i16,
    /// What fills a removed voxel: air by default, about 0 for irrigation.
    pub fill_hu: i16,
    /// Worker threads, 1 to 64. The frame does not depend on it.
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
            hu_law: HuLaw::WaterScaling,
            spectrum: None,
            air_below_hu: -900,
            fill_hu: -1000,
            threads: 2,
            detector: DetectorParameters::default(),
            display: DisplayParameters::default(),
        }
    }
}

/// How much of the anatomy was computed for a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderKind {
    /// All of it: a new C-arm, or so many removed voxels that this is faster.
    Full,
    /// What newly removed voxels change.
    Incremental,
    /// Nothing had changed.
    Cached,
}

/// How much of a frame was computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameReport {
    /// How much of the anatomy was computed.
    pub kind: RenderKind,
    /// Pixels whose anatomy was computed.
    pub rays_traced: usize,
    /// Pixels that the tool covers.
    pub tool_pixels: usize,
    /// Attenuations at the two ends of the display's scale.
    pub window: (f64, f64),
}
