//! What an arm is made of, what it can be told, and why it may refuse.

use super::inverse::{KinematicsError, check_pose};
use super::kinematics::{Joints, UrGeometry};
use super::trajectory::TrajectoryError;
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use thiserror::Error;

/// Joint angles, velocities, accelerations and jerks that the arm keeps to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Least joint angle.
    pub lower_rad: Joints,
    /// Greatest joint angle.
    pub upper_rad: Joints,
    /// Greatest absolute joint velocity.
    pub velocity_rad_s: Joints,
    /// Greatest absolute joint acceleration.
    pub acceleration_rad_s2: Joints,
    /// Greatest absolute joint jerk.
    pub jerk_rad_s3: Joints,
}

/// Limits of the flange on a straight line (`move_cp`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CartesianLimits {
    /// Greatest speed of the flange's origin.
    pub speed_m_s: f64,
    /// Greatest acceleration of the flange's origin.
    pub acceleration_m_s2: f64,
    /// Greatest jerk of the flange's origin.
    pub jerk_m_s3: f64,
    /// Greatest turning rate of the flange.
    pub angular_speed_rad_s: f64,
    /// Greatest angular acceleration of the flange.
    pub angular_acceleration_rad_s2: f64,
    /// Greatest angular jerk of the flange.
    pub angular_jerk_rad_s3: f64,
}

/// Everything that fixes an arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmParameters {
    /// Link lengths.
    pub geometry: UrGeometry,
    /// Where the arm's base (Denavit-Hartenberg frame 0) stands in the patient frame.
    pub t_world_arm_base: Isometry3<f64>,
    /// Limits of the joints.
    pub joint_limits: JointLimits,
    /// Limits of the flange on straight lines.
    pub cartesian_limits: CartesianLimits,
    /// Length of a tick.
    pub dt_s: f64,
}

impl ArmParameters {
    /// A UR5 at the world's origin. Angles ±360° (elbow ±180°) and 180°/s are Universal Robots' figures
    /// (Universal_Robots_ROS2_Description, `config/ur5/joint_limits.yaml`); accelerations and jerks are not published:
    /// 5 rad/s² and 50 rad/s³ here, reached in 0.1 s. The flange's limits on a line are those of a careful insertion.
    pub fn ur5(dt_s: f64) -> Self {
        let range_rad = [TAU, TAU, PI, TAU, TAU, TAU];
        Self {
            geometry: UrGeometry::ur5(),
            t_world_arm_base: Isometry3::identity(),
            joint_limits: JointLimits {
                lower_rad: range_rad.map(|x| -x),
                upper_rad: range_rad,
                velocity_rad_s: [PI; 6],
                acceleration_rad_s2: [5.0; 6],
                jerk_rad_s3: [50.0; 6],
            },
            cartesian_limits: CartesianLimits {
                speed_m_s: 0.1,
                acceleration_m_s2: 0.5,
                jerk_m_s3: 5.0,
                angular_speed_rad_s: 0.5,
                angular_acceleration_rad_s2: 2.5,
                angular_jerk_rad_s3: 25.0,
            },
            dt_s,
        }
    }

    pub(super) fn check(&self) -> Result<(), ArmError> {
        let j = &self.joint_limits;
        let c = &self.cartesian_limits;
        check_pose(&self.t_world_arm_base).map_err(ArmError::BasePose)?;
        let positive = |name: &'static str, values: &[f64]| match values
            .iter()
            .find(|x| !(**x > 0.0 && x.is_finite()))
        {
            Some(given) => Err(ArmError::InvalidParameter { name, given: *given }),
            None => Ok(()),
        };
        positive("dt_s", &[self.dt_s])?;
        positive("velocity_rad_s", &j.velocity_rad_s)?;
        positive("acceleration_rad_s2", &j.acceleration_rad_s2)?;
        positive("jerk_rad_s3", &j.jerk_rad_s3)?;
        positive("speed_m_s", &[c.speed_m_s, c.angular_speed_rad_s])?;
        positive("acceleration_m_s2", &[c.acceleration_m_s2, c.angular_acceleration_rad_s2])?;
        positive("jerk_m_s3", &[c.jerk_m_s3, c.angular_jerk_rad_s3])?;
        let g = &self.geometry;
        positive("geometry", &[g.d1_m, -g.a2_m, -g.a3_m, g.d4_m, g.d5_m, g.d6_m])?;
        for i in 0..6 {
            let (lower, upper) = (j.lower_rad[i], j.upper_rad[i]);
            if !(lower < upper && lower >= -2.0 * TAU && upper <= 2.0 * TAU) {
                return Err(ArmError::InvalidRange { joint: i + 1, lower_rad: lower, upper_rad: upper });
            }
        }
        Ok(())
    }

    pub(super) fn check_joints(&self, q_rad: &Joints) -> Result<(), ArmError> {
        let limits = &self.joint_limits;
        for (i, &given_rad) in q_rad.iter().enumerate() {
            let (lower_rad, upper_rad) = (limits.lower_rad[i], limits.upper_rad[i]);
            if !(lower_rad..=upper_rad).contains(&given_rad) {
                return Err(ArmError::JointOutsideLimits { joint: i + 1, given_rad, lower_rad, upper_rad });
            }
        }
        Ok(())
    }
}

/// A comfortable configuration: far from every singularity and limit (manipulability 0.093 m³ for the UR5).
pub const COMFORTABLE_Q_RAD: Joints = [0.0, -1.2, 1.8, -2.2, -FRAC_PI_2, 0.0];

/// Stands the arm where it holds its flange at `t_world_flange` in the comfortable configuration.
///
/// Returns `(T_world_arm_base, joint angles)`. The base takes whatever orientation that needs: an arm on a cart, a wall
/// or a ceiling. The flange then moves 100 mm and more in every direction (tested).
pub fn place_base_for(geometry: &UrGeometry, t_world_flange: &Isometry3<f64>) -> (Isometry3<f64>, Joints) {
    (t_world_flange * geometry.forward(&COMFORTABLE_Q_RAD).inverse(), COMFORTABLE_Q_RAD)
}

/// What the arm can be told, named after CRTK. `speed_fraction` in (0, 1] scales the joints' velocity limits.
///
/// A command equal to the last accepted one changes nothing, so a latched command may be given again every tick.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ArmCommand {
    /// Stop as soon as the jerk limits allow (on the line, during `MoveCp`) and stay.
    Hold,
    /// Follow a joint target that may change every tick; each joint as early as its limits allow.
    ServoJp {
        /// Target angles.
        q_rad: Joints,
        /// Share of the joints' velocity limits.
        speed_fraction: f64,
    },
    /// Go to a joint goal and stay; from rest, all joints in proportion.
    MoveJp {
        /// Goal angles.
        q_rad: Joints,
        /// Share of the joints' velocity limits.
        speed_fraction: f64,
    },
    /// Follow a flange target through the joints: the nearest solution of the inverse kinematics.
    ServoCp {
        /// Target of the flange in the patient frame.
        t_world_flange: Isometry3<f64>,
        /// Share of the joints' velocity limits.
        speed_fraction: f64,
    },
    /// Move the flange on a straight line with a turn about a fixed axis. From motion, the arm stops first, except along
    /// the line it is already on: then goal and speed change smoothly.
    MoveCp {
        /// Goal of the flange in the patient frame.
        t_world_flange: Isometry3<f64>,
        /// Speed of the flange's origin, up to the arm's limit, which `None` stands for.
        max_speed_m_s: Option<f64>,
        /// Turning rate of the flange, up to the arm's limit, which `None` stands for.
        max_angular_speed_rad_s: Option<f64>,
    },
}

/// Why an arm cannot be built or a command is refused. A refused command leaves the motion as it was.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum ArmError {
    /// The base's pose is not a pose.
    #[error("t_world_arm_base: {0}")]
    BasePose(KinematicsError),
    /// A limit, a length or the tick is not a positive number.
    #[error("arm parameter {name} is {given}, a positive finite number is needed")]
    InvalidParameter {
        /// Name of the parameter (its linear or its angular value).
        name: &'static str,
        /// The value.
        given: f64,
    },
    /// A joint's range is empty or wider than four turns.
    #[error(
        "joint {joint} has the range {lower_rad} to {upper_rad} rad; lower < upper within ±4 pi is needed"
    )]
    InvalidRange {
        /// Joint, 1 to 6.
        joint: usize,
        /// Lower limit.
        lower_rad: f64,
        /// Upper limit.
        upper_rad: f64,
    },
    /// A joint angle is NaN or outside its limits.
    #[error(
        "joint {joint} was given {given_rad} rad, its range is {lower_rad} to {upper_rad} rad; send an angle in it"
    )]
    JointOutsideLimits {
        /// Joint, 1 to 6.
        joint: usize,
        /// Given angle.
        given_rad: f64,
        /// Lower limit.
        lower_rad: f64,
        /// Upper limit.
        upper_rad: f64,
    },
    /// A speed or speed fraction is NaN, not positive or above the arm's.
    #[error("{name} is {given}; a number above 0 and up to {maximum} is needed")]
    SpeedOutOfRange {
        /// Name of the field.
        name: &'static str,
        /// Given value.
        given: f64,
        /// Greatest accepted value.
        maximum: f64,
    },
    /// The goal pose has no joint angles.
    #[error("flange goal: {0}")]
    Goal(KinematicsError),
    /// The straight line has a pose without joint angles.
    #[error("at {fraction} of the straight line: {reason}")]
    LineUnreachable {
        /// Share of the line, 0 to 1.
        fraction: f64,
        /// Why.
        reason: KinematicsError,
    },
    /// The straight line passes a singularity, or so close to one that the joints would swing.
    #[error(
        "at {fraction} of the straight line the arm passes a singularity (manipulability {manipulability_m3} m³); \
         choose another line, go there by joints, or place the base elsewhere"
    )]
    LineSingular {
        /// Share of the line, 0 to 1.
        fraction: f64,
        /// |det J| there.
        manipulability_m3: f64,
    },
    /// No jerk-limited trajectory.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}
