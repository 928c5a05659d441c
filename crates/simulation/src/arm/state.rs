//! The arm's state after a tick.

use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use super::{ArmError, Joints};

/// The kind of command that the arm is following.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ArmMode {
    /// Stopping or at rest.
    Hold,
    /// Following a joint target.
    ServoJp,
    /// Moving the joints at given rates.
    ServoJv,
    /// Moving to a joint goal.
    MoveJp,
    /// Following a Cartesian target in joint space.
    ServoCp,
    /// Moving the tool's base along a straight line.
    MoveCp,
    /// Moving the tool's base along an axis without rotation.
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
    /// The arm is at rest at its goal (for `Hold`: at rest).
    pub done: bool,
    /// Why the arm abandoned an accepted motion, or why a joint of `ServoJv` stopped; cleared by the next
    /// accepted command. Not serialised, because nothing depends on it.
    #[serde(skip)]
    pub fault: Option<ArmError>,
    /// Whether the arm stopped because of a force.
    pub protective_stop: ProtectiveStop,
}

/// What a force on the flange has done to the arm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ProtectiveStop {
    /// Nothing: a force above the limit stops the arm.
    Armed,
    /// The arm stopped and takes no command but `Hold`, which releases it.
    Stopped {
        /// The largest force since then, N: the tendons may pull on while the arm stands.
        force_n: f64,
    },
    /// The arm may move away from what it pressed on: a force above [`RELEASED_SHARE`] of the largest while
    /// it stood stops it again, until the force has been below the limit.
    Released {
        /// The largest force while it stood, N.
        force_n: f64,
    },
}

impl ProtectiveStop {
    /// Whether the arm stands and must be released.
    pub fn is_stopped(&self) -> bool {
        matches!(self, ProtectiveStop::Stopped { .. })
    }
}

/// How much harder than at its stop a released arm may press.
pub const RELEASED_SHARE: f64 = 1.1;
