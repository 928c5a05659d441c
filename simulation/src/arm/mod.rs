//! The arm that carries the tool: UR5 kinematics and jerk-limited motion, one tick at a time.
//!
//! An [`Arm`] is given [`ArmCommand`]s and stepped. After each tick its [`ArmState`] has the joints and the tool base's
//! pose, velocity and acceleration in the patient frame; the velocity is the exact derivative of the pose's path (J q̇).
//! The tool's base is the flange's frame moved by [`UrGeometry::t_flange_tool`]; every pose of a command is one of it.
//! The arm follows its trajectory exactly: no drive dynamics. [`Compliance`] adds the deflection of its joints.
//!
//! The numeric core is pure: the state after n ticks is a function of the parameters, the commands and the ticks they
//! came at. A motion is stored as its start, goal and age, never as an accumulated state, so errors do not grow with time
//! and a snapshot continues bit for bit.

mod compliance;
mod inverse;
mod kinematics;
mod motion;
mod parameters;
mod path;
mod planning;
mod trajectory;
mod velocity;

pub use compliance::{Compliance, ComplianceParameters, ComplianceState, DeflectedBase, mass_matrix};
pub use inverse::{InverseSolutions, KinematicsError};
pub use kinematics::{Joints, LinkFrames, SingularityFactors, UrGeometry};
pub use parameters::{
    ArmCommand, ArmError, ArmParameters, COMFORTABLE_Q_RAD, CartesianLimits, JointLimits, place_base_for,
};
pub use trajectory::{AxisLimits, AxisState, Goal, Planner, Segment, TrajectoryError};

use motion::{JointMotion, Motion, NextPath, PathMotion};
use nalgebra::{Isometry3, Vector3};
use path::{JointsOnPath, Path, PathFollower};
use planning::{Aim, Insertion, PathGoal, check_speed};
use serde::{Deserialize, Serialize};

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

/// All of an arm's state, as plain data: see [`Arm::snapshot`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArmSnapshot {
    motion: Motion,
    insertion: Option<Insertion>,
    state: ArmState,
    last_command: ArmCommand,
}

/// A UR arm that moves within velocity, acceleration and jerk limits.
///
/// Not `Send`: Ruckig's objects stay on the thread that made them. Send an [`ArmSnapshot`] instead.
pub struct Arm {
    parameters: ArmParameters,
    joint_planner: Planner<6>,
    path_planner: Planner<1>,
    motion: Motion,
    insertion: Option<Insertion>,
    state: ArmState,
    last_command: ArmCommand,
}

impl Arm {
    /// An arm at rest at `initial_q_rad`.
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
                qd_rad_s: [0.0; 6],
                qdd_rad_s2: [0.0; 6],
                t_world_tool: Isometry3::identity(),
                linear_velocity_m_s: Vector3::zeros(),
                angular_velocity_rad_s: Vector3::zeros(),
                linear_acceleration_m_s2: Vector3::zeros(),
                angular_acceleration_rad_s2: Vector3::zeros(),
                mode: ArmMode::Hold,
                done: true,
                fault: None,
            },
            last_command: ArmCommand::Hold,
        };
        arm.publish(&arm.parameters.geometry.frames(initial_q_rad), &AxisState::at_rest(*initial_q_rad));
        Ok(arm)
    }

    /// What the arm was built with.
    pub fn parameters(&self) -> &ArmParameters {
        &self.parameters
    }

    /// The arm after the last tick.
    pub fn state(&self) -> &ArmState {
        &self.state
    }

    /// Pose of the flange in the patient frame.
    pub fn t_world_flange(&self) -> Isometry3<f64> {
        match &self.parameters.geometry.t_flange_tool {
            Some(tool) => self.state.t_world_tool * tool.inverse(),
            None => self.state.t_world_tool,
        }
    }

    /// Geometric Jacobian at the current joint angles: rows linear velocity of the tool base's origin, angular velocity;
    /// world axes.
    pub fn jacobian(&self) -> nalgebra::Matrix6<f64> {
        let mut jacobian = self.parameters.geometry.frames(&self.state.q_rad).jacobian();
        let turn = self.parameters.t_world_arm_base.rotation;
        for column in 0..6 {
            for row in [0, 3] {
                let turned = turn * jacobian.fixed_view::<3, 1>(row, column).into_owned();
                jacobian.fixed_view_mut::<3, 1>(row, column).copy_from(&turned);
            }
        }
        jacobian
    }

    /// Gives the arm a command, to be followed from the next tick on. A refused one leaves the motion as it was; one that
    /// equals the last accepted one does nothing.
    pub fn command(&mut self, command: ArmCommand) -> Result<(), ArmError> {
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
                // In proportion only from rest: a synchronised profile from motion could swing beyond a joint's range.
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
                let linear = check_speed("max_speed_m_s", max_speed_m_s, limits.speed_m_s)?;
                let angular = check_speed(
                    "max_angular_speed_rad_s",
                    max_angular_speed_rad_s,
                    limits.angular_speed_rad_s,
                )?;
                self.go_straight(&self.t_base_tool(&t_world_tool)?, (linear, angular))?;
                ArmMode::MoveCp
            }
            ArmCommand::Insert { axis_world, depth_m, feed_m_s } => {
                self.insert(&axis_world, depth_m, feed_m_s)?;
                ArmMode::Insert
            }
            ArmCommand::Rcm { t_world_tool, pivot_world_m, max_speed_m_s } => {
                let limits = &self.parameters.cartesian_limits;
                let speed = (
                    check_speed("max_speed_m_s", max_speed_m_s, limits.speed_m_s)?,
                    limits.angular_speed_rad_s,
                );
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

    /// Takes one tick.
    pub fn step(&mut self) -> &ArmState {
        match self.motion {
            Motion::Rest => {}
            Motion::Joint(motion) => self.step_joints(motion),
            Motion::Path(motion) => self.step_path(motion),
        }
        &self.state
    }

    /// The whole state, motion in progress included.
    pub fn snapshot(&self) -> ArmSnapshot {
        ArmSnapshot {
            motion: self.motion,
            insertion: self.insertion,
            state: self.state,
            last_command: self.last_command,
        }
    }

    /// Continues from `snapshot`, bit for bit, on an arm of the same parameters.
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

    fn follower(&self) -> PathFollower<'_> {
        PathFollower {
            geometry: &self.parameters.geometry,
            joint_limits: &self.parameters.joint_limits,
            cartesian_limits: &self.parameters.cartesian_limits,
        }
    }

    fn joint_state(&self) -> AxisState<6> {
        AxisState {
            position: self.state.q_rad,
            velocity: self.state.qd_rad_s,
            acceleration: self.state.qdd_rad_s2,
        }
    }

    fn joint_axis_limits(&self, speed_fraction: f64) -> AxisLimits<6> {
        let limits = &self.parameters.joint_limits;
        AxisLimits {
            velocity: limits.velocity_rad_s.map(|v| v * speed_fraction),
            acceleration: limits.acceleration_rad_s2,
            jerk: limits.jerk_rad_s3,
        }
    }

    fn time_s(&self, tick: u64) -> f64 {
        tick as f64 * self.parameters.dt_s
    }

    fn step_joints(&mut self, mut motion: JointMotion) {
        if let Goal::Velocity(rates) = motion.segment.goal {
            return self.step_rates(motion, rates);
        }
        motion.tick += 1;
        let time_s = self.time_s(motion.tick);
        let ended = time_s >= motion.duration_s;
        let joints = if ended {
            AxisState::at_rest(match motion.segment.goal {
                Goal::Independent(goal) | Goal::StraightLine(goal) => goal,
                Goal::Standstill | Goal::Velocity(_) => self.joint_planner.sample(motion.duration_s).position,
            })
        } else {
            self.joint_planner.sample(time_s)
        };
        self.publish(&self.parameters.geometry.frames(&joints.position), &joints);
        self.motion = Motion::Joint(motion);
        if ended {
            self.begin(motion.next);
        }
    }

    fn step_path(&mut self, mut motion: PathMotion) {
        motion.tick += 1;
        let time_s = self.time_s(motion.tick);
        let ended = time_s >= motion.duration_s;
        let parameter = match motion.segment.goal {
            Goal::Independent(goal) | Goal::StraightLine(goal) if ended => AxisState::at_rest(goal),
            Goal::Standstill if ended => {
                AxisState::at_rest(self.path_planner.sample(motion.duration_s).position)
            }
            _ => self.path_planner.sample(time_s),
        };
        match self.next_on_path(&motion.path, &parameter) {
            Ok(on_path) => {
                let (rate, change) = (parameter.velocity[0], parameter.acceleration[0]);
                let mut joints = AxisState::at_rest(on_path.q_rad);
                for i in 0..6 {
                    joints.velocity[i] = on_path.first[i] * rate;
                    joints.acceleration[i] = on_path.first[i] * change + on_path.second[i] * rate * rate;
                }
                self.publish(&on_path.frames, &joints);
                self.motion = Motion::Path(motion);
                if ended {
                    self.begin(motion.next);
                }
            }
            Err(error) => self.give_up(error),
        }
    }

    /// The joints at the path's parameter, unless one of them would jump or run at more than 1.5 times its limit there.
    fn next_on_path(&self, path: &Path, parameter: &AxisState<1>) -> Result<JointsOnPath, ArmError> {
        let [fraction] = parameter.position;
        let on_path = self
            .follower()
            .joints_at(path, fraction, &self.state.q_rad)
            .map_err(|reason| ArmError::PathUnreachable { fraction, reason })?;
        let swings = (0..6).any(|i| {
            let most = PATH_FAULT_FACTOR * self.parameters.joint_limits.velocity_rad_s[i];
            let step_rad = on_path.q_rad[i] - self.state.q_rad[i];
            step_rad.abs() > most * self.parameters.dt_s
                || (on_path.first[i] * parameter.velocity[0]).abs() > most
        });
        if swings {
            let manipulability_m3 = self.parameters.geometry.manipulability_m3(&on_path.q_rad);
            return Err(ArmError::PathSingular { fraction, manipulability_m3 });
        }
        Ok(on_path)
    }

    /// At rest: starts the path that waited for it, or stays.
    fn begin(&mut self, next: Option<NextPath>) {
        self.motion = Motion::Rest;
        if let Some(next) = next {
            match self.plan_path(next.path, AxisState::at_rest([0.0]), 1.0, next.limits) {
                Ok(motion) => {
                    self.path_planner.commit();
                    self.motion = Motion::Path(motion);
                }
                Err(error) => self.give_up(error),
            }
        }
        self.state.done = matches!(self.motion, Motion::Rest);
    }

    /// Leaves a motion that cannot be continued: a stop of the joints from velocities and accelerations cut to their limits
    /// (near a singularity they may be far beyond), and the reason in the state.
    fn give_up(&mut self, reason: ArmError) {
        self.state.fault = Some(reason);
        self.insertion = None;
        self.state.mode = ArmMode::Hold;
        self.last_command = ArmCommand::Hold;
        let limits = self.joint_axis_limits(1.0);
        let mut start = self.joint_state();
        for i in 0..6 {
            start.velocity[i] = start.velocity[i].clamp(-limits.velocity[i], limits.velocity[i]);
            start.acceleration[i] =
                start.acceleration[i].clamp(-limits.acceleration[i], limits.acceleration[i]);
        }
        let segment = Segment { start, goal: Goal::Standstill, limits };
        match self.joint_planner.plan(&segment) {
            Ok(duration_s) => {
                self.joint_planner.commit();
                self.step_joints(JointMotion { segment, duration_s, tick: 0, next: None });
            }
            Err(_) => {
                let stand = AxisState::at_rest(self.state.q_rad);
                self.publish(&self.parameters.geometry.frames(&stand.position), &stand);
                self.begin(None);
            }
        }
    }

    /// Writes joints and tool base into the state.
    fn publish(&mut self, frames: &LinkFrames, joints: &AxisState<6>) {
        let base = &self.parameters.t_world_arm_base;
        let jacobian = frames.jacobian();
        let velocity = jacobian * nalgebra::Vector6::from(joints.velocity);
        let acceleration = jacobian * nalgebra::Vector6::from(joints.acceleration)
            + frames.bias_acceleration(&joints.velocity);
        let state = &mut self.state;
        state.q_rad = joints.position;
        state.qd_rad_s = joints.velocity;
        state.qdd_rad_s2 = joints.acceleration;
        state.t_world_tool = base * frames.t_base_link(6);
        state.linear_velocity_m_s = base.rotation * velocity.fixed_rows::<3>(0).into_owned();
        state.angular_velocity_rad_s = base.rotation * velocity.fixed_rows::<3>(3).into_owned();
        state.linear_acceleration_m_s2 = base.rotation * acceleration.fixed_rows::<3>(0).into_owned();
        state.angular_acceleration_rad_s2 = base.rotation * acceleration.fixed_rows::<3>(3).into_owned();
    }
}

/// A path is given up where a joint would run at this many times its velocity limit.
const PATH_FAULT_FACTOR: f64 = 1.5;

#[cfg(test)]
mod tests {
    use super::*;

    /// A line that leaves the arm's reach, forced past the check that refuses it: the arm brakes within its acceleration
    /// limit, stands, and says why.
    #[test]
    fn a_line_that_breaks_on_the_way_ends_in_a_stop_and_a_fault() {
        let parameters = ArmParameters::ur5(1e-3);
        let mut arm = Arm::new(parameters, &COMFORTABLE_Q_RAD).unwrap();
        let goal = arm.state.t_world_tool * Isometry3::translation(0.0, 0.0, 3.0);
        let path = Path::straight(&arm.state.t_world_tool, &goal);
        let limits = AxisLimits { velocity: [0.05], acceleration: [0.2], jerk: [2.0] };
        let motion = arm.plan_path(path, AxisState::at_rest([0.0]), 1.0, limits).unwrap();
        arm.path_planner.commit();
        arm.motion = Motion::Path(motion);
        arm.state.done = false;
        let mut ticks_of_fault = 0;
        for _ in 0..40_000 {
            let before = arm.state;
            let state = *arm.step();
            ticks_of_fault += usize::from(state.fault.is_some());
            for i in 0..6 {
                let step_rad = (state.q_rad[i] - before.q_rad[i]).abs();
                assert!(
                    step_rad <= 1.5e-3 * parameters.joint_limits.velocity_rad_s[i],
                    "no jump: {step_rad}"
                );
            }
        }
        println!("fault: {:?}, {ticks_of_fault} ticks ago", arm.state.fault);
        assert!(arm.state.done && arm.state.qd_rad_s == [0.0; 6] && arm.state.mode == ArmMode::Hold);
        let fault = arm.state.fault;
        assert!(
            matches!(fault, Some(ArmError::PathUnreachable { .. } | ArmError::PathSingular { .. })),
            "{fault:?}"
        );
        arm.command(ArmCommand::MoveJp { q_rad: COMFORTABLE_Q_RAD, speed_fraction: 1.0 }).unwrap();
        assert_eq!(arm.state.fault, None);
    }
}
