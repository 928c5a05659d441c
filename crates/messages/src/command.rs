use super::{MAX_ARM_JOINTS, MAX_CONTROLLERS, MAX_TENDONS, Pose, Wrench};
use crate::message;

/// Largest tension that a command may request.
pub const MAX_TENSION_N: f64 = 60.0;
/// Largest tendon displacement that a command may request, in either direction.
pub const MAX_DISPLACEMENT_M: f64 = 0.02;
/// Largest rate of a tendon's displacement, in either direction: that of a lead screw of moderate speed.
pub const MAX_DISPLACEMENT_RATE_M_PER_S: f64 = 0.005;
/// Largest force on a body that a command may request, along each axis.
pub const MAX_BODY_FORCE_N: f64 = 10_000.0;
/// Largest torque on a body that a command may request, about each axis.
pub const MAX_BODY_TORQUE_NM: f64 = 1_000.0;
/// Largest burr speed that a command may request: 60 000 rpm.
pub const MAX_BURR_SPEED_RAD_PER_S: f64 = 6283.2;
const _: () = assert!(MAX_BURR_SPEED_RAD_PER_S >= 60_000.0 / 60.0 * core::f64::consts::TAU);
/// Largest absolute value of each coordinate of a requested tool base position.
pub const MAX_POSITION_M: f64 = 10.0;
/// Largest speed that a command may request.
pub const MAX_SPEED_M_PER_S: f64 = 1.0;
/// Largest depth of an insertion, in either direction.
pub const MAX_DEPTH_M: f64 = 0.5;
/// Largest length of tube that a command may deploy from the outer tube.
pub const MAX_DEPLOYED_M: f64 = 0.5;
/// Largest roll of the tube that a command may request, in either direction: one turn.
pub const MAX_ROLL_RAD: f64 = core::f64::consts::TAU;

message! {
    /// A controller's command. Mode names follow CRTK. Mode 0 leaves tendons, arm, burr, tube or body at
    /// their previous command; a controller may drive only what the scene's `drives` allows.
    pub struct Command = "trabecula_msgs/msg/Command" {
        /// Sequence number of this controller's commands: 1, 2, 3 and so on.
        sequence: u64,
        /// `tick` of the state that this command answers.
        state_tick: u64,
        /// 0 none, 1 servo_jf, 2 servo_jp, 3 move_jp, 4 servo_jv.
        tendon_mode: u32,
        /// 0 none, 1 servo_jp, 2 move_jp, 3 servo_cp, 4 move_cp, 5 hold, 6 servo_jv, 7 insert, 8 rcm.
        arm_mode: u32,
        /// 0 none, 1 speed.
        burr_mode: u32,
        /// 0 none, 1 move_jp, 2 hold.
        tube_mode: u32,
        /// 0 none, 1 servo_cf, 2 servo_cp.
        body_mode: u32,
        /// 0.
        reserved: u32,
        /// Tensions for servo_jf, 0 or more.
        tendon_force_n: [f64; MAX_TENDONS],
        /// Displacements for servo_jp and move_jp; positive pulls.
        tendon_displacement_m: [f64; MAX_TENDONS],
        /// Rates of the displacements for servo_jv; positive pulls.
        tendon_velocity_m_per_s: [f64; MAX_TENDONS],
        /// Joint angles for the arm's servo_jp and move_jp.
        arm_joint_position_rad: [f64; MAX_ARM_JOINTS],
        /// Joint velocities for the arm's servo_jv.
        arm_joint_velocity_rad_per_s: [f64; MAX_ARM_JOINTS],
        /// Goal of the arm's servo_cp, move_cp and rcm: pose of the tool base, not counting the mount's
        /// deflection.
        t_world_base: Pose,
        /// Speed limit of move_cp and rcm; 0 selects the scene's limit. Feed rate of insert, above 0.
        arm_speed_m_per_s: f64,
        /// Axis of insert: unit vector in the patient frame.
        arm_axis: [f64; 3],
        /// Depth of insert, from the tool base position at which the insertion along this axis began.
        arm_depth_m: f64,
        /// Remote centre of motion of rcm, patient frame.
        arm_pivot_m: [f64; 3],
        /// Angular speed of the burr.
        burr_speed_rad_per_s: f64,
        /// Goal of the tube's move_jp: how far it slides out of the outer tube.
        tube_deployed_m: f64,
        /// Goal of the tube's move_jp: its angle about its own axis.
        tube_roll_rad: f64,
        /// Speed limit of the tube's sliding; 0 selects the tool's limit.
        tube_speed_m_per_s: f64,
        /// Wrench of servo_cf on the body, about its centre of mass.
        body_wrench: Wrench,
        /// Goal of servo_cp of the body: its pose at the end of the tick.
        t_world_body_goal: Pose,
    }
}

/// Whether a tick begins from the initial state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reset {
    /// The simulation is first reset to its initial state.
    Yes,
    /// The simulation continues from the last state.
    No,
}

impl Reset {
    /// Returns its value of [`Latched::reset`].
    pub const fn code(self) -> u32 {
        match self {
            Reset::No => 0,
            Reset::Yes => 1,
        }
    }
}

impl Latched {
    /// Returns whether this tick begins from the initial state.
    pub fn reset(&self) -> Reset {
        if self.reset != 0 { Reset::Yes } else { Reset::No }
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
        /// The command itself; with source 3, the safe command written out.
        command: Command,
    }
}

message! {
    /// u_k: all external input of tick k, and the only non-deterministic input of a run. Published before the
    /// state that it leads to.
    pub struct Latched = "trabecula_msgs/msg/Latched" {
        /// k: the tick that advances `State.tick` from k to k+1.
        tick: u64,
        /// Number of used entries of `commands`, in the scene's order of controllers.
        controller_count: u32,
        /// 1 if the simulation is reset to its initial state before this tick.
        reset: u32,
        /// The commands in effect.
        commands: [LatchedCommand; MAX_CONTROLLERS],
    }
}
