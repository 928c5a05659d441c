//! What an arm tells after a tick.

use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use super::{ArmError, Joints};

/// Which command the arm follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ArmMode {
    /// Stopping or standing.
    Hold,
    /// Following a joint target.
    ServoJp,
    /// Turning the joints at given rates.
    ServoJv,
    /// Going to a joint goal.
    MoveJp,
    /// Following a target of the tool's base through the joints.
    ServoCp,
    /// Moving the tool's base on a straight line.
    MoveCp,
    /// Moving the tool's base along an axis without turning it.
    Insert,
    /// Moving the tool's base about a remote centre of motion.
    Rcm,
}

/// The arm after a tick.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmState {
    /// Joint angles.
    pub q_rad: Joints,
    /// Joint velocities.
    pub qd_rad_s: Joints,
    /// Joint accelerations.
    pub qdd_rad_s2: Joints,
    /// Pose of the tool's base in the patient frame.
    pub t_world_tool: Isometry3<f64>,
    /// Velocity of the tool base's origin, world axes.
    pub linear_velocity_m_s: Vector3<f64>,
    /// Angular velocity of the tool's base, world axes.
    pub angular_velocity_rad_s: Vector3<f64>,
    /// Acceleration of the tool base's origin, world axes.
    pub linear_acceleration_m_s2: Vector3<f64>,
    /// Angular acceleration of the tool's base, world axes.
    pub angular_acceleration_rad_s2: Vector3<f64>,
    /// The command being followed.
    pub mode: ArmMode,
    /// The goal is reached (for `Hold`: the arm stands) and the arm is at rest.
    pub done: bool,
    /// Why an accepted motion was given up and the arm stopped, or why a joint of `ServoJv` stopped; `None` again with the
    /// next accepted command. Nothing depends on it: it is not saved in bytes.
    #[serde(skip)]
    pub fault: Option<ArmError>,
}
