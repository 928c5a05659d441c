//! Plans a motion for a command: checks, inverse kinematics, and stops before lines. Nothing changes until
//! the whole plan is known to work.

use super::inverse;
use super::kinematics::Joints;
use super::motion::{JointMotion, Motion, NextPath, PathMotion};
use super::path::{Path, PathSpeed, Stretch};
use super::serial::Redundancy;
use super::trajectory::{AxisLimits, AxisState, Goal, Segment};
use super::{Arm, ArmError, ArmGeometry};
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use serde::{Deserialize, Serialize};

/// Maximum insertion depth in either direction.
const MAX_DEPTH_M: f64 = 0.5;
/// Number of samples for detecting reversal after a goal change on the same line.
const RETARGET_SAMPLES: usize = 64;

/// Maximum distance of the pivot from the tool axis at start and goal of an RCM motion.
const PIVOT_TOLERANCE_M: f64 = 1e-6;

/// Goal and speed of a path, in the base frame.
#[derive(Clone, Copy)]
pub(super) struct PathGoal {
    pub(super) aim: Aim,
    pub(super) speed: PathSpeed,
}

/// The goal of a path.
#[derive(Clone, Copy)]
pub(super) enum Aim {
    /// Straight to a pose.
    Pose(Isometry3<f64>),
    /// To a pose, with the tool axis through the pivot throughout.
    About { t_base_tool: Isometry3<f64>, pivot_m: Vector3<f64> },
    /// Along an axis, by a distance from the arm's position at rest.
    Along { axis: Unit<Vector3<f64>>, depth_m: f64 },
}

/// Coordinate difference below which two axes are the same: a client that recomputes an axis every tick gets
/// different rounding errors.
const SAME_AXIS: f64 = 1e-6;

/// The line of an insertion, kept through successive insertions along the same axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Insertion {
    axis_world: Vector3<f64>,
    /// Pose at zero depth, base frame.
    start: Isometry3<f64>,
}

impl Arm {
    pub(super) fn t_base_tool(&self, t_world_tool: &Isometry3<f64>) -> Result<Isometry3<f64>, ArmError> {
        inverse::check_pose(t_world_tool).map_err(ArmError::Goal)?;
        let goal = self.parameters.t_world_arm_base.inv_mul(t_world_tool);
        match &self.parameters.geometry {
            ArmGeometry::Gantry(gantry) => gantry.unturned(goal).map_err(ArmError::Goal),
            _ => Ok(goal),
        }
    }

    /// Starts an insertion, or changes the depth of the current one.
    pub(super) fn insert(
        &mut self,
        axis_world: &Vector3<f64>,
        depth_m: f64,
        feed_m_s: f64,
    ) -> Result<(), ArmError> {
        let length = axis_world.norm();
        if !((length - 1.0).abs() <= 1e-6 && depth_m.abs() <= MAX_DEPTH_M) {
            return Err(ArmError::InvalidInsertion { axis_length: length, depth_m, maximum_m: MAX_DEPTH_M });
        }
        let limits = self.parameters.cartesian_limits;
        let speed = PathSpeed {
            linear_m_s: check_speed("feed_m_s", Some(feed_m_s), limits.speed_m_s)?,
            angular_rad_s: limits.angular_speed_rad_s,
        };
        let base = &self.parameters.t_world_arm_base;
        let same = |insertion: &Insertion| (insertion.axis_world - axis_world).amax() <= SAME_AXIS;
        let standing = self.insertion.filter(same);
        // Use the axis that the insertion started with: depth along any other axis would be on another line.
        let along = standing.map_or(*axis_world, |insertion| insertion.axis_world);
        // Dividing by the norm makes this a unit vector.
        let axis = Unit::new_unchecked(base.rotation.inverse_transform_vector(&along) / along.norm());
        match standing {
            Some(insertion) => {
                let mut goal = insertion.start;
                goal.translation.vector += axis.into_inner() * depth_m;
                self.go_straight(&goal, speed)?;
            }
            None => {
                let aim = Aim::Along { axis, depth_m };
                let begin = self.stop_then(Some(PathGoal { aim, speed }))?;
                self.insertion = begin.map(|start| Insertion { axis_world: *axis_world, start });
            }
        }
        Ok(())
    }

    pub(super) fn joints_for(&self, t_world_tool: &Isometry3<f64>) -> Result<Joints, ArmError> {
        let goal = self.t_base_tool(t_world_tool)?;
        let limits = &self.parameters.joint_limits;
        self.parameters
            .geometry
            .inverse_nearest(&goal, &self.state.q_rad, &limits.lower_rad, &limits.upper_rad, Redundancy::Free)
            .map_err(ArmError::Goal)
    }

    pub(super) fn go_to_joints(
        &mut self,
        goal: Goal<MAX_ARM_JOINTS>,
        q_rad: &Joints,
        speed_fraction: f64,
    ) -> Result<(), ArmError> {
        self.parameters.check_joints(q_rad)?;
        if matches!(self.motion, Motion::Path(_)) {
            self.check_stop()?;
        }
        let speed_fraction = check_speed("speed_fraction", Some(speed_fraction), 1.0)?;
        let segment =
            Segment { start: self.joint_state(), goal, limits: self.joint_axis_limits(speed_fraction) };
        let duration_s = self.joint_planner.plan(&segment)?;
        self.joint_planner.commit();
        self.motion = Motion::Joint(JointMotion { segment, duration_s, tick: 0, next: None });
        Ok(())
    }

    /// Stops along the path if on one, otherwise in joint space. Returns the joints at rest, where the next
    /// motion starts.
    pub(super) fn stop_then(
        &mut self,
        goal_after: Option<PathGoal>,
    ) -> Result<Option<Isometry3<f64>>, ArmError> {
        let (motion, next) = match self.motion {
            Motion::Rest => {
                let Some(goal) = goal_after else { return Ok(None) };
                let next = self.path_from(&self.state.q_rad, &goal)?;
                let motion = self.plan_path(next.path, AxisState::at_rest([0.0]), 1.0, next.limits)?;
                self.path_planner.commit();
                (Motion::Path(motion), Some(next))
            }
            Motion::Joint(_) => {
                let segment = Segment {
                    start: self.joint_state(),
                    goal: Goal::Standstill,
                    limits: self.joint_axis_limits(1.0),
                };
                let duration_s = self.joint_planner.plan(&segment)?;
                let end = self.joint_planner.sample_candidate(duration_s).position;
                let next = goal_after.map(|goal| self.path_from(&end, &goal)).transpose()?;
                self.joint_planner.commit();
                (Motion::Joint(JointMotion { segment, duration_s, tick: 0, next }), next)
            }
            Motion::Path(old) => {
                let start = self.path_planner.sample(self.time_s(old.tick));
                let segment = Segment { start, goal: Goal::Standstill, limits: old.segment.limits };
                let duration_s = self.path_planner.plan(&segment)?;
                let end = self.path_planner.sample_candidate(duration_s).position[0];
                let unreachable = |reason| ArmError::PathUnreachable { fraction: end, reason };
                let end =
                    self.follower().joints_at(&old.path, end, &self.state.q_rad).map_err(unreachable)?;
                let next = goal_after.map(|goal| self.path_from(&end.q_rad, &goal)).transpose()?;
                self.path_planner.commit();
                (Motion::Path(PathMotion { path: old.path, segment, duration_s, tick: 0, next }), next)
            }
        };
        self.motion = motion;
        Ok(next.map(|next| next.path.pose(0.0)))
    }

    /// Returns a path from the tool base's pose at `q_rad`, checked to be feasible.
    fn path_from(&self, q_rad: &Joints, goal: &PathGoal) -> Result<NextPath, ArmError> {
        let start = self.parameters.geometry.forward(q_rad);
        let path = match &goal.aim {
            Aim::Pose(t_base_tool) => Path::straight(&start, t_base_tool),
            Aim::About { t_base_tool, pivot_m } => {
                for (end, pose) in [("start", &start), ("goal", t_base_tool)] {
                    let in_tool = pose.inverse_transform_point(&Point3::from(*pivot_m));
                    let missed_m = libm::hypot(in_tool.x, in_tool.y);
                    // NaN is in no range, so this rejects it too.
                    if !(0.0..=PIVOT_TOLERANCE_M).contains(&missed_m) {
                        return Err(ArmError::PivotMissed { end, missed_m, allowed_m: PIVOT_TOLERANCE_M });
                    }
                }
                Path::about(&start, t_base_tool, pivot_m)
            }
            Aim::Along { axis, depth_m } => {
                let mut end = start;
                end.translation.vector += axis.into_inner() * *depth_m;
                Path::straight(&start, &end)
            }
        };
        let limits = self.follower().limits_along(&path, Stretch::WHOLE, q_rad, goal.speed)?;
        Ok(NextPath { path, limits })
    }

    /// Moves straight to `t_base_tool`, without a stop if the goal is ahead on the current line.
    pub(super) fn go_straight(
        &mut self,
        t_base_tool: &Isometry3<f64>,
        speed: PathSpeed,
    ) -> Result<(), ArmError> {
        if let Motion::Path(old) = self.motion {
            let start = self.path_planner.sample(self.time_s(old.tick));
            if let Some(motion) = self.extend_path(&old, start, t_base_tool, speed)? {
                self.path_planner.commit();
                self.motion = Motion::Path(motion);
                return Ok(());
            }
        }
        self.stop_then(Some(PathGoal { aim: Aim::Pose(*t_base_tool), speed })).map(drop)
    }

    /// Returns the motion to a goal farther along the current line. `None` if the goal is elsewhere, or if
    /// the tool would reverse on the way (goal nearer than the stopping distance, or a speed reduced so
    /// sharply that Ruckig's braking undershoots through zero).
    fn extend_path(
        &mut self,
        old: &PathMotion,
        start: AxisState<1>,
        goal: &Isometry3<f64>,
        speed: PathSpeed,
    ) -> Result<Option<PathMotion>, ArmError> {
        let from = start.position[0];
        let Some(to) = old.path.parameter_of(goal, from) else { return Ok(None) };
        let direction = if to < from { -1.0 } else { 1.0 };
        let limits =
            self.follower().limits_along(&old.path, Stretch { from, to }, &self.state.q_rad, speed)?;
        let motion = self.plan_path(old.path, start, to, limits)?;
        // All braking, and so any reversal, ends within this time; a sample every few milliseconds detects
        // it.
        let (a, j) = (limits.acceleration[0], limits.jerk[0]);
        let brake_s = start.velocity[0].abs() / a + start.acceleration[0].abs() / j + 3.0 * a / j;
        let goes_on = (0..=RETARGET_SAMPLES).all(|i| {
            let time_s = brake_s.min(motion.duration_s) * i as f64 / RETARGET_SAMPLES as f64;
            let sample = self.path_planner.sample_candidate(time_s);
            (to - sample.position[0]) * direction >= -1e-9 && sample.velocity[0] * direction >= -1e-9
        });
        Ok(goes_on.then_some(motion))
    }

    /// Plans the parameter's motion to `to` as the path planner's candidate.
    pub(super) fn plan_path(
        &mut self,
        path: Path,
        start: AxisState<1>,
        to: f64,
        limits: AxisLimits<1>,
    ) -> Result<PathMotion, ArmError> {
        let segment = Segment { start, goal: Goal::Independent([to]), limits };
        let duration_s = self.path_planner.plan(&segment)?;
        Ok(PathMotion { path, segment, duration_s, tick: 0, next: None })
    }
}

pub(super) fn check_speed(name: &'static str, given: Option<f64>, maximum: f64) -> Result<f64, ArmError> {
    match given {
        None => Ok(maximum),
        Some(given) if given > 0.0 && given <= maximum => Ok(given),
        Some(given) => Err(ArmError::SpeedOutOfRange { name, given, maximum }),
    }
}
