//! `[drr]`: the X-ray frames of a scene.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{DrrObject, FARTHEST_MM, MAX_OBJECTS};

/// How a frame's intensities are displayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Display {
    /// As the detector sees them: bone and metal dark.
    BoneDark,
    /// Inverted: bone and metal bright.
    BoneBright,
    /// The detector's readout itself, without logarithm and window: 65535 is a readout of 1.
    Linear,
}

/// Line integral through the volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Projector {
    /// Exact for constant voxels; the slowest.
    Siddon,
    /// Bilinear, ray by ray.
    Joseph,
    /// Bilinear, slice by slice; the fastest of full resolution.
    SliceOrdered,
    /// As `slice_ordered`, with cubes of voxels merged.
    Preview,
}

/// The C-arm, if not given by positioner angles: either as a camera or as points; the two forms are mutually
/// exclusive.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CArm {
    /// Camera: K in pixels, `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`; the detector is |fx| times
    /// `pixel_pitch_mm` away.
    pub intrinsics: Option<[[f64; 3]; 3]>,
    /// Camera: R, rows are the camera's axes in the world, z towards the detector.
    pub rotation: Option<[[f64; 3]; 3]>,
    /// Camera: t, the world's origin in the camera.
    pub translation_mm: Option<[f64; 3]>,
    /// Camera: `whole` (OpenCV, the standard) or `half` (DeepDRR).
    pub pixel_centre: Option<PixelCentre>,
    /// Points: focal spot.
    pub source_mm: Option<[f64; 3]>,
    /// Points: centre of the detector.
    pub detector_centre_mm: Option<[f64; 3]>,
    /// Points: unit vector along a row, towards growing column numbers.
    pub row_axis: Option<[f64; 3]>,
    /// Points: unit vector along a column, towards growing row numbers.
    pub column_axis: Option<[f64; 3]>,
}

/// Pixel-centre convention.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PixelCentre {
    /// At integers.
    Whole,
    /// At half-integers.
    Half,
}

/// A spectrum of photon energies instead of a single one: tissue, bone and each metal attenuate by NIST's
/// coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Spectrum {
    /// Tube voltage.
    #[schemars(range(min = 50.0, max = 120.0))]
    pub tube_kv: f64,
    /// Filtration, as a thickness of aluminium.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub aluminium_mm: f64,
    /// Effective photon energy of the CT.
    #[schemars(range(min = 30.0, max = 120.0))]
    pub ct_energy_kev: f64,
    /// Voxels above this contain bone.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub bone_above_hu: f64,
}

impl Default for Spectrum {
    fn default() -> Self {
        Spectrum { tube_kv: 90.0, aluminium_mm: 3.0, ct_energy_kev: 70.0, bone_above_hu: 200.0 }
    }
}

/// How scattered radiation is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ScatterModel {
    /// No scatter.
    None,
    /// Kernels fitted to Monte Carlo.
    Kernel,
    /// Photons that are followed one by one; the reference, which takes seconds.
    MonteCarlo,
}

/// Scattered radiation, which is added to the signal before the noise. The tool scatters nothing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scatter {
    /// `kernel` is fast; `monte_carlo` is the reference and takes seconds for each frame with new anatomy.
    pub model: ScatterModel,
    /// Photons of `monte_carlo`.
    #[serde(default = "Scatter::default_photons")]
    #[schemars(range(min = 1e3, max = 1e10))]
    pub photons: f64,
}

defaults!(Scatter { default_photons: f64 = 1e6 });

/// An anti-scatter grid, in front of the detector. A signal of 1 is the open field behind the grid: scatter
/// counts by the ratio of the two transmissions, and `drr.photons_per_pixel` by that of the primary.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AntiScatterGrid {
    /// Fraction of the primary that passes.
    #[schemars(range(min = 0.01, max = 1.0))]
    pub primary_transmission: f64,
    /// Fraction of the scatter that passes.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub scatter_transmission: f64,
}

/// The detector's readout: `min(gain signal + offset, saturation)`, with a signal of 1 in the open field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Detector {
    /// Gain.
    #[schemars(range(min = 0.01, max = 100.0))]
    pub gain: f64,
    /// Dark signal.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub offset: f64,
    /// Largest readout; absent: unlimited.
    #[schemars(range(min = 0.01, max = 100.0))]
    pub saturation: Option<f64>,
}

impl Default for Detector {
    fn default() -> Self {
        Detector { gain: 1.0, offset: 0.0, saturation: None }
    }
}

/// Notches of the manipulator's links, which the published tool does not specify: one in the middle of each
/// link, alternating between the two sides of the bending plane.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Notch {
    /// Width along the tool; a shorter link has no notch.
    #[schemars(range(min = 0.01, max = 5.0))]
    pub width_mm: f64,
    /// Depth from the tube's surface.
    #[schemars(range(min = 0.01, max = 5.9))]
    pub depth_mm: f64,
}

/// A label image of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LabelImage {
    /// Attenuation of the anatomy.
    Anatomy,
    /// Attenuation of the metal.
    Metal,
    /// Path length in bone.
    BoneM,
    /// Path length in drilled voxels.
    TunnelM,
    /// Depth of the tool.
    ToolDepthM,
    /// Depth of the bone.
    BoneDepthM,
}

impl LabelImage {
    /// All images.
    pub const ALL: [Self; 6] =
        [Self::Anatomy, Self::Metal, Self::BoneM, Self::TunnelM, Self::ToolDepthM, Self::BoneDepthM];
}

/// Labels of the frames, which are derived bit for bit from the log of a run (`trabecula log export
/// --dataset`): always the mask, keypoints, camera and pose, plus these.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DrrLabels {
    /// Voxels at or above this count as bone in the labels; absent: `volume.bone_threshold_hu`, which decides
    /// what is drilled.
    #[schemars(range(min = -1000, max = 3000))]
    pub bone_from_hu: Option<i16>,
    /// Images in the files of `--dataset npz`.
    pub images: Vec<LabelImage>,
}

impl Default for DrrLabels {
    fn default() -> Self {
        DrrLabels { bone_from_hu: None, images: LabelImage::ALL.to_vec() }
    }
}

/// X-ray frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Drr {
    /// Scheduled frames per simulated second; with 0, frames only on request.
    #[schemars(range(min = 0.0, max = 200.0))]
    pub rate_hz: f64,
    /// Point about which the C-arm rotates, patient frame; absent with `tool.plan`: the midpoint between
    /// start and target.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub isocentre_mm: [f64; 3],
    /// DICOM (0018,1510): 0 has the detector in front of the chest, +90 at the patient's left.
    #[serde(default)]
    #[schemars(range(min = -180.0, max = 180.0))]
    pub primary_angle_deg: f64,
    /// DICOM (0018,1511): positive is cranial.
    #[serde(default)]
    #[schemars(range(min = -90.0, max = 90.0))]
    pub secondary_angle_deg: f64,
    /// Source to isocentre.
    #[serde(default = "Drr::default_source_isocentre_mm")]
    #[schemars(range(min = 100.0, max = 2000.0))]
    pub source_isocentre_mm: f64,
    /// Source to detector, at least source to isocentre.
    #[serde(default = "Drr::default_source_detector_mm")]
    #[schemars(range(min = 200.0, max = 3000.0))]
    pub source_detector_mm: f64,
    /// Pixel columns.
    #[schemars(range(min = 16, max = 4096))]
    pub columns: u32,
    /// Pixel rows.
    #[schemars(range(min = 16, max = 4096))]
    pub rows: u32,
    /// Pixel pitch on the detector.
    #[schemars(range(min = 0.05, max = 5.0))]
    pub pixel_pitch_mm: f64,
    /// Photon energy.
    #[serde(default = "Drr::default_energy_kev")]
    #[schemars(range(min = 30.0, max = 120.0))]
    pub energy_kev: f64,
    /// Photons per unattenuated pixel, at least 1; 0: no noise.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1e8))]
    pub photons_per_pixel: f64,
    /// Detector blur (standard deviation).
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 5.0))]
    pub blur_pixels: f64,
    /// Bone and metal dark, as the detector sees them, or bright; or the readout without logarithm and
    /// window.
    #[serde(default = "Drr::default_display")]
    pub display: Display,
    /// Gain, offset and saturation of the detector.
    #[serde(default)]
    pub detector: Detector,
    /// Spectrum of photon energies; absent: `energy_kev` alone.
    pub spectrum: Option<Spectrum>,
    /// Scattered radiation; absent: none.
    pub scatter: Option<Scatter>,
    /// Anti-scatter grid; absent: none.
    pub grid: Option<AntiScatterGrid>,
    /// The C-arm as a camera or as points; absent: by the angles and distances above.
    pub carm: Option<CArm>,
    /// Objects beside the tool that frames show; absent: none, at no cost. Rigid bodies: `body.material`.
    #[serde(default)]
    #[schemars(length(max = MAX_OBJECTS))]
    pub object: Vec<DrrObject>,
    /// Notches of the links; absent: whole tubes.
    pub notch: Option<Notch>,
    /// Labels of the frames; absent: all, by the volume's threshold.
    pub labels: Option<DrrLabels>,
    /// Line integral: `siddon` is exact for constant voxels and slow, `joseph` is bilinear, `slice_ordered`
    /// is bilinear in the volume's own order and the fastest at full resolution, `preview` is `slice_ordered`
    /// with voxels merged. `tolerance.drr_rel` overrides it.
    #[serde(default = "Drr::default_projector")]
    pub projector: Projector,
    /// Samples of `slice_ordered` per voxel of the farthest slice; more are slower and closer to `joseph`.
    /// Below 1, samples and voxels have equal spacing in the middle of the volume.
    #[serde(default = "Drr::default_oversampling")]
    #[schemars(range(min = 0.8, max = 4.0))]
    pub oversampling: f64,
    /// Voxels along each axis that `preview` merges into one.
    #[serde(default = "Drr::default_reduction")]
    #[schemars(range(min = 2, max = 8))]
    pub reduction: u32,
    /// Number of rendering threads.
    #[serde(default = "Drr::default_threads")]
    #[schemars(range(min = 1, max = 64))]
    pub threads: usize,
}

impl super::Scene {
    /// Voxels at or above this count as bone in the labels of its frames; `None` without a volume.
    pub fn labels_bone_from_hu(&self) -> Option<i16> {
        let own = self.drr.as_ref().and_then(|drr| drr.labels.as_ref()?.bone_from_hu);
        self.volume.as_ref().map(|volume| own.unwrap_or(volume.bone_threshold_hu))
    }
}

impl Drr {
    /// Its labels.
    pub fn labels(&self) -> DrrLabels {
        self.labels.clone().unwrap_or_default()
    }
}

defaults!(Drr {
    default_source_isocentre_mm: f64 = 700.0,
    default_source_detector_mm: f64 = 1000.0,
    default_energy_kev: f64 = 60.0,
    default_display: Display = Display::BoneDark,
    default_projector: Projector = Projector::SliceOrdered,
    default_oversampling: f64 = 1.0,
    default_reduction: u32 = 2,
    default_threads: usize = 2,
});
