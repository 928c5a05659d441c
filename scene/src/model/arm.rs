//! `[arm]`: what carries the tool.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The arm: a UR5, its limits and how it holds the tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Arm {
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
    /// Fastest turn of each joint; 180 by default, Universal Robots' figure.
    #[schemars(range(min = 0.01, max = 180.0))]
    pub max_joint_speed_deg_per_s: Option<f64>,
    /// Largest acceleration of each joint; 5 rad/s² by default.
    #[schemars(range(min = 0.1, max = 1e4))]
    pub max_joint_acceleration_deg_per_s2: Option<f64>,
    /// Largest jerk of each joint; 50 rad/s³ by default.
    #[schemars(range(min = 1.0, max = 1e6))]
    pub max_joint_jerk_deg_per_s3: Option<f64>,
    /// Least angles of the six joints; −360, elbow −180 by default.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub lower_joints_deg: Option<[f64; 6]>,
    /// Greatest angles of the six joints, each above the least; 360, elbow 180 by default.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub upper_joints_deg: Option<[f64; 6]>,
    /// Joint angles at the start, each within its range. The arm's base stands where the tool then is as `[tool]` says.
    /// Far from every singularity by default.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub initial_joints_deg: Option<[f64; 6]>,
    /// Place of the tool's base in the flange's frame.
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub tool_position_mm: [f64; 3],
    /// Orientation of the tool's base in the flange's frame: axis times angle.
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub tool_rotation_vector_deg: [f64; 3],
    /// Largest force of the tool on the flange. A greater one stops the arm until a controller commands `hold`; it may then move away. No limit by default.
    #[schemars(range(min = 1.0, max = 1e5), extend("x-absent" = "none"))]
    pub max_force_n: Option<f64>,
    /// Elastic joints; absent: stiff, at no cost.
    #[schemars(extend("x-absent" = "none"))]
    pub compliance: Option<ArmCompliance>,
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
            max_force_n: None,
            compliance: None,
        }
    }
}

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
