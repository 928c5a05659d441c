//! What a scene file may say.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::tolerance::Tolerance;

/// A scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Name: letters, digits, `_` and `-`; names the output folder.
    pub name: String,
    /// What the scene shows.
    #[serde(default)]
    pub description: String,
    /// How it runs.
    pub run: Run,
    /// Errors that are allowed; absent: the standard settings. What the scene names itself stays.
    pub tolerance: Option<Tolerance>,
    /// The bone; absent: free space.
    pub volume: Option<Volume>,
    /// Holes that are there before the run.
    #[serde(default)]
    pub predrill: Vec<Predrill>,
    /// Rigid bodies beside the tool, at most 4; absent: none, and no rigid-body engine.
    #[serde(default)]
    pub body: Vec<Body>,
    /// Gravity in the patient frame, on the tool and on free bodies, each −100 to 100 m/s². None by default: the tool's
    /// own weight of 7 g bends it by micrometres, and a scene says which way the patient lies.
    #[serde(default)]
    pub gravity_m_per_s2: [f64; 3],
    /// Where the tool starts.
    pub tool: Tool,
    /// The manipulator, where it differs from the standard one.
    #[serde(default)]
    pub manipulator: Manipulator,
    /// The tendons, at most 4, in the order of the commands; none: the antagonist pair, 2.5 mm to either side.
    #[serde(default)]
    pub tendon: Vec<Tendon>,
    /// Contact of the tool with bone.
    #[serde(default)]
    pub contact: Contact,
    /// Strength of bone and the burr's cutting.
    #[serde(default)]
    pub drilling: Drilling,
    /// The arm that carries the tool.
    #[serde(default)]
    pub arm: Arm,
    /// X-ray frames; absent: none.
    pub drr: Option<Drr>,
    /// Who drives the tool.
    #[serde(default)]
    pub controller: Vec<Controller>,
    /// What is recorded.
    #[serde(default)]
    pub recording: Recording,
}

/// How time passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// As fast as the parts allow; every tick waits for every controller.
    Lockstep,
    /// Ticks follow the wall clock; late commands are held.
    Realtime,
}

/// How the scene runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// Lockstep: as fast as the parts allow, every tick waits for every controller. Real time: by the wall clock.
    pub mode: Mode,
    /// Simulated time of the whole run, 0.001 to 3600 s.
    pub duration_s: f64,
    /// Time step, 0.1 to 10 ms.
    #[serde(default = "Run::default_dt_ms")]
    pub dt_ms: f64,
    /// Real time: ticks for which a late controller's last command is held before the safe command applies, 0 to 100000.
    #[serde(default = "Run::default_hold_ticks")]
    pub hold_ticks: u64,
    /// Lockstep: wall-clock time that a controller may take for one tick, 10 to 600000 ms.
    #[serde(default = "Run::default_controller_limit_ms")]
    pub controller_limit_ms: f64,
    /// Seed of everything random: the noise of frames.
    #[serde(default)]
    pub seed: u64,
}

impl Run {
    fn default_dt_ms() -> f64 {
        1.0
    }
    fn default_hold_ticks() -> u64 {
        50
    }
    fn default_controller_limit_ms() -> f64 {
        5000.0
    }
}

/// A built-in synthetic volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phantom {
    /// A right proximal femur.
    Femur,
    /// A block whose two halves have different densities.
    Block,
}

/// The bone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// A synthetic volume; either this or `path`.
    pub phantom: Option<Phantom>,
    /// A volume file or DICOM folder, from the scene file's folder; either this or `phantom`.
    pub path: Option<PathBuf>,
    /// True if the file is a 0/1 mask of bone, to be filled with synthetic Hounsfield units.
    #[serde(default)]
    pub mask: bool,
    /// A file's volume is resampled to cubic voxels of this size, 0.25 to 5 mm: thick slices make a rough tunnel wall.
    pub resample_mm: Option<f64>,
    /// Voxel size of the phantom, 0.25 to 2 mm.
    #[serde(default = "Volume::default_spacing_mm")]
    pub spacing_mm: f64,
    /// Voxels at or above this are bone, −1000 to 3000 HU.
    #[serde(default = "Volume::default_bone_threshold_hu")]
    pub bone_threshold_hu: i16,
    /// Density of the block's far half over that of the near one, 0.1 to 20.
    #[serde(default = "Volume::default_block_density_ratio")]
    pub block_density_ratio: f64,
}

impl Volume {
    fn default_spacing_mm() -> f64 {
        0.5
    }
    fn default_bone_threshold_hu() -> i16 {
        150
    }
    fn default_block_density_ratio() -> f64 {
        1.0
    }
}

/// A round-ended hole that is there before the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Predrill {
    /// One end, patient frame.
    pub from_mm: [f64; 3],
    /// Other end, patient frame.
    pub to_mm: [f64; 3],
    /// Diameter, 0.5 to 50 mm.
    pub diameter_mm: f64,
}

/// A box, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cuboid {
    /// Half extents along the body's axes, each 0.1 to 1000 mm.
    pub half_extents_mm: [f64; 3],
}

/// A ball, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ball {
    /// Radius, 0.1 to 1000 mm.
    pub radius_mm: f64,
}

/// A capsule along the body's z, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Capsule {
    /// Half the distance between the centres of its ends, 0.1 to 1000 mm.
    pub half_height_mm: f64,
    /// Radius, 0.1 to 1000 mm.
    pub radius_mm: f64,
}

/// Whether a rigid body can move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BodyMotion {
    /// Stands still: a clamp.
    Fixed,
    /// Moves by forces: a bone fragment.
    Free,
}

/// A rigid body beside the tool. The burr does not cut it. Exactly one of `cuboid`, `ball` and `capsule` is its shape.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Name: letters, digits, `_`.
    pub name: String,
    /// A box.
    pub cuboid: Option<Cuboid>,
    /// A ball.
    pub ball: Option<Ball>,
    /// A capsule.
    pub capsule: Option<Capsule>,
    /// Fixed or free.
    pub motion: BodyMotion,
    /// Centre, patient frame.
    pub position_mm: [f64; 3],
    /// Orientation: axis times angle, each −360 to 360 deg.
    #[serde(default)]
    pub rotation_vector_deg: [f64; 3],
    /// Density of a free body, 10 to 25000 kg/m³; cortical bone by default.
    #[serde(default = "Body::default_density_kg_per_m3")]
    pub density_kg_per_m3: f64,
    /// Friction coefficient against other bodies, 0 to 2; against the tool it is the tool's (`[contact]`).
    #[serde(default = "Body::default_friction")]
    pub friction: f64,
}

impl Body {
    fn default_density_kg_per_m3() -> f64 {
        1900.0
    }
    fn default_friction() -> f64 {
        0.3
    }
}

/// Where the tool starts and which way it looks, in the patient frame (LPS).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// Burr centre of the straight tool at the start.
    pub burr_start_mm: [f64; 3],
    /// Insertion direction, any length.
    pub direction: [f64; 3],
    /// Side to which tendon 0 bends the tool; its part across the direction counts.
    pub bend_toward: [f64; 3],
}

/// The manipulator, where it differs from the notched nitinol tube of 27 flexures.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Manipulator {
    /// Rung of the ladder of models: `planar` is the standard.
    pub model: Option<ManipulatorRung>,
    /// The flexible length as this many equal links in place of the flexures of the tables, 1 to 32.
    pub links: Option<usize>,
    /// Stiffness of a flexure across the bending plane over that in it, 0.001 to 1000; for `spatial` and `full`.
    pub lateral_stiffness_ratio: Option<f64>,
    /// Torsional over bending stiffness of a flexure, 0.001 to 1000; for `spatial` and `full`.
    pub torsion_stiffness_ratio: Option<f64>,
    /// Friction coefficient of tendons in their channels, 0 to 1.
    pub tendon_friction: Option<f64>,
    /// Damping ratio of the first bending mode, 0.001 to 10.
    pub damping_ratio: Option<f64>,
    /// All flexure stiffnesses times this, 0.001 to 1000.
    pub stiffness_scale: Option<f64>,
    /// All masses times this, 0.001 to 1000.
    pub mass_scale: Option<f64>,
    /// Stiffness of the mount between arm and tool, 1e3 to 1e7 N/m.
    pub mount_stiffness_n_per_m: Option<f64>,
    /// Diameter of the burr, 1 to 20 mm.
    pub burr_diameter_mm: Option<f64>,
    /// Time integration: `hybrid`, the standard, is second order in free motion.
    pub integrator: Option<Integrator>,
}

/// A tendon in its channel along the whole flexible length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tendon {
    /// Distance of the channel from the tool axis toward `tool.bend_toward`, −10 to 10 mm.
    pub toward_mm: f64,
    /// Distance across it (direction times `bend_toward`, right-handed), −10 to 10 mm; for `spatial` and `full`.
    #[serde(default)]
    pub across_mm: f64,
}

/// Models of the manipulator, from the cheapest to the richest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ManipulatorRung {
    /// An arc of one curvature.
    ConstantCurvature,
    /// A chain that bends in one plane.
    Planar,
    /// A chain that bends, bends laterally and twists.
    Spatial,
    /// A chain whose flexures have all six freedoms.
    Full,
}

/// Integrators of the manipulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Integrator {
    /// First order, never unstable.
    LinearlyImplicitEuler,
    /// Second order in free motion, linearly implicit Euler otherwise.
    Hybrid,
}

/// Contact of the tool with bone, where it differs from the standard.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Contact {
    /// Friction coefficient between tool and bone, 0 to 2.
    pub friction: Option<f64>,
    /// Stiffness of a contact, 1e3 to 1e9 N/m.
    pub stiffness_n_per_m: Option<f64>,
}

/// Strength of bone and the burr's cutting, where it differs from the standard.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Drilling {
    /// Energy to remove a volume of cortical bone of 1.9 g/cm³, 0.0001 to 10 J/mm³.
    pub specific_energy_j_per_mm3: Option<f64>,
    /// Exponent of the density in that energy, 0 to 4.
    pub density_exponent: Option<f64>,
    /// Cutting force over normal force, 0.01 to 2.
    pub cutting_coefficient: Option<f64>,
}

/// The arm: a UR5, its limits and how it holds the tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Arm {
    /// Fastest motion of the tool's base on a path, 0.01 to 1000 mm/s.
    pub max_speed_mm_per_s: f64,
    /// Largest acceleration of it, 0.1 to 10000 mm/s².
    pub max_acceleration_mm_per_s2: f64,
    /// Largest jerk of it, 1 to 1e6 mm/s³.
    pub max_jerk_mm_per_s3: f64,
    /// Fastest turn of the tool's base on a path, 0.01 to 360 deg/s; 0.5 rad/s by default.
    pub max_turn_deg_per_s: Option<f64>,
    /// Largest angular acceleration of it, 0.1 to 10000 deg/s²; 2.5 rad/s² by default.
    pub max_turn_deg_per_s2: Option<f64>,
    /// Largest angular jerk of it, 1 to 1e6 deg/s³; 25 rad/s³ by default.
    pub max_turn_deg_per_s3: Option<f64>,
    /// Fastest turn of each joint, 0.01 to 180 deg/s; 180 by default, Universal Robots' figure.
    pub max_joint_speed_deg_per_s: Option<f64>,
    /// Largest acceleration of each joint, 0.1 to 10000 deg/s²; 5 rad/s² by default.
    pub max_joint_acceleration_deg_per_s2: Option<f64>,
    /// Largest jerk of each joint, 1 to 1e6 deg/s³; 50 rad/s³ by default.
    pub max_joint_jerk_deg_per_s3: Option<f64>,
    /// Least angles of the six joints, each −360 to 360 deg; −360, elbow −180 by default.
    pub lower_joints_deg: Option<[f64; 6]>,
    /// Greatest angles of the six joints, each above the least, to 360 deg; 360, elbow 180 by default.
    pub upper_joints_deg: Option<[f64; 6]>,
    /// Joint angles at the start, each within its range. The arm's base stands where the tool then is as `[tool]` says.
    /// Far from every singularity by default.
    pub initial_joints_deg: Option<[f64; 6]>,
    /// Place of the tool's base in the flange's frame, each −1000 to 1000 mm.
    pub tool_position_mm: [f64; 3],
    /// Orientation of the tool's base in the flange's frame: axis times angle, each −360 to 360 deg.
    pub tool_rotation_vector_deg: [f64; 3],
    /// Elastic joints; absent: stiff, at no cost.
    pub compliance: Option<ArmCompliance>,
}

/// A spring and a damper in each joint of the arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmCompliance {
    /// Stiffness of the joints, base to wrist, each 1 to 1e7 N m/rad.
    pub joint_stiffness_nm_per_rad: [f64; 6],
    /// Damping of the joints, base to wrist, each 0 to 1e5 N m s/rad.
    pub joint_damping_nms_per_rad: [f64; 6],
}

impl Default for Arm {
    fn default() -> Self {
        Arm {
            max_speed_mm_per_s: 50.0,
            max_acceleration_mm_per_s2: 200.0,
            max_jerk_mm_per_s3: 2000.0,
            max_turn_deg_per_s: None,
            max_turn_deg_per_s2: None,
            max_turn_deg_per_s3: None,
            max_joint_speed_deg_per_s: None,
            max_joint_acceleration_deg_per_s2: None,
            max_joint_jerk_deg_per_s3: None,
            lower_joints_deg: None,
            upper_joints_deg: None,
            initial_joints_deg: None,
            tool_position_mm: [0.0; 3],
            tool_rotation_vector_deg: [0.0; 3],
            compliance: None,
        }
    }
}

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
    /// The same with voxels joined two by two by two.
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
    /// Scheduled frames per simulated second, 0 (only on request) to 100.
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
    /// volume's own order and the quickest of full resolution, `preview` is that at half the resolution.
    #[serde(default = "Drr::default_projector")]
    pub projector: Projector,
    /// Samples of `slice_ordered` for each voxel of the farthest slice, 1 to 4; more are slower and closer to `joseph`.
    #[serde(default = "Drr::default_oversampling")]
    pub oversampling: f64,
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
    fn default_threads() -> usize {
        2
    }
}

/// A part of the tool that a controller drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Drives {
    /// The tendons.
    Tendon,
    /// The arm.
    Arm,
    /// The burr.
    Burr,
    /// The C-arm: only its driver may ask for frames from a pose of its own. Undriven, everybody may.
    CArm,
}

/// Who drives the tool. Exactly one of `curved_drilling`, `skiving`, `tension_sweep`, `hold`, `command` and `external`
/// says what it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Controller {
    /// Name within the session: letters, digits, `_`.
    pub name: String,
    /// What it drives; no part has two drivers.
    pub drives: Vec<Drives>,
    /// The built-in curved drilling.
    pub curved_drilling: Option<CurvedDrilling>,
    /// The built-in test of skiving: a straight feed that reports how far the burr leaves its line.
    pub skiving: Option<Skiving>,
    /// The built-in sweep of the tendon, from which `trabecula calibrate` writes a calibration.
    pub tension_sweep: Option<TensionSweep>,
    /// The built-in controller that holds a tension.
    pub hold: Option<Hold>,
    /// A program to start, with its arguments; it finds the session's folder in the environment variable
    /// `TRABECULA_SESSION` and its own name in `TRABECULA_CONTROLLER`.
    pub command: Option<Vec<String>>,
    /// True if somebody else starts it.
    #[serde(default)]
    pub external: bool,
    /// How long the start of the run waits for it if it is external, 1 to 3600 s.
    #[serde(default = "Controller::default_connect_limit_s")]
    pub connect_limit_s: f64,
    /// True if an external controller may join when it likes: the run begins without it.
    #[serde(default)]
    pub optional: bool,
}

impl Controller {
    fn default_connect_limit_s() -> f64 {
        60.0
    }
}

/// What corrects the tension of curved drilling toward the planned path.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Feedback {
    /// The burr seen in X-ray frames; the feed waits for the first frame.
    #[default]
    Image,
    /// The measured shape (as by fibre Bragg gratings), 20 times a simulated second.
    Shape,
    /// Nothing: open loop.
    None,
}

/// Curved drilling: advance with the burr on, pull the tendon along a ramp, and correct the tension by what is measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvedDrilling {
    /// Feed of the tool base, 0.01 to 20 mm/s.
    pub feed_mm_per_s: f64,
    /// Length of the feed, 0 to 200 mm.
    pub insertion_mm: f64,
    /// Tension at the end of the ramp, 0 to 60 N; either this or `calibration`.
    pub tension_n: Option<f64>,
    /// A file of `trabecula calibrate`, from the scene file's folder: the ramp is then one of the bend up to that of the
    /// arc to `target_mm`, and the tension follows from the calibration. Either this or `tension_n`.
    pub calibration: Option<PathBuf>,
    /// What corrects the tension.
    #[serde(default)]
    pub feedback: Feedback,
    /// Inserted length at which the ramp begins, 0 to 200 mm.
    #[serde(default)]
    pub ramp_start_mm: f64,
    /// Inserted length at which the ramp ends, more than its begin, to 200 mm.
    pub ramp_end_mm: f64,
    /// Burr speed, 0 to 60000 rpm.
    pub burr_speed_rpm: f64,
    /// Where the burr is to end, patient frame; the feedback corrects the tension toward the arc to it.
    pub target_mm: Option<[f64; 3]>,
    /// Tension per millimetre of sideways error measured, 0 to 10 N/mm.
    #[serde(default)]
    pub guidance_gain_n_per_mm: f64,
    /// Length by which the tool is drawn back at the end, so that the tunnel shows, 0 to 200 mm.
    #[serde(default)]
    pub retraction_mm: f64,
    /// Speed of that, 0.01 to 100 mm/s.
    #[serde(default = "CurvedDrilling::default_retraction_mm_per_s")]
    pub retraction_mm_per_s: f64,
}

impl CurvedDrilling {
    fn default_retraction_mm_per_s() -> f64 {
        10.0
    }
}

/// A straight feed with the burr on. Where the bone is denser on one side, the burr skives: it leaves its line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Skiving {
    /// Feed of the tool base, 0.01 to 20 mm/s.
    pub feed_mm_per_s: f64,
    /// Length of the feed, 0.1 to 200 mm.
    pub depth_mm: f64,
    /// Tension of both tendons, which stiffens the tool, 0 to 60 N.
    #[serde(default)]
    pub tension_n: f64,
    /// Burr speed, 0 to 60000 rpm.
    pub burr_speed_rpm: f64,
}

/// Pulls tendon 0 in steps up and down again, with the arm held and the burr at rest. By tension (`most_n`, `step_n`) or
/// by displacement (`most_mm`, `step_mm`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TensionSweep {
    /// Greatest tension, 0.1 to 60 N.
    pub most_n: Option<f64>,
    /// Step of the tension, 0.01 N to the greatest.
    pub step_n: Option<f64>,
    /// Greatest displacement, 0.01 to 20 mm.
    pub most_mm: Option<f64>,
    /// Step of the displacement, 0.001 mm to the greatest.
    pub step_mm: Option<f64>,
    /// Time of each level: half of it to go there, half to settle; 0.02 to 60 s.
    #[serde(default = "TensionSweep::default_settle_s")]
    pub settle_s: f64,
}

impl TensionSweep {
    fn default_settle_s() -> f64 {
        0.5
    }
}

/// Holds a tension and the arm, with the burr at rest; of these, what the controller drives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hold {
    /// Tension of tendon 0, 0 to 60 N.
    pub tension_n: f64,
}

/// Which frames are recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Images {
    /// All, whole.
    Full,
    /// Only their geometry and hash: they can be rendered again.
    HashOnly,
    /// None, and no hash either.
    None,
}

/// What is recorded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Recording {
    /// Frames whole; only their geometry and hash, from which they can be rendered again; or nothing of them.
    pub images: Images,
    /// Simulated time between two keyframes, from which a replay can begin; 0.01 to 3600 s, or 0 for none.
    pub keyframe_interval_s: f64,
    /// With `images = "full"`, every how many frames the image is recorded, 1 to 1000000; of the others the hash.
    pub image_every: u64,
}

impl Recording {
    /// Whether the image of a frame (`Frame.sequence`, from 1) is recorded.
    pub fn keeps_image(&self, sequence: u64) -> bool {
        self.images == Images::Full && sequence.saturating_sub(1).is_multiple_of(self.image_every.max(1))
    }
}

impl Default for Recording {
    fn default() -> Self {
        Recording { images: Images::Full, keyframe_interval_s: 2.0, image_every: 1 }
    }
}
