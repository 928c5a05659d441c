//! `[arm]`: what carries the tool.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The arm: its model, its limits and how it holds the tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Arm {
    /// Name of a Universal Robots arm; `gantry`: three linear axes that do not rotate the tool; or `fixed`:
    /// no arm, the tool's base is held at the pose that `[tool]` gives. Absent: `ur5`.
    pub model: Option<ArmModel>,
    /// URDF file of another serial arm with six or seven revolute joints, relative to the scene file's
    /// folder; replaces `model`. The joints between its base and its tip become `[[arm.joint]]`, so a log
    /// needs no file. A joint of no stated speed (absent, 0 or beyond 10 turns per second) may turn at 180
    /// deg/s.
    #[schemars(extend("x-kind" = "path", "x-absent" = "none"))]
    pub urdf: Option<PathBuf>,
    /// Link of the URDF file where the arm begins. Absent: the only link without a parent.
    #[schemars(extend("x-absent" = "none"))]
    pub base_link: Option<String>,
    /// Link of the URDF file that is the flange, +z along the tool. Absent: the only link without a child.
    #[schemars(extend("x-absent" = "none"))]
    pub tip_link: Option<String>,
    /// Whether the arm is drawn with the meshes of the URDF file; absent: yes. `false`: draws tubes between
    /// its joints, and no mesh file is needed.
    #[schemars(extend("x-absent" = "true"))]
    pub meshes: Option<bool>,
    /// Largest speed of the tool's base along a path.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub max_speed_mm_per_s: f64,
    /// Its largest acceleration.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_acceleration_mm_per_s2: f64,
    /// Its largest jerk.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_jerk_mm_per_s3: f64,
    /// Largest angular speed of the tool's base along a path; 0.5 rad/s by default.
    #[schemars(range(min = 0.01, max = 360.0))]
    pub max_turn_deg_per_s: Option<f64>,
    /// Its largest angular acceleration; 2.5 rad/s² by default.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_turn_deg_per_s2: Option<f64>,
    /// Its largest angular jerk; 25 rad/s³ by default.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_turn_deg_per_s3: Option<f64>,
    /// Largest speed of each joint; by default the arm's own (UR5: 180, Universal Robots' figure). A joint
    /// whose own limit is lower keeps it.
    #[schemars(range(min = 0.01, max = 180.0))]
    pub max_joint_speed_deg_per_s: Option<f64>,
    /// Largest acceleration of each joint; 5 rad/s² by default.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_joint_acceleration_deg_per_s2: Option<f64>,
    /// Largest jerk of each joint; 50 rad/s³ by default.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_joint_jerk_deg_per_s3: Option<f64>,
    /// Lower joint limits, one per joint; −360, elbow −180 by default.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub lower_joints_deg: Option<Vec<f64>>,
    /// Upper joint limits, each above the lower one; 360, elbow 180 by default.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub upper_joints_deg: Option<Vec<f64>>,
    /// Joint angles at the start, each within its limits. The arm's base is placed so that the tool then has
    /// the pose of `[tool]`. By default far from every singularity.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub initial_joints_deg: Option<Vec<f64>>,
    /// Name of the joint of `[[arm.joint]]` that keeps its angle while a seven-joint arm moves the tool along
    /// a path (`move_cp`, `insert`, `rcm`). Absent: the third revolute joint, as KUKA's E1 and Franka's
    /// elbow.
    #[schemars(extend("x-absent" = "the third revolute joint"))]
    pub redundant_joint: Option<String>,
    /// Travel of each axis of a gantry to either side of its start; 250 by default. The axes are those of the
    /// flange's frame; their speed limits are those of the tool's base.
    #[schemars(inner(range(min = 1.0, max = 5000.0)))]
    pub travel_mm: Option<[f64; 3]>,
    /// Position of the tool's base in the flange's frame.
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub tool_position_mm: [f64; 3],
    /// Orientation of the tool's base in the flange's frame: axis times angle.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub tool_rotation_vector_deg: [f64; 3],
    /// Length of the holder on the flange, which is the drive that turns the burr and pulls the tendons; 60
    /// by default, and at most up to the tool's base. Beyond it the tool's shaft is bare. Without an offset
    /// between flange and tool base there is neither holder nor bare shaft.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub holder_length_mm: Option<f64>,
    /// Outer diameter of the holder; 40 by default.
    #[schemars(range(min = 1.0, max = 500.0))]
    pub holder_diameter_mm: Option<f64>,
    /// Largest force of the tool on the flange. A larger one stops the arm until a controller commands
    /// `hold`; then it can move away. By default 150 N for an arm of Universal Robots, as it is delivered,
    /// and no limit for others.
    #[schemars(range(min = 1.0, max = 1e5), extend("x-absent" = "standard"))]
    pub max_force_n: Option<f64>,
    /// Elastic joints; absent: rigid, at no cost.
    #[schemars(extend("x-absent" = "none"))]
    pub compliance: Option<ArmCompliance>,
    /// The joints of another serial arm, from base to flange, as derived from `urdf`; replaces `model`. Six
    /// or seven of them are revolute.
    #[schemars(length(max = 64), extend("x-absent" = "none"))]
    pub joint: Option<Vec<ArmJoint>>,
    /// X-ray frames show the arm's meshes as aluminium diluted to this density, uniform over the enclosed
    /// volume: a link's mass over its volume, an estimated 1.0 to 1.8 for a UR5 (solid aluminium 2.7). The
    /// meshes must be closed. Absent: frames show no arm, at no cost.
    #[schemars(range(min = 0.001, max = 2.7), extend("x-absent" = "none"))]
    pub xray_density_g_per_cm3: Option<f64>,
    /// Meshes that the arm is drawn with, as derived from `urdf`; links without one are drawn as tubes. They
    /// affect only the arm's appearance, also in X-ray frames.
    #[schemars(length(max = MOST_MESHES), extend("x-absent" = "none"))]
    pub mesh: Option<Vec<ArmMesh>>,
}

/// Largest number of mesh files of an arm.
pub const MOST_MESHES: usize = 256;

impl Default for Arm {
    fn default() -> Self {
        Arm {
            model: None,
            urdf: None,
            base_link: None,
            tip_link: None,
            meshes: None,
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
            redundant_joint: None,
            travel_mm: None,
            tool_position_mm: [0.0; 3],
            tool_rotation_vector_deg: [0.0; 3],
            holder_length_mm: None,
            holder_diameter_mm: None,
            max_force_n: None,
            compliance: None,
            joint: None,
            xray_density_g_per_cm3: None,
            mesh: None,
        }
    }
}

impl Arm {
    /// The joints from the arm's base up to the link that a mesh belongs to; empty for the base.
    pub fn joints_before(&self, mesh: &ArmMesh) -> &[ArmJoint] {
        let joints = self.joint.as_deref().unwrap_or_default();
        let named = mesh.joint.as_ref().and_then(|name| joints.iter().position(|joint| joint.name == *name));
        &joints[..named.map_or(0, |index| index + 1)]
    }
}

/// What carries the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ArmModel {
    /// UR3 of the CB3 series.
    Ur3,
    /// UR3e.
    Ur3e,
    /// UR5 of the CB3 series.
    #[default]
    Ur5,
    /// UR5e.
    Ur5e,
    /// UR10e.
    Ur10e,
    /// UR16e.
    Ur16e,
    /// UR20.
    Ur20,
    /// Three linear axes; the tool keeps its orientation.
    Gantry,
    /// No arm: the tool's base is held.
    Fixed,
}

/// A joint of a serial arm, as in URDF: its frame in the link before it, and its axis and limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmJoint {
    /// Its name.
    pub name: String,
    /// Position of its frame in the frame of the joint before it, or in the arm's base.
    #[serde(default)]
    #[schemars(inner(range(min = -10000.0, max = 10000.0)))]
    pub position_mm: [f64; 3],
    /// Orientation of its frame there: rotations about the fixed axes x, y and z, in this order (URDF's roll,
    /// pitch, yaw).
    #[serde(default)]
    #[schemars(inner(range(min = -720.0, max = 720.0)))]
    pub roll_pitch_yaw_deg: [f64; 3],
    /// Axis of rotation in its frame, of any length; absent: a fixed joint.
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub axis: Option<[f64; 3]>,
    /// Lower limit of a revolute joint.
    #[schemars(range(min = -720.0, max = 720.0))]
    pub lower_deg: Option<f64>,
    /// Upper limit of a revolute joint, above the lower one.
    #[schemars(range(min = -720.0, max = 720.0))]
    pub upper_deg: Option<f64>,
    /// Largest speed of a revolute joint.
    #[schemars(range(min = 0.01, max = 3600.0))]
    pub max_speed_deg_per_s: Option<f64>,
}

/// A mesh that a link of the arm is drawn with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmMesh {
    /// Joint of `[[arm.joint]]` that it moves with; absent: it is fixed to the arm's base.
    #[schemars(extend("x-absent" = "none"))]
    pub joint: Option<String>,
    /// Mesh file, relative to the scene file's folder: STL or OBJ. Other formats, such as COLLADA, are
    /// skipped with a warning.
    #[schemars(extend("x-kind" = "path"))]
    pub file: PathBuf,
    /// Position of the mesh's frame in that of the joint, or in the arm's base.
    #[serde(default)]
    #[schemars(inner(range(min = -10000.0, max = 10000.0)))]
    pub position_mm: [f64; 3],
    /// Orientation of the mesh's frame there: rotations about the fixed axes x, y and z, in this order
    /// (URDF's roll, pitch, yaw).
    #[serde(default)]
    #[schemars(inner(range(min = -720.0, max = 720.0)))]
    pub roll_pitch_yaw_deg: [f64; 3],
    /// Metres per file unit along each axis of the mesh's frame: 0.001 for a file in millimetres; negative
    /// values mirror it.
    #[serde(default = "ArmMesh::default_scale")]
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub scale: [f64; 3],
    /// XXH3-128 of the file in hexadecimal digits, as recorded by a run with `arm.xray_density_g_per_cm3`:
    /// another file of this name is refused.
    #[schemars(extend("x-absent" = "none"))]
    pub file_xxh3: Option<String>,
}

defaults!(ArmMesh { default_scale: [f64; 3] = [1.0; 3] });

/// A spring and a damper in each joint of the arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmCompliance {
    /// Stiffness of the joints, base to wrist.
    #[schemars(inner(range(min = 1.0, max = 1e7)))]
    pub joint_stiffness_nm_per_rad: [f64; 6],
    /// Damping of the joints, base to wrist.
    #[schemars(inner(range(min = 0.0, max = 1e5)))]
    pub joint_damping_nms_per_rad: [f64; 6],
}
