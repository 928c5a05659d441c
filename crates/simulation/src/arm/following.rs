//! Advances the motion in progress by one tick, in joint space or along a path.

use super::motion::{JointMotion, Motion, NextPath, PathMotion};
use super::path::{JointsOnPath, Path, PathFollower};
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, SVector};

use super::{Arm, ArmCommand, ArmError, ArmMode, AxisLimits, AxisState, Goal, Joints, LinkFrames, Segment};

/// Factor over its velocity limit at which a joint makes the arm abandon a path.
const PATH_FAULT_FACTOR: f64 = 1.5;

/// Number of poses on the way of a stop.
const STOP_SAMPLES: usize = 4;

impl Arm {
    pub(super) fn follower(&self) -> PathFollower<'_> {
        PathFollower {
            geometry: &self.parameters.geometry,
            joint_limits: &self.parameters.joint_limits,
            cartesian_limits: &self.parameters.cartesian_limits,
        }
    }

    /// Returns whether the tool's base follows a path, which determines the joints.
    pub fn is_on_path(&self) -> bool {
        matches!(self.motion, Motion::Path(_))
    }

    /// Puts the joints into another state, as if the last tick had led there. A motion in joint space is
    /// planned again from there to its goal; joints at rest that are given a velocity brake.
    ///
    /// # Errors
    /// [`ArmError::OnPath`]; or Ruckig finds no motion from there. Nothing has changed then.
    pub fn displace(&mut self, joints: &AxisState<MAX_ARM_JOINTS>) -> Result<(), ArmError> {
        let planned = match self.motion {
            Motion::Path(_) => return Err(ArmError::OnPath),
            Motion::Rest if AxisState::at_rest(joints.position) == *joints => None,
            Motion::Rest => Some((Goal::Standstill, self.joint_axis_limits(1.0), None)),
            Motion::Joint(motion) => {
                let goal = match motion.segment.goal {
                    // Only joints at rest can follow a straight line.
                    Goal::StraightLine(goal) => Goal::Independent(goal),
                    goal => goal,
                };
                Some((goal, motion.segment.limits, motion.next))
            }
        };
        if let Some((goal, limits, next)) = planned {
            let segment = Segment { start: *joints, goal, limits };
            let duration_s = self.joint_planner.plan(&segment)?;
            self.joint_planner.commit();
            self.motion = Motion::Joint(JointMotion { segment, duration_s, tick: 0, next });
        }
        self.publish(&self.parameters.geometry.frames(&joints.position), joints);
        Ok(())
    }

    /// Returns position, velocity and acceleration of the joints.
    pub fn joint_state(&self) -> AxisState<MAX_ARM_JOINTS> {
        AxisState {
            position: self.state.q_rad,
            velocity: self.state.qd_rad_s,
            acceleration: self.state.qdd_rad_s2,
        }
    }

    pub(super) fn joint_axis_limits(&self, speed_fraction: f64) -> AxisLimits<MAX_ARM_JOINTS> {
        let limits = &self.parameters.joint_limits;
        AxisLimits {
            velocity: limits.velocity_rad_s.map(|v| v * speed_fraction),
            acceleration: limits.acceleration_rad_s2,
            jerk: limits.jerk_rad_s3,
        }
    }

    pub(super) fn time_s(&self, tick: u64) -> f64 {
        tick as f64 * self.parameters.dt_s
    }

    pub(super) fn step_joints(&mut self, mut motion: JointMotion) {
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

    pub(super) fn step_path(&mut self, mut motion: PathMotion) {
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
                for i in 0..MAX_ARM_JOINTS {
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

    /// Returns the joints at the path parameter. Fails if one of them would jump or exceed 1.5 times its
    /// velocity limit.
    fn next_on_path(&self, path: &Path, parameter: &AxisState<1>) -> Result<JointsOnPath, ArmError> {
        let [fraction] = parameter.position;
        let on_path = self
            .follower()
            .joints_at(path, fraction, &self.state.q_rad)
            .map_err(|reason| ArmError::PathUnreachable { fraction, reason })?;
        let swings = (0..MAX_ARM_JOINTS).any(|i| {
            let most = PATH_FAULT_FACTOR * self.parameters.joint_limits.velocity_rad_s[i];
            let step_rad = on_path.q_rad[i] - self.state.q_rad[i];
            step_rad.abs() > most * self.parameters.dt_s
                || (on_path.first[i] * parameter.velocity[0]).abs() > most
        });
        if swings {
            return Err(ArmError::PathJumps { fraction });
        }
        Ok(on_path)
    }

    /// Starts the pending path from rest, or stays at rest.
    pub(super) fn begin(&mut self, next: Option<NextPath>) {
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

    /// Abandons a motion that cannot continue: stops the joints and stores the reason in the state. The stop
    /// starts from velocities and accelerations clamped to their limits, which they may far exceed near a
    /// singularity.
    pub(super) fn give_up(&mut self, reason: ArmError) {
        self.state.fault = Some(reason);
        self.insertion = None;
        self.state.mode = ArmMode::Hold;
        self.last_command = ArmCommand::Hold;
        let limits = self.joint_axis_limits(1.0);
        let mut start = self.joint_state();
        for i in 0..MAX_ARM_JOINTS {
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

    /// Brakes as quickly as the limits allow, on the path if on one, and advances by one tick. A stop that is
    /// already in progress goes on.
    pub fn brake(&mut self, reason: ArmError) {
        let is_stopping = match &self.motion {
            Motion::Rest => true,
            Motion::Joint(motion) => motion.segment.goal == Goal::Standstill && motion.next.is_none(),
            Motion::Path(motion) => motion.segment.goal == Goal::Standstill && motion.next.is_none(),
        };
        if !is_stopping {
            if self.stop_then(None).is_err() {
                return self.give_up(reason);
            }
            self.stay(reason);
        }
        self.step();
    }

    /// Cancels a motion that has just begun from rest at `q_rad`.
    pub fn stand(&mut self, q_rad: &Joints, reason: ArmError) {
        let stand = AxisState::at_rest(*q_rad);
        self.publish(&self.parameters.geometry.frames(q_rad), &stand);
        self.begin(None);
        self.stay(reason);
    }

    /// Notes that the arm holds for a reason of its own.
    fn stay(&mut self, reason: ArmError) {
        self.state.fault = Some(reason);
        self.state.mode = ArmMode::Hold;
        self.last_command = ArmCommand::Hold;
    }

    /// Visits poses of the tool's base, patient frame, on the way of a stop that begins now, and the last one
    /// where it ends. Nothing changes.
    ///
    /// # Errors
    /// Ruckig finds no stop.
    pub fn visit_stop(&mut self, mut visit: impl FnMut(&Isometry3<f64>)) -> Result<(), ArmError> {
        let base = &self.parameters.t_world_arm_base;
        let part = |duration_s: f64, sample: usize| duration_s * sample as f64 / STOP_SAMPLES as f64;
        match self.motion {
            Motion::Rest => {}
            Motion::Joint(_) => {
                let (start, limits) = (self.joint_state(), self.joint_axis_limits(1.0));
                let segment = Segment { start, goal: Goal::Standstill, limits };
                let duration_s = self.joint_planner.plan(&segment)?;
                for sample in 1..=STOP_SAMPLES {
                    let q_rad = self.joint_planner.sample_candidate(part(duration_s, sample)).position;
                    visit(&(base * self.parameters.geometry.forward(&q_rad)));
                }
            }
            Motion::Path(motion) => {
                let start = self.path_planner.sample(self.time_s(motion.tick));
                let segment = Segment { start, goal: Goal::Standstill, limits: motion.segment.limits };
                let duration_s = self.path_planner.plan(&segment)?;
                for sample in 1..=STOP_SAMPLES {
                    let [at] = self.path_planner.sample_candidate(part(duration_s, sample)).position;
                    visit(&(base * motion.path.pose(at)));
                }
            }
        }
        Ok(())
    }

    /// Writes the joints and the tool base to the state.
    pub(super) fn publish(&mut self, frames: &LinkFrames, joints: &AxisState<MAX_ARM_JOINTS>) {
        let base = &self.parameters.t_world_arm_base;
        let geometry = &self.parameters.geometry;
        let jacobian = geometry.jacobian(frames);
        let velocity = jacobian * SVector::from(joints.velocity);
        let acceleration = jacobian * SVector::from(joints.acceleration)
            + geometry.bias_acceleration(frames, &joints.velocity);
        let state = &mut self.state;
        state.q_rad = joints.position;
        state.qd_rad_s = joints.velocity;
        state.qdd_rad_s2 = joints.acceleration;
        state.t_world_tool = base * frames.t_base_tool();
        state.linear_velocity_m_s = base.rotation * velocity.fixed_rows::<3>(0).into_owned();
        state.angular_velocity_rad_s = base.rotation * velocity.fixed_rows::<3>(3).into_owned();
        state.linear_acceleration_m_s2 = base.rotation * acceleration.fixed_rows::<3>(0).into_owned();
        state.angular_acceleration_rad_s2 = base.rotation * acceleration.fixed_rows::<3>(3).into_owned();
    }
}
