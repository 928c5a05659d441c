use super::{ARM_JOINTS, MAX_CONTROLLERS, MAX_TENDONS, Pose};
use crate::message;

/// [`Command::tendon_mode`]: this command does not drive the tendons.
pub const TENDON_NONE: u32 = 0;
/// CRTK `servo_jf`: tensions, held until the next command.
pub const TENDON_SERVO_JF: u32 = 1;
/// CRTK `servo_jp`: displacements, held until the next command.
pub const TENDON_SERVO_JP: u32 = 2;
/// CRTK `move_jp`: displacement goals, reached with limited speed, acceleration and jerk.
pub const TENDON_MOVE_JP: u32 = 3;

/// [`Command::arm_mode`]: this command does not drive the arm.
pub const ARM_NONE: u32 = 0;
/// CRTK `servo_jp`: joint angles to track within the limits.
pub const ARM_SERVO_JP: u32 = 1;
/// CRTK `move_jp`: joint goal, jerk-limited.
pub const ARM_MOVE_JP: u32 = 2;
/// CRTK `servo_cp`: tool base pose to track within the limits.
pub const ARM_SERVO_CP: u32 = 3;
/// CRTK `move_cp`: tool base goal, along a straight line, jerk-limited.
pub const ARM_MOVE_CP: u32 = 4;
/// Stop within the limits and stay.
pub const ARM_HOLD: u32 = 5;
/// CRTK `servo_jv`: joint rates, held until the next command; a joint stops at the end of its range.
pub const ARM_SERVO_JV: u32 = 6;
/// Insert along an axis at a feed, without turning.
pub const ARM_INSERT: u32 = 7;
/// Tool base goal about a remote centre of motion: the tool's axis goes through a pivot all the way.
pub const ARM_RCM: u32 = 8;

/// [`Command::burr_mode`]: this command does not drive the burr.
pub const BURR_NONE: u32 = 0;
/// Burr at `burr_speed_rad_per_s`.
pub const BURR_SPEED: u32 = 1;

/// Largest tension that may be asked for.
pub const MAX_TENSION_N: f64 = 60.0;
/// Largest tendon displacement that may be asked for, either way.
pub const MAX_DISPLACEMENT_M: f64 = 0.02;
/// Largest burr speed that may be asked for: 60 000 rpm.
pub const MAX_BURR_SPEED_RAD_PER_S: f64 = 6283.2;
/// Farthest tool base position that may be asked for, each coordinate.
pub const MAX_POSITION_M: f64 = 10.0;
/// Largest speed that may be asked for.
pub const MAX_SPEED_M_PER_S: f64 = 1.0;
/// Largest depth of an insertion, either way.
pub const MAX_DEPTH_M: f64 = 0.5;

message! {
    /// What one controller asks for. Verbs follow CRTK. A part whose mode is 0 keeps what it was told before; a
    /// controller may drive only the parts that the scene gives it.
    pub struct Command = "trabecula_msgs/msg/Command" {
        /// Counts the commands of this controller, from 1, rising by one.
        sequence: u64,
        /// `tick` of the state that this command answers.
        state_tick: u64,
        /// 0 none, 1 servo_jf, 2 servo_jp, 3 move_jp.
        tendon_mode: u32,
        /// 0 none, 1 servo_jp, 2 move_jp, 3 servo_cp, 4 move_cp, 5 hold, 6 servo_jv, 7 insert, 8 rcm.
        arm_mode: u32,
        /// 0 none, 1 speed.
        burr_mode: u32,
        /// Always 0.
        reserved: u32,
        /// Tensions for servo_jf, 0 or more.
        tendon_force_n: [f64; MAX_TENDONS],
        /// Displacements for servo_jp and move_jp; positive pulls.
        tendon_displacement_m: [f64; MAX_TENDONS],
        /// Joint angles for the arm's servo_jp and move_jp.
        arm_joint_position_rad: [f64; ARM_JOINTS],
        /// Joint rates for the arm's servo_jv.
        arm_joint_velocity_rad_per_s: [f64; ARM_JOINTS],
        /// Goal of the arm's servo_cp, move_cp and rcm: the tool base but for the mount's deflection.
        t_world_base: Pose,
        /// Speed limit of move_cp and rcm; 0 takes the scene's limit. Feed of insert, above 0.
        arm_speed_m_per_s: f64,
        /// Axis of insert, a unit vector of the patient frame.
        arm_axis: [f64; 3],
        /// Depth of insert from where the tool base stood when the insertion along this axis began.
        arm_depth_m: f64,
        /// Remote centre of motion of rcm, patient frame.
        arm_pivot_m: [f64; 3],
        /// Angular speed of the burr.
        burr_speed_rad_per_s: f64,
    }
}

message! {
    /// One controller's part of u_k.
    pub struct LatchedCommand = "trabecula_msgs/msg/LatchedCommand" {
        /// 0 none, 1 fresh, 2 held, 3 safe command.
        source: u32,
        /// Index of the controller in the scene.
        controller_index: u32,
        /// Ticks between the state that the command answers and the state it acts on.
        age_ticks: u64,
        /// The command itself; for the safe command, what it amounts to.
        command: Command,
    }
}

message! {
    /// u_k: everything that tick k takes from outside. Published before the state that it leads to; the only
    /// non-deterministic input of a run.
    pub struct Latched = "trabecula_msgs/msg/Latched" {
        /// k: the tick that takes `State.tick` from k to k+1.
        tick: u64,
        /// Number of entries of `commands` in use, in the scene's order of controllers.
        controller_count: u32,
        /// 1 if the simulation is set back to its initial state before this tick.
        reset: u32,
        /// The commands that hold.
        commands: [LatchedCommand; MAX_CONTROLLERS],
    }
}
