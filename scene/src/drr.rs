//! `[drr]`: the X-ray frames of a scene.

use serde::{Deserialize, Serialize};

/// How a frame's intensities are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Display {
    /// What the detector sees: bone and metal dark.
    BoneDark,
    /// Inverted: bone and metal bright.
    BoneBright,
    /// The detector's readout itself, no logarithm and no window: 65535 is a readout of 1.
    Linear,
}

/// Line integral through the volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Projector {
    /// Exact for constant voxels; the slowest.
    Siddon,
    /// Bilinear, ray by ray.
    Joseph,
    /// Bilinear, slice by slice; the fastest of full resolution.
    SliceOrdered,
    /// The same with cubes of voxels joined to one.
    Preview,
}

/// The C-arm, where positioner angles do not say it: either as a camera or as points; a key of neither is refused.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CArm {
    /// Camera: K in pixels, `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`; the detector is |fx| times `pixel_pitch_mm` away.
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

/// Where pixel centres are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelCentre {
    /// At whole numbers.
    Whole,
    /// At halves.
    Half,
}

/// Many photon energies instead of one: tissue, bone, nitinol and steel each attenuate by NIST's coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Spectrum {
    /// Tube voltage, 50 to 120 kV.
    pub tube_kv: f64,
    /// Filtration, 0 to 20 mm of aluminium.
    pub aluminium_mm: f64,
    /// Effective photon energy of the CT, 30 to 120 keV.
    pub ct_energy_kev: f64,
    /// Voxels above this hold bone, 0 to 1000 HU.
    pub bone_above_hu: f64,
}

impl Default for Spectrum {
    fn default() -> Self {
        Spectrum { tube_kv: 90.0, aluminium_mm: 3.0, ct_energy_kev: 70.0, bone_above_hu: 200.0 }
    }
}

/// The detector's readout: `min(gain signal + offset, saturation)`, with a signal of 1 in the open field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Detector {
    /// Gain, 0.01 to 100.
    pub gain: f64,
    /// Dark signal, 0 to 0.5.
    pub offset: f64,
    /// Largest readout, 0.01 to 100; none without it.
    pub saturation: Option<f64>,
}

impl Default for Detector {
    fn default() -> Self {
        Detector { gain: 1.0, offset: 0.0, saturation: None }
    }
}

/// Notches of the manipulator's links, which the published tool does not state: one in the middle of each link, in turns on
/// either side of the bending plane.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Notch {
    /// Width along the tool, 0.01 to 5 mm; a shorter link has none.
    pub width_mm: f64,
    /// Depth from the tube's surface, 0.01 to 5.9 mm.
    pub depth_mm: f64,
}

/// X-ray frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drr {
    /// Scheduled frames per simulated second, 0 (only on request) to 200.
    pub rate_hz: f64,
    /// Point about which the C-arm turns, patient frame.
    pub isocentre_mm: [f64; 3],
    /// DICOM (0018,1510): 0 is detector in front of the chest, +90 at the patient's left; −180 to 180.
    #[serde(default)]
    pub primary_angle_deg: f64,
    /// DICOM (0018,1511): positive is cranial; −90 to 90.
    #[serde(default)]
    pub secondary_angle_deg: f64,
    /// Source to isocentre, 100 to 2000 mm.
    #[serde(default = "Drr::default_source_isocentre_mm")]
    pub source_isocentre_mm: f64,
    /// Source to detector, 200 to 3000 mm, more than source to isocentre.
    #[serde(default = "Drr::default_source_detector_mm")]
    pub source_detector_mm: f64,
    /// Pixel columns, 16 to 4096.
    pub columns: u32,
    /// Pixel rows, 16 to 4096.
    pub rows: u32,
    /// Distance of pixel centres on the detector, 0.05 to 5 mm.
    pub pixel_pitch_mm: f64,
    /// Photon energy, 30 to 120 keV.
    #[serde(default = "Drr::default_energy_kev")]
    pub energy_kev: f64,
    /// Photons per unattenuated pixel; 0 is without noise, to 1e8.
    #[serde(default)]
    pub photons_per_pixel: f64,
    /// Detector blur (standard deviation), 0 to 5 pixels.
    #[serde(default)]
    pub blur_pixels: f64,
    /// Bone and metal dark, as the detector sees them, or bright; or the readout without logarithm and window.
    #[serde(default = "Drr::default_display")]
    pub display: Display,
    /// Gain, offset and saturation of the detector.
    #[serde(default)]
    pub detector: Detector,
    /// Many photon energies; absent: `energy_kev` alone.
    pub spectrum: Option<Spectrum>,
    /// The C-arm as a camera or as points; absent: by the angles and distances above.
    pub carm: Option<CArm>,
    /// Notches of the links; absent: whole tubes.
    pub notch: Option<Notch>,
    /// Line integral: `siddon` is exact for constant voxels and slow, `joseph` is bilinear, `slice_ordered` is bilinear in the
    /// volume's own order and the quickest of full resolution, `preview` is that with voxels joined. `tolerance.drr_rel` chooses instead
    /// of it.
    #[serde(default = "Drr::default_projector")]
    pub projector: Projector,
    /// Samples of `slice_ordered` for each voxel of the farthest slice, 0.8 to 4; more are slower and closer to `joseph`. Below 1, samples
    /// and voxels are equally far apart in the middle of the volume.
    #[serde(default = "Drr::default_oversampling")]
    pub oversampling: f64,
    /// Voxels along each axis that `preview` joins to one, 2 to 8.
    #[serde(default = "Drr::default_reduction")]
    pub reduction: u32,
    /// Threads that render, 1 to 64.
    #[serde(default = "Drr::default_threads")]
    pub threads: usize,
}

impl Drr {
    fn default_source_isocentre_mm() -> f64 {
        700.0
    }
    fn default_source_detector_mm() -> f64 {
        1000.0
    }
    fn default_energy_kev() -> f64 {
        60.0
    }
    fn default_display() -> Display {
        Display::BoneDark
    }
    fn default_projector() -> Projector {
        Projector::SliceOrdered
    }
    fn default_oversampling() -> f64 {
        1.0
    }
    fn default_reduction() -> u32 {
        2
    }
    fn default_threads() -> usize {
        2
    }
}
