use super::{
    MAX_ARM_JOINTS, MAX_BODIES, MAX_CONTACTS, MAX_CONTROLLERS, MAX_JOINTS, MAX_TENDONS, Pose, Wrench,
};
use crate::message;

message! {
    /// One contact of a proxy sphere of the tool.
    pub struct Contact = "trabecula_msgs/msg/Contact" {
        /// Index of the proxy sphere; the shaft's come first, the burr is last.
        sphere_index: u32,
        /// Part of the tool: 0 shaft, 1 segment, 2 burr.
        part: u32,
        /// Contact point on the obstacle's surface, world frame.
        point_m: [f64; 3],
        /// Unit normal from the obstacle to the sphere, world frame.
        normal: [f64; 3],
        /// Signed distance between sphere and surface; negative means overlap.
        gap_m: f64,
        /// Normal force on the tool, never negative.
        normal_force_n: f64,
        /// Friction force on the tool, world frame.
        friction_force_n: [f64; 3],
    }
}

message! {
    /// The command of a controller that was applied in the tick that led to this state.
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

message! {
    /// The full simulated state after a tick. Published once per tick; `tick` 0 is the initial state.
    pub struct State = "trabecula_msgs/msg/State" {
        /// Number of ticks since the start of the run; a reset does not change it.
        tick: u64,
        /// Simulated time.
        sim_time_s: f64,
        /// Chained hash h_k of every latched command, state and removal so far (XXH3-128, low word first).
        hash: [u64; 2],
        /// Voxels drilled or crushed since the start or the last reset.
        removed_total: u64,
        /// Voxels removed in this tick.
        removed_in_tick: u32,
        /// Number of flexures; the arrays below use as many entries.
        joint_count: u32,
        /// Number of tendons.
        tendon_count: u32,
        /// Number of used entries of `contacts`.
        contact_count: u32,
        /// Number of contacts and near contacts in this tick; `contacts` lists those that carry force.
        contact_total: u32,
        /// Number of used entries of `applied`.
        controller_count: u32,
        /// Number of used entries of `t_world_body`.
        body_count: u32,
        /// Iterations of the contact solver in this tick.
        contact_iterations: u32,
        /// The arm's current mode, coded as the command's `arm_mode`; 5 while it stops or is at rest.
        arm_mode: u32,
        /// 0 moving, 1 at its goal and at rest, 2 motion aborted or a joint stopped at the end of its range.
        arm_status: u32,
        /// Number of the arm's revolute joints, 6 or 7; 0 for a gantry or without an arm. Further entries of
        /// the joint arrays are 0.
        arm_joint_count: u32,
        /// 0 none, 1 stopped, 2 released: the arm stopped because the tool pressed too hard and takes no
        /// command but hold, and has been released while the force is not below the limit yet.
        arm_protective_stop: u32,
        /// Flexure angles from base to tip, positive toward tendon 0.
        joint_position_rad: [f64; MAX_JOINTS],
        /// Flexure angle rates.
        joint_velocity_rad_per_s: [f64; MAX_JOINTS],
        /// Sum of the flexure angles: the bend of the tip relative to the base.
        bend_rad: f64,
        /// Angular speed of the burr.
        burr_speed_rad_per_s: f64,
        /// Torque of cutting on the burr's motor; 0 unless the scene models the motor, a flexible drive
        /// shaft or the side force of cutting.
        burr_torque_nm: f64,
        /// Angle by which the motor leads the burr: the wind-up of a flexible drive shaft; 0 without one.
        drive_shaft_wind_up_rad: f64,
        /// Normal force between burr and bone.
        burr_force_n: f64,
        /// Sum of the normal forces on the tool, without the burr's.
        wall_force_n: f64,
        /// Largest ratio of a contact's force to the strength of the bone there; 1 where bone yields, 0 while
        /// no contact force exceeds the strength of the weakest bone.
        strength_share: f64,
        /// Largest excess of a flexure beyond its stop; 0 if none is past its stop.
        stop_excess_rad: f64,
        /// Largest residual of a contact (m/s) or a stop (rad/s) after the solver's iterations: the speed by
        /// which it violates its law.
        contact_residual_m_per_s: f64,
        /// Energy spent on cutting since the start.
        cutting_energy_j: f64,
        /// Energy that bone absorbed where it was crushed, since the start.
        crushing_energy_j: f64,
        /// Energy of the tool: kinetic, relative to its base, and elastic, in flexures, mount, tendons,
        /// contacts and stops.
        tool_energy_j: f64,
        /// Work of the tendons' actuators on the tool since the start.
        tendon_work_j: f64,
        /// Work of the arm on the tool since the start, by moving its base or sliding its outer tube.
        arm_work_j: f64,
        /// Work of gravity on the tool since the start.
        gravity_work_j: f64,
        /// Work of the burr's motor since the start: the energy spent on cutting, and the work of the side
        /// force of cutting on the tool.
        motor_work_j: f64,
        /// Work of rigid bodies on the tool since the start.
        body_work_j: f64,
        /// Energy lost to the friction of contacts with bone, and of tendons in their channels, since the
        /// start.
        friction_energy_j: f64,
        /// Energy lost to the damping of flexures and mount since the start.
        damping_energy_j: f64,
        /// Remainder of the ledger since the start: energy lost to the integrator, impacts, and the feed
        /// against cut bone.
        numerical_energy_j: f64,
        /// Energy that ticks created beyond the error of the integrator, since the start; 0 if every tick's
        /// ledger closes.
        energy_created_j: f64,
        /// Tension at the proximal end of each tendon.
        tendon_tension_n: [f64; MAX_TENDONS],
        /// Displacement of each tendon from its straight, unloaded length; positive when pulled.
        tendon_displacement_m: [f64; MAX_TENDONS],
        /// How far the tube has slid out of the outer tube; 0 for a tool without one.
        tube_deployed_m: f64,
        /// Rate of change of `tube_deployed_m`.
        tube_deploying_m_per_s: f64,
        /// Angle of the tube about its own axis in the outer tube, from +x toward +y of the tool base.
        tube_roll_rad: f64,
        /// Rate of change of `tube_roll_rad`.
        tube_rolling_rad_per_s: f64,
        /// Pose of the tool base (start of the rigid shaft, or of the outer tube), including the mount's
        /// deflection; +z along the straight tool, +x toward tendon 0.
        t_world_base: Pose,
        /// Pose of the tip, the front of the burr: its centre plus its radius along the last link's +z.
        t_world_tip: Pose,
        /// Pose of the burr: its centre, axes of the last link.
        t_world_burr: Pose,
        /// Pose of each link just after its flexure, base to tip.
        t_world_link: [Pose; MAX_JOINTS],
        /// Arm joint angles, base to wrist.
        arm_joint_position_rad: [f64; MAX_ARM_JOINTS],
        /// Arm joint velocities.
        arm_joint_velocity_rad_per_s: [f64; MAX_ARM_JOINTS],
        /// Elastic deflection of the arm's joints, included in `arm_joint_position_rad`; 0 without joint
        /// compliance.
        arm_joint_deflection_rad: [f64; MAX_ARM_JOINTS],
        /// Distance from singularity: Yoshikawa's manipulability in m³, |det J| of six joints and the root of
        /// det(J Jᵀ) of seven; for the UR5 mostly 0.05 to 0.1.
        arm_manipulability_m3: f64,
        /// Pose of the arm's flange.
        t_world_flange: Pose,
        /// Wrench that the tool exerts on the flange, about the tool base, world axes.
        flange_wrench: Wrench,
        /// Pose of each rigid body, in the scene's order.
        t_world_body: [Pose; MAX_BODIES],
        /// Wrench of the tool on each rigid body about its centre of mass, mean over the tick.
        wrench_on_body: [Wrench; MAX_BODIES],
        /// Contacts that carry force, in the order of their spheres.
        contacts: [Contact; MAX_CONTACTS],
        /// The command of each controller that this tick applied.
        applied: [AppliedCommand; MAX_CONTROLLERS],
    }
}
