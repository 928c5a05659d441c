//! Arm parameters, commands and errors.

use super::geometry::ArmGeometry;
use super::inverse::{KinematicsError, check_pose};
use super::kinematics::{Joints, UR_JOINTS};
use super::models::Link;
use super::path::LEAST_MANIPULABILITY_M3;
use super::trajectory::TrajectoryError;
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, TAU};
use thiserror::Error;

/// Limits of the joints: position, velocity, acceleration and jerk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Minimum joint angle.
    pub lower_rad: Joints,
    /// Maximum joint angle.
    pub upper_rad: Joints,
    /// Maximum absolute joint velocity.
    pub velocity_rad_s: Joints,
    /// Maximum absolute joint acceleration.
    pub acceleration_rad_s2: Joints,
    /// Maximum absolute joint jerk.
    pub jerk_rad_s3: Joints,
}

/// Limits of the tool's base on a path (`move_cp`, `insert`, `rcm`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CartesianLimits {
    /// Maximum speed of the origin.
    pub speed_m_s: f64,
    /// Maximum acceleration of the origin.
    pub acceleration_m_s2: f64,
    /// Maximum jerk of the origin.
    pub jerk_m_s3: f64,
    /// Maximum angular speed.
    pub angular_speed_rad_s: f64,
    /// Maximum angular acceleration.
    pub angular_acceleration_rad_s2: f64,
    /// Maximum angular jerk.
    pub angular_jerk_rad_s3: f64,
}

/// Complete definition of an arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmParameters {
    /// Kinematics.
    pub geometry: ArmGeometry,
    /// Link inertias, for elastic joints; `None` if unknown.
    pub links: Option<[Link; UR_JOINTS]>,
    /// Rated payload; `None` if unknown.
    pub payload_kg: Option<f64>,
    /// Force of the tool on the flange above which the arm stops, N; `None` for no limit.
    pub protective_stop_n: Option<f64>,
    /// T_world_arm_base: pose of the arm's base (Denavit-Hartenberg frame 0) in the patient frame.
    pub t_world_arm_base: Isometry3<f64>,
    /// Limits of the joints.
    pub joint_limits: JointLimits,
    /// Limits of the tool's base on paths.
    pub cartesian_limits: CartesianLimits,
    /// Duration of a tick.
    pub dt_s: f64,
}

impl ArmParameters {
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
        if let ArmGeometry::Ur(g) = &self.geometry {
            positive("geometry", &[g.d1_m, -g.a2_m, -g.a3_m, g.d4_m, g.d5_m, g.d6_m])?;
        }
        for i in 0..MAX_ARM_JOINTS {
            let (lower, upper) = (j.lower_rad[i], j.upper_rad[i]);
            if !(lower < upper && lower >= -2.0 * TAU && upper <= 2.0 * TAU) {
                return Err(ArmError::InvalidRange { joint: i + 1, lower_rad: lower, upper_rad: upper });
            }
        }
        Ok(())
    }

    /// Rejects values for joints that the arm does not have.
    pub(super) fn check_absent(&self, values: &Joints) -> Result<(), ArmError> {
        let joints = self.geometry.joints();
        // A gantry's axes take the places of an arm's joints.
        let absent = if joints > 0 { &values[joints..] } else { &[] };
        match absent.iter().position(|value| *value != 0.0) {
            Some(at) => Err(ArmError::NoSuchJoint { joint: joints + at + 1, joints, given: absent[at] }),
            None => Ok(()),
        }
    }

    pub(super) fn check_joints(&self, q_rad: &Joints) -> Result<(), ArmError> {
        self.check_absent(q_rad)?;
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

/// A configuration of Universal Robots arms far from every singularity and limit (manipulability 0.093 m³ for
/// the UR5, 0.018 m³ for the UR3).
pub const COMFORTABLE_Q_RAD: Joints = [0.0, -1.2, 1.8, -2.2, -FRAC_PI_2, 0.0, 0.0];

/// Returns `T_world_arm_base` that puts the tool's base at `t_world_tool` with the joint angles `q_rad`.
///
/// The arm's base takes whatever orientation this requires, as on a cart, wall or ceiling. In the comfortable
/// configuration, the tool can then move at least 100 mm in every direction (tested).
pub fn place_base_for(
    geometry: &ArmGeometry,
    t_world_tool: &Isometry3<f64>,
    q_rad: &Joints,
) -> Isometry3<f64> {
    t_world_tool * geometry.forward(q_rad).inverse()
}

/// Arm commands, named after CRTK. `speed_fraction` in (0, 1] scales the joint velocity limits.
///
/// A command equal to the last accepted one changes nothing, so a latched command may be repeated every tick.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum ArmCommand {
    /// Stop as fast as the jerk limits allow (along the path, if on one) and stay there.
    Hold,
    /// Follow a joint target that may change every tick; each joint moves in minimum time within its limits.
    ServoJp {
        /// Target angles.
        q_rad: Joints,
        /// Fraction of the joint velocity limits.
        speed_fraction: f64,
    },
    /// Move the joints at these rates until the next command. A joint that reaches the end of its range stops
    /// there; the others continue.
    ServoJv {
        /// Target rates.
        qd_rad_s: Joints,
    },
    /// Move to a joint goal and stay there; from rest, with all joints synchronised.
    MoveJp {
        /// Goal angles.
        q_rad: Joints,
        /// Fraction of the joint velocity limits.
        speed_fraction: f64,
    },
    /// Follow a Cartesian target in joint space, by the nearest inverse kinematics solution.
    ServoCp {
        /// Target pose of the tool's base in the patient frame.
        t_world_tool: Isometry3<f64>,
        /// Fraction of the joint velocity limits.
        speed_fraction: f64,
    },
    /// Move the tool's base along a straight line while turning about a fixed axis. An arm in motion stops
    /// first, unless the goal is on the line it is already following: then goal and speed change smoothly.
    MoveCp {
        /// Goal pose of the tool's base in the patient frame.
        t_world_tool: Isometry3<f64>,
        /// Speed of the origin, at most the arm's limit; `None` for the limit.
        max_speed_m_s: Option<f64>,
        /// Angular speed, at most the arm's limit; `None` for the limit.
        max_angular_speed_rad_s: Option<f64>,
    },
    /// Move the tool base along an axis without rotation. Depth is measured from the tool's position when the
    /// insertion along this axis began. A later `Insert` along the same axis changes depth and feed on the
    /// same line, and a `Hold` in between does not end the insertion. An arm in any other motion stops first.
    Insert {
        /// Axis, a unit vector in the patient frame.
        axis_world: Vector3<f64>,
        /// Goal depth, ±0.5 m.
        depth_m: f64,
        /// Speed, greater than 0, at most the arm's limit.
        feed_m_s: f64,
    },
    /// Move to a pose about a remote centre of motion: the tool axis (its +z) passes through the pivot
    /// throughout. At start and goal it must do so within 1 µm. An arm in motion stops first.
    Rcm {
        /// Goal pose of the tool's base in the patient frame.
        t_world_tool: Isometry3<f64>,
        /// The pivot in the patient frame.
        pivot_world_m: Vector3<f64>,
        /// Speed of the tool base's origin, at most the arm's limit; `None` for the limit.
        max_speed_m_s: Option<f64>,
    },
}

/// Error of building an arm or of a command. A rejected command leaves the motion unchanged.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum ArmError {
    /// The joints cannot be put into another state while they follow a path.
    #[error("the arm follows a path, which determines its joints")]
    OnPath,
    /// The base pose is invalid.
    #[error("t_world_arm_base: {0}")]
    BasePose(KinematicsError),
    /// A limit, length or tick duration is not a positive finite number.
    #[error("arm parameter {name} is {given}, expected a positive finite number")]
    InvalidParameter {
        /// Name of the parameter (its linear or angular part).
        name: &'static str,
        /// The value.
        given: f64,
    },
    /// A joint's range is empty or wider than four turns.
    #[error(
        "joint {joint} has the range {lower_rad} to {upper_rad} rad, expected lower < upper within ±4 pi"
    )]
    InvalidRange {
        /// Joint, from 1.
        joint: usize,
        /// Lower limit.
        lower_rad: f64,
        /// Upper limit.
        upper_rad: f64,
    },
    /// A joint angle is NaN or outside its limits.
    #[error("joint {joint} out of range: {given_rad} rad; allowed: {lower_rad} to {upper_rad} rad")]
    JointOutsideLimits {
        /// Joint, from 1.
        joint: usize,
        /// Given angle.
        given_rad: f64,
        /// Lower limit.
        lower_rad: f64,
        /// Upper limit.
        upper_rad: f64,
    },
    /// An angle or rate was given for a joint that the arm does not have.
    #[error("joint {joint} is {given}, but the arm has {joints} joints; send 0 for the unused ones")]
    NoSuchJoint {
        /// Joint, from 1.
        joint: usize,
        /// Number of joints of the arm.
        joints: usize,
        /// Given angle or rate.
        given: f64,
    },
    /// A speed or speed fraction is NaN, not positive or above the arm's.
    #[error("{name} is {given}, expected above 0 and at most {maximum}")]
    SpeedOutOfRange {
        /// Name of the field.
        name: &'static str,
        /// Given value.
        given: f64,
        /// Maximum accepted value.
        maximum: f64,
    },
    /// A joint rate is NaN or above its limit.
    #[error("joint {joint} too fast: {given_rad_s} rad/s; allowed: ±{maximum_rad_s}")]
    JointRateOutsideLimits {
        /// Joint, from 1.
        joint: usize,
        /// Given rate.
        given_rad_s: f64,
        /// Maximum rate.
        maximum_rad_s: f64,
    },
    /// A joint would leave its range before it can stop.
    #[error(
        "joint {joint} reaches its limit ({lower_rad} to {upper_rad} rad); send a rate away from it, or \
         another goal"
    )]
    JointRangeEnds {
        /// Joint, from 1.
        joint: usize,
        /// Lower limit.
        lower_rad: f64,
        /// Upper limit.
        upper_rad: f64,
    },
    /// The axis is not a unit vector or the depth is out of range.
    #[error(
        "insertion: axis length is {axis_length}, expected 1; depth is {depth_m} m; allowed: ±{maximum_m} m"
    )]
    InvalidInsertion {
        /// Length of the axis.
        axis_length: f64,
        /// Depth.
        depth_m: f64,
        /// Maximum depth.
        maximum_m: f64,
    },
    /// The tool axis misses the pivot.
    #[error(
        "at the {end}, the tool axis misses the pivot by {missed_m} m; allowed: {allowed_m} m; \
         align the tool with move_cp first, and send a goal whose +z axis passes through the pivot"
    )]
    PivotMissed {
        /// Start or goal.
        end: &'static str,
        /// Distance of the pivot from the axis.
        missed_m: f64,
        /// Maximum allowed distance.
        allowed_m: f64,
    },
    /// The goal pose has no inverse kinematics solution.
    #[error("tool base goal: {0}")]
    Goal(KinematicsError),
    /// A pose on the path has no inverse kinematics solution.
    #[error("at {fraction} of the path: {reason}")]
    PathUnreachable {
        /// Fraction of the path, 0 to 1.
        fraction: f64,
        /// The cause.
        reason: KinematicsError,
    },
    /// The path passes through a singularity.
    #[error(
        "singularity at {fraction:.4} of the path: manipulability {manipulability_m3:.1e} m³; allowed: at \
         least {LEAST_MANIPULABILITY_M3:e} m³; choose another path, use joint commands, or move the arm base"
    )]
    PathSingular {
        /// Fraction of the path, 0 to 1.
        fraction: f64,
        /// |det J| there.
        manipulability_m3: f64,
    },
    /// Near a singularity, the joints would jump, turn too fast, or flip to another configuration of the arm.
    #[error(
        "joint jump at {fraction:.4} of the path, as near a singularity: the joints would turn too fast, or \
         the elbow, wrist or shoulder would flip; choose another path, use joint commands, or move the arm \
         base"
    )]
    PathJumps {
        /// Fraction of the path, 0 to 1.
        fraction: f64,
    },
    /// The tool's force on the flange exceeded the arm's limit.
    #[error(
        "protective stop: the tool pushed the flange with {force_n:.1} N, `arm.max_force_n` is {limit_n:.1} \
         N; send `hold`, then another goal"
    )]
    ProtectiveStop {
        /// Force of the tool on the flange.
        force_n: f64,
        /// The limit.
        limit_n: f64,
    },
    /// The arm had a fault before the keyframe from which the simulation continues.
    #[error("the arm had stopped before the keyframe from which this continues")]
    BeforeKeyframe,
    /// The tool came close to a critical structure, or entered it.
    #[error("protective stop: the tool is too close to a critical structure; send `hold`, then another goal")]
    StructureNear,
    /// The arm would come closer to a critical structure than its fixture allows.
    #[error("the fixture of `structure[{structure}]` holds the arm back; send a goal that leads away")]
    Fixture {
        /// Index of the structure in the scene.
        structure: usize,
    },
    /// The scene has no arm to move.
    #[error(
        "the scene has no arm (`arm.model` is \"fixed\"); remove the arm command, or choose another \
         `arm.model`"
    )]
    NoArm,
    /// Joint angles were commanded to a gantry.
    #[error("a gantry has no revolute joints; use servo_cp, move_cp, insert or hold")]
    NoTurningJoints,
    /// An axis of a gantry would leave its travel before it can stop.
    #[error(
        "gantry axis {axis} reaches the end of its travel ({lower_m} to {upper_m} m from the start); send \
         another goal"
    )]
    TravelEnds {
        /// The axis.
        axis: char,
        /// Lower end of its travel.
        lower_m: f64,
        /// Upper end of its travel.
        upper_m: f64,
    },
    /// A motion was commanded during a protective stop.
    #[error("the arm is in a protective stop; send `hold` to release it, then a goal")]
    InProtectiveStop,
    /// The elastic joints' operator is not positive definite because the state is not finite.
    #[error(
        "the state of the elastic joints is not finite; use softer joints, a softer tool or a shorter time \
         step"
    )]
    ComplianceFailed,
    /// Ruckig found no jerk-limited trajectory.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}
