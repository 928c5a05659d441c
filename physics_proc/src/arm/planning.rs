//! From a command to a motion: checks, inverse kinematics, stops before lines. Nothing is changed until all of it is
//! known to work.

use super::inverse;
use super::kinematics::Joints;
use super::line::Line;
use super::motion::{JointMotion, LineMotion, Motion, NextLine};
use super::trajectory::{AxisLimits, AxisState, Goal, Segment};
use super::{Arm, ArmError};
use nalgebra::Isometry3;

/// Samples at which a changed goal on the same line is checked for turning back.
const RETARGET_SAMPLES: usize = 64;

/// Where a line shall lead, and at what speed (m/s, rad/s).
#[derive(Clone, Copy)]
pub(super) struct LineGoal {
    t_base_flange: Isometry3<f64>,
    speed: (f64, f64),
}

impl Arm {
    fn t_base_flange(&self, t_world_flange: &Isometry3<f64>) -> Result<Isometry3<f64>, ArmError> {
        inverse::check_pose(t_world_flange).map_err(ArmError::Goal)?;
        Ok(self.parameters.t_world_arm_base.inv_mul(t_world_flange))
    }

    pub(super) fn joints_for(&self, t_world_flange: &Isometry3<f64>) -> Result<Joints, ArmError> {
        let goal = self.t_base_flange(t_world_flange)?;
        let limits = &self.parameters.joint_limits;
        self.parameters
            .geometry
            .inverse_nearest(&goal, &self.state.q_rad, &limits.lower_rad, &limits.upper_rad)
            .map_err(ArmError::Goal)
    }

    pub(super) fn go_to_joints(
        &mut self,
        goal: Goal<6>,
        q_rad: &Joints,
        speed_fraction: f64,
    ) -> Result<(), ArmError> {
        self.parameters.check_joints(q_rad)?;
        let speed_fraction = check_speed("speed_fraction", Some(speed_fraction), 1.0)?;
        let segment =
            Segment { start: self.joint_state(), goal, limits: self.joint_axis_limits(speed_fraction) };
        let duration_s = self.joint_planner.plan(&segment)?;
        self.joint_planner.commit();
        self.motion = Motion::Joint(JointMotion { segment, duration_s, tick: 0, next: None });
        Ok(())
    }

    /// Stops: on the line if on a line, else in the joints. `next` begins where the arm comes to rest.
    pub(super) fn stop_then(&mut self, goal_after: Option<LineGoal>) -> Result<(), ArmError> {
        let stop = match self.motion {
            Motion::Rest => {
                if let Some(goal) = goal_after {
                    let next = self.line_from(&self.state.q_rad, &goal)?;
                    let motion = self.plan_line(next.line, AxisState::at_rest([0.0]), 1.0, next.limits)?;
                    self.line_planner.commit();
                    self.motion = Motion::Line(motion);
                }
                return Ok(());
            }
            Motion::Joint(_) => {
                let segment = Segment {
                    start: self.joint_state(),
                    goal: Goal::Standstill,
                    limits: self.joint_axis_limits(1.0),
                };
                let duration_s = self.joint_planner.plan(&segment)?;
                let end = self.joint_planner.sample_candidate(duration_s).position;
                let next = goal_after.map(|goal| self.line_from(&end, &goal)).transpose()?;
                self.joint_planner.commit();
                Motion::Joint(JointMotion { segment, duration_s, tick: 0, next })
            }
            Motion::Line(old) => {
                let start = self.line_planner.sample(self.time_s(old.tick));
                let segment = Segment { start, goal: Goal::Standstill, limits: old.segment.limits };
                let duration_s = self.line_planner.plan(&segment)?;
                let end = self.line_planner.sample_candidate(duration_s).position[0];
                let unreachable = |reason| ArmError::LineUnreachable { fraction: end, reason };
                let end =
                    self.follower().joints_at(&old.line, end, &self.state.q_rad).map_err(unreachable)?;
                let next = goal_after.map(|goal| self.line_from(&end.q_rad, &goal)).transpose()?;
                self.line_planner.commit();
                Motion::Line(LineMotion { line: old.line, segment, duration_s, tick: 0, next })
            }
        };
        self.motion = stop;
        Ok(())
    }

    /// A line from the flange's pose at `q_rad`, looked at and found passable.
    fn line_from(&self, q_rad: &Joints, goal: &LineGoal) -> Result<NextLine, ArmError> {
        let line = Line::between(&self.parameters.geometry.forward(q_rad), &goal.t_base_flange);
        let limits = self.follower().limits_along(&line, (0.0, 1.0), q_rad, goal.speed)?;
        Ok(NextLine { line, limits })
    }

    pub(super) fn go_straight(
        &mut self,
        t_world_flange: &Isometry3<f64>,
        speed: (f64, f64),
    ) -> Result<(), ArmError> {
        let t_base_flange = self.t_base_flange(t_world_flange)?;
        if let Motion::Line(old) = self.motion {
            let start = self.line_planner.sample(self.time_s(old.tick));
            if let Some(motion) = self.extend_line(&old, start, &t_base_flange, speed)? {
                self.line_planner.commit();
                self.motion = Motion::Line(motion);
                return Ok(());
            }
        }
        self.stop_then(Some(LineGoal { t_base_flange, speed }))
    }

    /// The motion to a goal further along the line the flange is on; `None` if the goal lies elsewhere, or if the flange
    /// would turn back on the way (goal nearer than the stopping distance, or a speed cut so sharp that Ruckig's braking
    /// undershoots through zero).
    fn extend_line(
        &mut self,
        old: &LineMotion,
        start: AxisState<1>,
        goal: &Isometry3<f64>,
        speed: (f64, f64),
    ) -> Result<Option<LineMotion>, ArmError> {
        let from = start.position[0];
        let Some(to) = old.line.parameter_of(goal, from) else { return Ok(None) };
        let direction = if to < from { -1.0 } else { 1.0 };
        let limits = self.follower().limits_along(&old.line, (from, to), &self.state.q_rad, speed)?;
        let motion = self.plan_line(old.line, start, to, limits)?;
        // All braking, and so any turning back, is over after this time; a sample every few milliseconds finds it.
        let (a, j) = (limits.acceleration[0], limits.jerk[0]);
        let brake_s = start.velocity[0].abs() / a + start.acceleration[0].abs() / j + 3.0 * a / j;
        let goes_on = (0..=RETARGET_SAMPLES).all(|i| {
            let time_s = brake_s.min(motion.duration_s) * i as f64 / RETARGET_SAMPLES as f64;
            let sample = self.line_planner.sample_candidate(time_s);
            (to - sample.position[0]) * direction >= -1e-9 && sample.velocity[0] * direction >= -1e-9
        });
        Ok(goes_on.then_some(motion))
    }

    /// Plans the parameter's way to `to` as the candidate of the line planner.
    pub(super) fn plan_line(
        &mut self,
        line: Line,
        start: AxisState<1>,
        to: f64,
        limits: AxisLimits<1>,
    ) -> Result<LineMotion, ArmError> {
        let segment = Segment { start, goal: Goal::Independent([to]), limits };
        let duration_s = self.line_planner.plan(&segment)?;
        Ok(LineMotion { line, segment, duration_s, tick: 0, next: None })
    }
}

pub(super) fn check_speed(name: &'static str, given: Option<f64>, maximum: f64) -> Result<f64, ArmError> {
    match given {
        None => Ok(maximum),
        Some(given) if given > 0.0 && given <= maximum => Ok(given),
        Some(given) => Err(ArmError::SpeedOutOfRange { name, given, maximum }),
    }
}
