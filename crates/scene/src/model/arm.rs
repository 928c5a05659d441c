//! `[arm]`: what carries the tool.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The arm: which one, its limits and how it holds the tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Arm {
    /// An arm of Universal Robots by its name; `gantry`: three linear axes that do not turn the tool; or
    /// `fixed`: no arm, the tool's base is held where `[tool]` says. Absent: `ur5`.
    pub model: Option<ArmModel>,
    /// URDF file of another serial arm with six or seven turning joints, from the scene file's folder; in
    /// place of `model`. The joints between its base and its tip become `[[arm.joint]]`, so a log needs no
    /// file.
    #[schemars(extend("x-kind" = "path", "x-absent" = "none"))]
    pub urdf: Option<PathBuf>,
    /// Link of the URDF file where the arm begins. Absent: the one link that hangs on no other.
    #[schemars(extend("x-absent" = "none"))]
    pub base_link: Option<String>,
    /// Link of the URDF file that is the flange, +z along the tool. Absent: the one link on which no other
    /// hangs.
    #[schemars(extend("x-absent" = "none"))]
    pub tip_link: Option<String>,
    /// Whether the arm is drawn with the meshes of the URDF file; absent: yes. `false`: tubes between its
    /// joints, and no mesh has to be there.
    #[schemars(extend("x-absent" = "true"))]
    pub meshes: Option<bool>,
    /// Fastest motion of the tool's base on a path.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub max_speed_mm_per_s: f64,
    /// Largest acceleration of it.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_acceleration_mm_per_s2: f64,
    /// Largest jerk of it.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_jerk_mm_per_s3: f64,
    /// Fastest turn of the tool's base on a path; 0.5 rad/s by default.
    #[schemars(range(min = 0.01, max = 360.0))]
    pub max_turn_deg_per_s: Option<f64>,
    /// Largest angular acceleration of it; 2.5 rad/s² by default.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_turn_deg_per_s2: Option<f64>,
    /// Largest angular jerk of it; 25 rad/s³ by default.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_turn_deg_per_s3: Option<f64>,
    /// Fastest turn of each joint; by default the arm's own (UR5: 180, Universal Robots' figure). A joint
    /// whose own is slower keeps it.
    #[schemars(range(min = 0.01, max = 180.0))]
    pub max_joint_speed_deg_per_s: Option<f64>,
    /// Largest acceleration of each joint; 5 rad/s² by default.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_joint_acceleration_deg_per_s2: Option<f64>,
    /// Largest jerk of each joint; 50 rad/s³ by default.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_joint_jerk_deg_per_s3: Option<f64>,
    /// Least angles of the joints, one each; −360, elbow −180 by default.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub lower_joints_deg: Option<Vec<f64>>,
    /// Greatest angles of the joints, each above the least; 360, elbow 180 by default.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub upper_joints_deg: Option<Vec<f64>>,
    /// Joint angles at the start, each within its range. The arm's base stands where the tool then is as
    /// `[tool]` says. Far from every singularity by default.
    #[schemars(length(min = 6, max = 7), inner(range(min = -360.0, max = 360.0)))]
    pub initial_joints_deg: Option<Vec<f64>>,
    /// The joint of `[[arm.joint]]` that keeps its angle while an arm of seven joints moves the tool on a
    /// path (`move_cp`, `insert`, `rcm`), by its name. Absent: the third that turns, as KUKA's E1 and
    /// Franka's elbow.
    #[schemars(extend("x-absent" = "the third that turns"))]
    pub redundant_joint: Option<String>,
    /// How far each axis of a gantry goes to either side of its start; 250 by default. The axes are those of
    /// the flange's frame, whose limits are those of the tool's base.
    #[schemars(inner(range(min = 1.0, max = 5000.0)))]
    pub travel_mm: Option<[f64; 3]>,
    /// Place of the tool's base in the flange's frame.
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub tool_position_mm: [f64; 3],
    /// Orientation of the tool's base in the flange's frame: axis times angle.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub tool_rotation_vector_deg: [f64; 3],
    /// Length of the holder on the flange, that of the drive that turns the burr and pulls the tendons; 60 by
    /// default, and at most up to the tool's base. From there on the tool's shaft is bare. Without a place of
    /// the tool's base off the flange there is neither.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub holder_length_mm: Option<f64>,
    /// Outer diameter of the holder; 40 by default.
    #[schemars(range(min = 1.0, max = 500.0))]
    pub holder_diameter_mm: Option<f64>,
    /// Largest force of the tool on the flange. A greater one stops the arm until a controller commands
    /// `hold`; it may then move away. No limit by default.
    #[schemars(range(min = 1.0, max = 1e5), extend("x-absent" = "none"))]
    pub max_force_n: Option<f64>,
    /// Elastic joints; absent: stiff, at no cost.
    #[schemars(extend("x-absent" = "none"))]
    pub compliance: Option<ArmCompliance>,
    /// The joints of another serial arm, from base to flange, as `urdf` makes them; in place of `model`. Six
    /// or seven of them turn.
    #[schemars(length(max = 64), extend("x-absent" = "none"))]
    pub joint: Option<Vec<ArmJoint>>,
    /// X-ray frames show the arm's meshes as aluminium thinned to this density, spread evenly over what a
    /// mesh encloses: a link's mass over its volume, an estimated 1.0 to 1.8 for a UR5 (solid aluminium 2.7).
    /// The meshes must be closed. Absent: frames show no arm, at no cost.
    #[schemars(range(min = 0.001, max = 2.7), extend("x-absent" = "none"))]
    pub xray_density_g_per_cm3: Option<f64>,
    /// Meshes that the arm is drawn with, as `urdf` finds them; links without one are drawn as tubes. Only
    /// the looks of the arm, in X-ray frames too.
    #[schemars(length(max = MOST_MESHES), extend("x-absent" = "none"))]
    pub mesh: Option<Vec<ArmMesh>>,
}

/// Mesh files of an arm, at most.
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
    /// The joints from the arm's base to the link that a mesh belongs to; none for the base.
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

/// A joint of a serial arm, as URDF describes it: where it stands in the link before it, and how it turns.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmJoint {
    /// Its name.
    pub name: String,
    /// Place of its frame in the frame of the joint before it, or in the arm's base.
    #[serde(default)]
    #[schemars(inner(range(min = -10000.0, max = 10000.0)))]
    pub position_mm: [f64; 3],
    /// Orientation of its frame there: turns about the fixed axes x, y and z, in this order (URDF's roll,
    /// pitch, yaw).
    #[serde(default)]
    #[schemars(inner(range(min = -720.0, max = 720.0)))]
    pub roll_pitch_yaw_deg: [f64; 3],
    /// Axis about which it turns, in its frame, of any length; absent: it does not turn.
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub axis: Option<[f64; 3]>,
    /// Least angle of a joint that turns.
    #[schemars(range(min = -720.0, max = 720.0))]
    pub lower_deg: Option<f64>,
    /// Greatest angle of a joint that turns, above the least.
    #[schemars(range(min = -720.0, max = 720.0))]
    pub upper_deg: Option<f64>,
    /// Fastest turn of a joint that turns.
    #[schemars(range(min = 0.01, max = 3600.0))]
    pub max_speed_deg_per_s: Option<f64>,
}

/// A mesh that a link of the arm is drawn with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmMesh {
    /// Joint of `[[arm.joint]]` with which it moves; absent: it stands with the arm's base.
    #[schemars(extend("x-absent" = "none"))]
    pub joint: Option<String>,
    /// Mesh file, from the scene file's folder: STL or OBJ. Another kind, such as COLLADA, is not drawn, and
    /// a warning says so.
    #[schemars(extend("x-kind" = "path"))]
    pub file: PathBuf,
    /// Place of the mesh's frame in that of the joint, or in the arm's base.
    #[serde(default)]
    #[schemars(inner(range(min = -10000.0, max = 10000.0)))]
    pub position_mm: [f64; 3],
    /// Orientation of the mesh's frame there: turns about the fixed axes x, y and z, in this order (URDF's
    /// roll, pitch, yaw).
    #[serde(default)]
    #[schemars(inner(range(min = -720.0, max = 720.0)))]
    pub roll_pitch_yaw_deg: [f64; 3],
    /// Metres for a unit of the file, along each axis of the mesh's frame: 0.001 for a file in millimetres;
    /// below 0 it is mirrored.
    #[serde(default = "ArmMesh::default_scale")]
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub scale: [f64; 3],
    /// XXH3-128 of the file in hexadecimal digits, as a run with `arm.xray_density_g_per_cm3` notes it:
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
