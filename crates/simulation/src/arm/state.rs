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
    /// Why the arm aborted an accepted motion, or why a joint of `ServoJv` stopped; cleared by the next
    /// accepted command. Not serialised: only whether there is a fault matters, which the state message says.
    #[serde(skip)]
    pub fault: Option<ArmError>,
    /// State of the protective stop.
    pub protective_stop: ProtectiveStop,
}

/// State of the protective stop, which an excessive force on the flange triggers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ProtectiveStop {
    /// Not triggered: a force above the limit stops the arm.
    Armed,
    /// The arm is stopped and accepts only `Hold`, which releases it.
    Stopped {
        /// The largest force since then, N: the tendons can keep pulling while the arm is stopped.
        force_n: f64,
    },
    /// The arm may move away from the obstacle: until the force has dropped below the limit, only a force
    /// above [`RELEASED_SHARE`] times the largest during the stop stops it again.
    Released {
        /// The largest force during the stop, N.
        force_n: f64,
    },
}

impl ProtectiveStop {
    /// Returns whether the arm is stopped and must be released.
    pub fn is_stopped(&self) -> bool {
        matches!(self, ProtectiveStop::Stopped { .. })
    }
}

/// Factor by which a released arm may exceed the force of its stop.
pub const RELEASED_SHARE: f64 = 1.1;
