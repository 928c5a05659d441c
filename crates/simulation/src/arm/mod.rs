//! The robot arm that carries the tool: kinematics and jerk-limited motion, one tick at a time.
//!
//! An [`Arm`] takes [`ArmCommand`]s and steps. After each tick its [`ArmState`] holds the joints and the tool
//! base's pose, velocity and acceleration in the patient frame; the velocity is the exact derivative of the
//! pose (J q̇). The tool's base is the flange frame times [`ArmGeometry::t_flange_tool`]; every commanded
//! pose refers to it. The arm follows its trajectory exactly; drive dynamics are not modelled. [`Compliance`]
//! adds joint deflection.
//!
//! The numeric core is pure: the state after n ticks is a function of the parameters and of the commands with
//! their ticks. A motion is stored as its start, goal and age, never as an accumulated state, so errors do
//! not grow over time and a restored snapshot continues bit for bit.

mod compliance;
mod following;
mod gantry;
mod geometry;
mod inverse;
mod kinematics;
mod models;
mod motion;
mod parameters;
mod path;
mod planning;
mod serial;
mod state;
mod trajectory;
mod velocity;

pub use compliance::{Compliance, ComplianceParameters, ComplianceState, DeflectedBase, mass_matrix};
pub use gantry::GantryGeometry;
pub use geometry::ArmGeometry;
pub use inverse::{InverseSolutions, KinematicsError};
pub use kinematics::{Jacobian, Joints, LinkFrames, SingularityFactors, UrGeometry, six_joints};
pub use models::{Link, initial_q_rad};
pub use parameters::{
    ArmCommand, ArmError, ArmParameters, COMFORTABLE_Q_RAD, CartesianLimits, JointLimits, place_base_for,
};
pub(crate) use path::LEAST_MANIPULABILITY_M3;
pub use serial::{Redundancy, SerialGeometry, SerialJoint};
pub use state::{ArmMode, ArmState, ProtectiveStop, RELEASED_SHARE};
pub use trajectory::{AxisLimits, AxisState, Goal, Planner, Segment, TrajectoryError};

use messages::MAX_ARM_JOINTS;
use motion::Motion;
use nalgebra::{Isometry3, Vector3};
use path::PathSpeed;
use planning::{Aim, Insertion, PathGoal, check_speed};
use serde::{Deserialize, Serialize};

/// The complete state of an arm as plain data: see [`Arm::snapshot`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmSnapshot {
    motion: Motion,
    insertion: Option<Insertion>,
    state: ArmState,
    last_command: ArmCommand,
}

/// An arm that moves within velocity, acceleration and jerk limits.
///
/// Not `Send`: Ruckig's objects stay on the thread that created them. Send an [`ArmSnapshot`] instead.
pub struct Arm {
    parameters: ArmParameters,
    joint_planner: Planner<MAX_ARM_JOINTS>,
    path_planner: Planner<1>,
    motion: Motion,
    insertion: Option<Insertion>,
    state: ArmState,
    last_command: ArmCommand,
}

impl Arm {
    /// Creates an arm at rest at `initial_q_rad`.
    pub fn new(parameters: ArmParameters, initial_q_rad: &Joints) -> Result<Self, ArmError> {
        parameters.check()?;
        parameters.check_joints(initial_q_rad)?;
        let mut arm = Self {
            parameters,
            joint_planner: Planner::new(),
            path_planner: Planner::new(),
            motion: Motion::Rest,
            insertion: None,
            state: ArmState {
                q_rad: *initial_q_rad,
                qd_rad_s: Joints::default(),
                qdd_rad_s2: Joints::default(),
                t_world_tool: Isometry3::identity(),
                linear_velocity_m_s: Vector3::zeros(),
                angular_velocity_rad_s: Vector3::zeros(),
                linear_acceleration_m_s2: Vector3::zeros(),
                angular_acceleration_rad_s2: Vector3::zeros(),
                mode: ArmMode::Hold,
                done: true,
                fault: None,
                protective_stop: ProtectiveStop::Armed,
            },
            last_command: ArmCommand::Hold,
        };
        arm.publish(&arm.parameters.geometry.frames(initial_q_rad), &AxisState::at_rest(*initial_q_rad));
        Ok(arm)
    }

    /// Returns the arm's parameters.
    pub fn parameters(&self) -> &ArmParameters {
        &self.parameters
    }

    /// Returns the state after the last tick.
    pub fn state(&self) -> &ArmState {
        &self.state
    }

    /// Returns the pose of the flange in the patient frame.
    pub fn t_world_flange(&self) -> Isometry3<f64> {
        match self.parameters.geometry.t_flange_tool() {
            Some(tool) => self.state.t_world_tool * tool.inverse(),
            None => self.state.t_world_tool,
        }
    }

    /// Returns the geometric Jacobian at the current joint angles, world axes: first the rows of the tool
    /// base origin's linear velocity, then those of the angular velocity.
    pub fn jacobian(&self) -> Jacobian {
        let geometry = &self.parameters.geometry;
        let mut jacobian = geometry.jacobian(&geometry.frames(&self.state.q_rad));
        let turn = self.parameters.t_world_arm_base.rotation;
        for column in 0..MAX_ARM_JOINTS {
            for row in [0, 3] {
                let turned = turn * jacobian.fixed_view::<3, 1>(row, column).into_owned();
                jacobian.fixed_view_mut::<3, 1>(row, column).copy_from(&turned);
            }
        }
        jacobian
    }

    /// Commands the arm, effective from the next tick. During a protective stop, only `Hold` is accepted,
    /// which releases it. A rejected command leaves the motion unchanged; a repeat of the last accepted
    /// command has no effect.
    pub fn command(&mut self, command: ArmCommand) -> Result<(), ArmError> {
        if command != ArmCommand::Hold && !self.parameters.geometry.moves() {
            return Err(ArmError::NoArm);
        }
        let is_of_joints = matches!(
            command,
            ArmCommand::ServoJp { .. } | ArmCommand::ServoJv { .. } | ArmCommand::MoveJp { .. }
        );
        if is_of_joints && !self.parameters.geometry.turns() {
            return Err(ArmError::NoTurningJoints);
        }
        if let ProtectiveStop::Stopped { force_n } = self.state.protective_stop {
            if command != ArmCommand::Hold {
                return Err(ArmError::InProtectiveStop);
            }
            self.state.protective_stop = ProtectiveStop::Released { force_n };
            self.state.fault = None;
        }
        if command == self.last_command {
            return Ok(());
        }
        let mode = match command {
            ArmCommand::Hold => {
                self.stop_then(None)?;
                ArmMode::Hold
            }
            ArmCommand::ServoJp { q_rad, speed_fraction } => {
                self.go_to_joints(Goal::Independent(q_rad), &q_rad, speed_fraction)?;
                ArmMode::ServoJp
            }
            ArmCommand::ServoJv { qd_rad_s } => {
                self.turn_joints(&qd_rad_s)?;
                ArmMode::ServoJv
            }
            ArmCommand::MoveJp { q_rad, speed_fraction } => {
                // Synchronise the joints only from rest: a synchronised profile from motion could overshoot a
                // joint's range.
                let from_rest = matches!(self.motion, Motion::Rest);
                let goal = if from_rest { Goal::StraightLine(q_rad) } else { Goal::Independent(q_rad) };
                self.go_to_joints(goal, &q_rad, speed_fraction)?;
                ArmMode::MoveJp
            }
            ArmCommand::ServoCp { t_world_tool, speed_fraction } => {
                let q_rad = self.joints_for(&t_world_tool)?;
                self.go_to_joints(Goal::Independent(q_rad), &q_rad, speed_fraction)?;
                ArmMode::ServoCp
            }
            ArmCommand::MoveCp { t_world_tool, max_speed_m_s, max_angular_speed_rad_s } => {
                let limits = &self.parameters.cartesian_limits;
                let speed = PathSpeed {
                    linear_m_s: check_speed("max_speed_m_s", max_speed_m_s, limits.speed_m_s)?,
                    angular_rad_s: check_speed(
                        "max_angular_speed_rad_s",
                        max_angular_speed_rad_s,
                        limits.angular_speed_rad_s,
                    )?,
                };
                self.go_straight(&self.t_base_tool(&t_world_tool)?, speed)?;
                ArmMode::MoveCp
            }
            ArmCommand::Insert { axis_world, depth_m, feed_m_s } => {
                self.insert(&axis_world, depth_m, feed_m_s)?;
                ArmMode::Insert
            }
            ArmCommand::Rcm { t_world_tool, pivot_world_m, max_speed_m_s } => {
                let limits = &self.parameters.cartesian_limits;
                let speed = PathSpeed {
                    linear_m_s: check_speed("max_speed_m_s", max_speed_m_s, limits.speed_m_s)?,
                    angular_rad_s: limits.angular_speed_rad_s,
                };
                let pivot = self
                    .parameters
                    .t_world_arm_base
                    .inverse_transform_point(&nalgebra::Point3::from(pivot_world_m));
                let t_base_tool = self.t_base_tool(&t_world_tool)?;
                let aim = Aim::About { t_base_tool, pivot_m: pivot.coords };
                self.stop_then(Some(PathGoal { aim, speed }))?;
                ArmMode::Rcm
            }
        };
        if !matches!(mode, ArmMode::Insert | ArmMode::Hold) {
            self.insertion = None;
        }
        self.last_command = command;
        self.state.mode = mode;
        self.state.done = matches!(self.motion, Motion::Rest);
        self.state.fault = None;
        Ok(())
    }

    /// Triggers a protective stop if the tool's force on the flange, `force_n`, exceeds `limit_n`: the arm
    /// brakes within its limits and then accepts only [`ArmCommand::Hold`], which releases it. See
    /// [`ProtectiveStop`].
    pub fn watch_force(&mut self, force_n: f64, limit_n: f64) {
        let most_n = match self.state.protective_stop {
            ProtectiveStop::Armed => limit_n,
            ProtectiveStop::Stopped { force_n: most_n } => {
                self.state.protective_stop = ProtectiveStop::Stopped { force_n: force_n.max(most_n) };
                return;
            }
            ProtectiveStop::Released { .. } if force_n <= limit_n => {
                self.state.protective_stop = ProtectiveStop::Armed;
                return;
            }
            ProtectiveStop::Released { force_n } => RELEASED_SHARE * force_n,
        };
        if force_n > most_n {
            self.state.protective_stop = ProtectiveStop::Stopped { force_n };
            self.give_up(ArmError::ProtectiveStop { force_n, limit_n });
        }
    }

    /// Triggers a protective stop because of a critical structure: from the next step on the arm brakes, and
    /// stands until it is commanded to hold.
    pub fn stop_protectively(&mut self) {
        if !self.state.protective_stop.is_stopped() {
            self.state.protective_stop = ProtectiveStop::Stopped { force_n: 0.0 };
        }
    }

    /// Advances by one tick.
    pub fn step(&mut self) -> &ArmState {
        if self.state.protective_stop.is_stopped() && self.state.mode != ArmMode::Hold {
            self.give_up(ArmError::StructureNear);
            return &self.state;
        }
        match self.motion {
            Motion::Rest => {}
            Motion::Joint(motion) => self.step_joints(motion),
            Motion::Path(motion) => self.step_path(motion),
        }
        &self.state
    }

    /// Returns the complete state, including the motion in progress.
    pub fn snapshot(&self) -> ArmSnapshot {
        ArmSnapshot {
            motion: self.motion,
            insertion: self.insertion,
            state: self.state,
            last_command: self.last_command,
        }
    }

    /// Continues from `snapshot`, bit for bit, on an arm with the same parameters.
    pub fn restore(&mut self, snapshot: &ArmSnapshot) -> Result<(), ArmError> {
        match &snapshot.motion {
            Motion::Rest => {}
            Motion::Joint(motion) => {
                self.joint_planner.plan(&motion.segment)?;
                self.joint_planner.commit();
            }
            Motion::Path(motion) => {
                self.path_planner.plan(&motion.segment)?;
                self.path_planner.commit();
            }
        }
        self.motion = snapshot.motion;
        self.insertion = snapshot.insertion;
        self.state = snapshot.state;
        self.last_command = snapshot.last_command;
        Ok(())
    }

    /// Keeps the arm in fault after a keyframe, which does not hold the reason.
    pub fn keep_fault(&mut self) {
        self.state.fault.get_or_insert(ArmError::BeforeKeyframe);
    }
}

#[cfg(test)]
mod tests {
    use super::path::Path;
    use super::*;

    /// Returns an arm on a line that bypasses the check that would reject it.
    fn on_its_way(q_rad: &Joints, goal: impl Fn(&ArmState) -> Isometry3<f64>) -> Arm {
        let mut arm = Arm::new(ArmParameters::ur5(1e-3), q_rad).unwrap();
        let path = Path::straight(&arm.state.t_world_tool, &goal(&arm.state));
        let limits = AxisLimits { velocity: [0.05], acceleration: [0.2], jerk: [2.0] };
        let motion = arm.plan_path(path, AxisState::at_rest([0.0]), 1.0, limits).unwrap();
        arm.path_planner.commit();
        arm.motion = Motion::Path(motion);
        arm.state.done = false;
        arm
    }

    /// A wrist that flips on the way would turn by radians in one tick: the arm stops before that.
    #[test]
    fn a_line_on_which_the_joints_jump_ends_in_that_fault() {
        let posture = |wrist_rad| [0.0, -1.2, 1.8, -2.2, wrist_rad, 0.0, 0.0];
        let geometry = ArmParameters::ur5(1e-3).geometry;
        let mut arm = on_its_way(&posture(0.3), |_| geometry.forward(&posture(-0.25)));
        let mut fault = None;
        for _ in 0..40_000 {
            fault = fault.or(arm.step().fault);
        }
        // The wrist would be straight at 0.3 / 0.55 = 0.545 of the line.
        let Some(ArmError::PathJumps { fraction }) = fault else { panic!("{fault:?}") };
        assert!((0.4..0.55).contains(&fraction), "{fraction}");
        assert!(arm.state.done && arm.state.q_rad[4] > 0.0 && arm.state.mode == ArmMode::Hold);
    }

    /// A line that leaves the workspace and bypasses the check that would reject it: the arm brakes within
    /// its acceleration limit, stops, and reports why.
    #[test]
    fn a_line_that_breaks_on_the_way_ends_in_a_stop_and_a_fault() {
        let parameters = ArmParameters::ur5(1e-3);
        let beyond = |state: &ArmState| state.t_world_tool * Isometry3::translation(0.0, 0.0, 3.0);
        let mut arm = on_its_way(&COMFORTABLE_Q_RAD, beyond);
        let mut ticks_of_fault = 0;
        for _ in 0..40_000 {
            let before = arm.state;
            let state = *arm.step();
            ticks_of_fault += usize::from(state.fault.is_some());
            for i in 0..MAX_ARM_JOINTS {
                let step_rad = (state.q_rad[i] - before.q_rad[i]).abs();
                assert!(
                    step_rad <= 1.5e-3 * parameters.joint_limits.velocity_rad_s[i],
                    "no jump: {step_rad}"
                );
            }
        }
        println!("fault: {:?}, {ticks_of_fault} ticks ago", arm.state.fault);
        assert!(arm.state.done && arm.state.qd_rad_s == Joints::default() && arm.state.mode == ArmMode::Hold);
        let fault = arm.state.fault;
        assert!(
            matches!(
                fault,
                Some(
                    ArmError::PathUnreachable { .. }
                        | ArmError::PathSingular { .. }
                        | ArmError::PathJumps { .. }
                )
            ),
            "{fault:?}"
        );
        arm.command(ArmCommand::MoveJp { q_rad: COMFORTABLE_Q_RAD, speed_fraction: 1.0 }).unwrap();
        assert_eq!(arm.state.fault, None);
    }
}
