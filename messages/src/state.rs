use super::{ARM_JOINTS, MAX_BODIES, MAX_CONTACTS, MAX_CONTROLLERS, MAX_JOINTS, MAX_TENDONS, Pose, Wrench};
use crate::message;

/// [`Contact::part`]: a sphere of the rigid shaft.
pub const PART_SHAFT: u32 = 0;
/// [`Contact::part`]: a segment sphere.
pub const PART_SEGMENT: u32 = 1;
/// [`Contact::part`]: the burr.
pub const PART_BURR: u32 = 2;

message! {
    /// One contact of a proxy sphere of the tool.
    pub struct Contact = "trabecula_msgs/msg/Contact" {
        /// Index of the proxy sphere, shaft first, burr last.
        sphere_index: u32,
        /// Part of the tool: 0 shaft, 1 segment, 2 burr.
        part: u32,
        /// Point on the obstacle's surface, world.
        point_m: [f64; 3],
        /// Unit normal from the obstacle to the sphere, world.
        normal: [f64; 3],
        /// Signed distance of the sphere from the surface; negative is overlap.
        gap_m: f64,
        /// Normal force on the tool, never negative.
        normal_force_n: f64,
        /// Friction force on the tool, world.
        friction_force_n: [f64; 3],
    }
}

/// [`AppliedCommand::source`] and [`LatchedCommand::source`](super::LatchedCommand::source): nothing arrived yet; nothing is driven.
pub const SOURCE_NONE: u32 = 0;
/// A command that arrived for this tick.
pub const SOURCE_FRESH: u32 = 1;
/// The newest earlier command, held.
pub const SOURCE_HELD: u32 = 2;
/// The scene's safe command: burr off, tension held, arm held.
pub const SOURCE_SAFE: u32 = 3;

message! {
    /// Which command of a controller the tick that led to this state applied.
    pub struct AppliedCommand = "trabecula_msgs/msg/AppliedCommand" {
        /// Sequence number of the command; 0 if none.
        sequence: u64,
        /// Ticks between the state that the command answers and the state it acted on.
        age_ticks: u64,
        /// 0 none, 1 fresh, 2 held, 3 safe command.
        source: u32,
        /// Index of the controller in the scene.
        controller_index: u32,
    }
}

/// [`State::arm_status`]: on its way.
pub const ARM_MOVING: u32 = 0;
/// At its goal and at rest.
pub const ARM_DONE: u32 = 1;
/// It gave its motion up and stopped, or stopped a joint at the end of its range; an event said why.
pub const ARM_FAULT: u32 = 2;

message! {
    /// The whole simulated state after a tick. Published once a tick; `tick` 0 is the initial state.
    pub struct State = "trabecula_msgs/msg/State" {
        /// Number of ticks made since the run began; a reset does not set it back.
        tick: u64,
        /// Simulated time.
        sim_time_s: f64,
        /// Chained hash h_k of every latched command, state and removal so far (XXH3-128, low word first).
        hash: [u64; 2],
        /// Voxels drilled since the start or the last reset.
        removed_total: u64,
        /// Voxels removed in this tick.
        removed_in_tick: u32,
        /// Number of flexures that are in use in the arrays below.
        joint_count: u32,
        /// Number of tendons in use.
        tendon_count: u32,
        /// Number of entries of `contacts` in use.
        contact_count: u32,
        /// Number of contacts and near contacts in this tick; `contacts` lists those that carry force.
        contact_total: u32,
        /// Number of entries of `applied` in use.
        controller_count: u32,
        /// Number of entries of `t_world_body` in use.
        body_count: u32,
        /// Zero.
        reserved_bodies: u32,
        /// What the arm follows: the values of the command's `arm_mode`, 5 while it stops or stands.
        arm_mode: u32,
        /// 0 moving, 1 at its goal and at rest, 2 gave its motion up or stopped a joint at the end of its range.
        arm_status: u32,
        /// Flexure angles from base to tip, positive toward tendon 0.
        joint_position_rad: [f64; MAX_JOINTS],
        /// Flexure rates.
        joint_velocity_rad_per_s: [f64; MAX_JOINTS],
        /// Sum of the flexure angles: the bend of the tip against the base.
        bend_rad: f64,
        /// Angular speed of the burr.
        burr_speed_rad_per_s: f64,
        /// Normal force with which the burr presses on bone.
        burr_force_n: f64,
        /// Energy that the burr has put into cutting since the start.
        cutting_energy_j: f64,
        /// Tension at the proximal end of each tendon.
        tendon_tension_n: [f64; MAX_TENDONS],
        /// Pull of each tendon from its straight, unloaded length; positive is pulled.
        tendon_displacement_m: [f64; MAX_TENDONS],
        /// Tool base (start of the rigid shaft), the mount's deflection included; +z along the straight tool, +x toward
        /// tendon 0.
        t_world_base: Pose,
        /// Front of the burr: its centre plus its radius along the last link's +z.
        t_world_tip: Pose,
        /// Burr centre, axes of the last link.
        t_world_burr: Pose,
        /// Pose of each link behind its flexure, base to tip.
        t_world_link: [Pose; MAX_JOINTS],
        /// Arm joint angles, base to wrist.
        arm_joint_position_rad: [f64; ARM_JOINTS],
        /// Arm joint rates.
        arm_joint_velocity_rad_per_s: [f64; ARM_JOINTS],
        /// Elastic deflection of the arm's joints, part of `arm_joint_position_rad`; 0 without joint compliance.
        arm_joint_deflection_rad: [f64; ARM_JOINTS],
        /// Distance from singularity: Yoshikawa's manipulability |det J| in m³; the UR5's is mostly 0.05 to 0.1.
        arm_manipulability_m3: f64,
        /// Pose of the arm's flange.
        t_world_flange: Pose,
        /// Wrench of the tool on the flange, about the tool base, world axes.
        flange_wrench: Wrench,
        /// Pose of each rigid body of the scene, in its order.
        t_world_body: [Pose; MAX_BODIES],
        /// Contacts that carry force, in the order of the spheres.
        contacts: [Contact; MAX_CONTACTS],
        /// The command of each controller that this tick applied.
        applied: [AppliedCommand; MAX_CONTROLLERS],
    }
}
