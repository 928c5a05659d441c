//! What a scene file may say.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::drr::Drr;
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

/// How the physics waits for its tick, and physics and controllers for each other.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wait {
    /// Never sleeps, while there are more cores than parts that spin.
    Spin,
    /// Sleeps at once.
    Event,
    /// Looks for a short while, as long as nobody else needs the core, and then sleeps.
    #[default]
    Hybrid,
}

/// How the system's scheduler treats the physics and the controllers in real time, where it is permitted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Policy {
    /// As other programs, with more weight.
    #[default]
    Other,
    /// Before all other programs (`SCHED_FIFO`).
    Fifo,
}

/// How the scene runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// Lockstep: as fast as the parts allow, every tick waits for every controller. Real time: by the wall clock.
    pub mode: Mode,
    /// Simulated time of the whole run, 0.001 to 86400 s (a day).
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
    /// How the physics waits for its tick, and physics and controllers for each other: see docs/timing.md.
    #[serde(default)]
    pub wait: Wait,
    /// Real time: how the scheduler treats physics and controllers, where the system permits it.
    #[serde(default)]
    pub policy: Policy,
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ManipulatorRung {
    /// An arc of one curvature.
    ConstantCurvature,
    /// A chain that bends in one plane.
    #[default]
    Planar,
    /// A chain that bends, bends laterally and twists.
    Spatial,
    /// A chain whose flexures have all six freedoms.
    Full,
}

/// Integrators of the manipulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Integrator {
    /// First order, never unstable.
    LinearlyImplicitEuler,
    /// Second order in free motion, linearly implicit Euler otherwise.
    #[default]
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
    /// What a voxel is to the tool: `planes` is the standard; `balls` is a published way, for experiments.
    pub voxels: Option<ContactVoxels>,
}

/// What a voxel is to a sphere of the tool that touches it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ContactVoxels {
    /// A part of the bone's smoothed surface, a plane to the sphere.
    #[default]
    Planes,
    /// A ball in the voxel's middle.
    Balls,
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
    /// How voxels end: `energy` is the standard; the others are published rules, for experiments.
    pub removal: Option<Removal>,
}

/// How a burr removes voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Removal {
    /// By the energy that it takes to cut them.
    Energy,
    /// All that the burr touches, at once.
    Naive,
    /// At most ten touched voxels a tick, in proportion to the burr's speed.
    Capped,
    /// A strength in proportion to density, less a value in proportion to the burr's speed each tick.
    Decrement,
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
    /// True if a controller with `external` or `command` may join and leave when it likes: the run begins without it, and
    /// a `command` that ends does not end the run.
    #[serde(default)]
    pub optional: bool,
    /// How often a `command` that ends before the run does is started again, 0 to 1000.
    #[serde(default)]
    pub restarts: u32,
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

/// What happens when the recorder is so late that its queues would overflow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnFull {
    /// The physics waits for it.
    Wait,
    /// The log has a gap.
    Gap,
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
    /// When the recorder is so late that its queues would overflow, in real time: the log has a gap, and the run says so and ends with
    /// exit code 3; or the physics waits, and its ticks begin late. Lockstep always waits.
    pub on_full: OnFull,
}

impl Recording {
    /// Whether the image of a frame (`Frame.sequence`, from 1) is recorded.
    pub fn keeps_image(&self, sequence: u64) -> bool {
        self.images == Images::Full && sequence.saturating_sub(1).is_multiple_of(self.image_every.max(1))
    }
}

impl Default for Recording {
    fn default() -> Self {
        // A tick in its time is what real time is for: the gap costs the log, a wait costs whoever holds the tool.
        Recording { images: Images::Full, keyframe_interval_s: 2.0, image_every: 1, on_full: OnFull::Gap }
    }
}
