//! A straight line of the flange, and the limits of the path parameter that keep the joints within theirs.

use super::inverse::KinematicsError;
use super::kinematics::{Joints, LinkFrames, UrGeometry, solve_rates, stack};
use super::parameters::{ArmError, CartesianLimits, JointLimits};
use super::trajectory::AxisLimits;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// Intervals in which a line is looked at before it is accepted.
const LINE_INTERVALS: usize = 32;
/// A line on which |det J| falls below this is refused as singular (UR5: typically 0.05 to 0.1 m³).
const LEAST_MANIPULABILITY_M3: f64 = 1e-4;
/// Joint angles at the next sample may differ by this from their trapezoidal prediction before the line counts as singular.
const PREDICTION_TOLERANCE_RAD: f64 = 0.05;
/// A goal this near to the extended line lies on it: 1e-9 m and 1e-9 rad, a thousandth of the promised micrometre.
const SAME_LINE_TOLERANCE: f64 = 1e-9;
/// Ceilings of the path parameter's rates (1/s, 1/s², 1/s³), so that a line of almost no length stays well-scaled.
const PARAMETER_CEILING: [f64; 3] = [1e4, 1e6, 1e8];

/// A straight translation and a turn about a fixed axis, in proportion to one parameter: 0 at the start, 1 at the goal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Line {
    start: Isometry3<f64>,
    translation_m: Vector3<f64>,
    rotation_rad: Vector3<f64>,
}

impl Line {
    /// From `start` to `goal` (both in the base frame), by the shorter turn.
    pub(super) fn between(start: &Isometry3<f64>, goal: &Isometry3<f64>) -> Self {
        let turn = goal.rotation * start.rotation.inverse();
        Self {
            start: *start,
            translation_m: goal.translation.vector - start.translation.vector,
            rotation_rad: turn.scaled_axis(),
        }
    }

    /// The flange's pose at `parameter`, also beyond [0, 1].
    pub(super) fn pose(&self, parameter: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_scaled_axis(self.rotation_rad * parameter);
        let position = self.start.translation.vector + self.translation_m * parameter;
        Isometry3::from_parts(Translation3::from(position), turn * self.start.rotation)
    }

    /// Derivative of the pose by the parameter (linear m, angular rad; base axes): the same everywhere on the line.
    fn twist(&self) -> Vector6<f64> {
        stack(&self.translation_m, &self.rotation_rad)
    }

    /// The parameter at which this line, extended, passes `goal`; `None` if it does not.
    pub(super) fn parameter_of(&self, goal: &Isometry3<f64>, now: f64) -> Option<f64> {
        let ahead = Line::between(&self.pose(now), goal);
        let length_squared = self.translation_m.norm_squared() + self.rotation_rad.norm_squared();
        let along = self.translation_m.dot(&ahead.translation_m) + self.rotation_rad.dot(&ahead.rotation_rad);
        let step = along / length_squared;
        let missed_m = (ahead.translation_m - self.translation_m * step).norm();
        let missed_rad = (ahead.rotation_rad - self.rotation_rad * step).norm();
        (missed_m <= SAME_LINE_TOLERANCE && missed_rad <= SAME_LINE_TOLERANCE).then_some(now + step)
    }
}

/// Joint angles on a line, with their first and second derivative by the path parameter.
#[derive(Clone, Copy, Debug)]
pub(super) struct JointsOnLine {
    pub(super) q_rad: Joints,
    pub(super) first: Joints,
    pub(super) second: Joints,
    pub(super) frames: LinkFrames,
}

/// What following a line needs to know about the arm.
#[derive(Clone, Copy)]
pub(super) struct LineFollower<'a> {
    pub(super) geometry: &'a UrGeometry,
    pub(super) joint_limits: &'a JointLimits,
    pub(super) cartesian_limits: &'a CartesianLimits,
}

impl LineFollower<'_> {
    /// Joint angles that put the flange exactly on the line, on the branch nearest to `q_near_rad`.
    pub(super) fn joints_at(
        &self,
        line: &Line,
        parameter: f64,
        q_near_rad: &Joints,
    ) -> Result<JointsOnLine, KinematicsError> {
        let limits = self.joint_limits;
        let pose = line.pose(parameter);
        let q_rad = self.geometry.inverse_nearest(&pose, q_near_rad, &limits.lower_rad, &limits.upper_rad)?;
        let frames = self.geometry.frames(&q_rad);
        let jacobian = frames.jacobian();
        let singular = KinematicsError::WristSingular { sin_q5: libm::sin(q_rad[4]).abs(), minimum: 0.0 };
        let first = solve_rates(&jacobian, &line.twist()).ok_or(singular)?;
        let second = solve_rates(&jacobian, &-frames.bias_acceleration(&first)).ok_or(singular)?;
        Ok(JointsOnLine { q_rad, first, second, frames })
    }

    /// Looks at the line from parameter `from` to `to`, refuses it if the arm cannot follow it, and returns limits of the
    /// path parameter that keep the flange within its limits and `speed` (m/s, rad/s), and the joints within theirs.
    ///
    /// With q(s(t)): q̇ = q' ṡ, q̈ = q' s̈ + q'' ṡ², q⃛ = q' s⃛ + 3 q'' ṡ s̈ + q''' ṡ³. Each joint's acceleration limit is
    /// shared half and half, its jerk limit in thirds. q''' is the difference quotient of q''.
    pub(super) fn limits_along(
        &self,
        line: &Line,
        (from, to): (f64, f64),
        q_start_rad: &Joints,
        speed: (f64, f64),
    ) -> Result<AxisLimits<1>, ArmError> {
        let bend = self.bend_along(line, (from, to), q_start_rad)?;
        let (length_m, angle_rad) = (line.translation_m.norm(), line.rotation_rad.norm());
        let c = self.cartesian_limits;
        let cap =
            |ceiling: f64, linear: f64, angular: f64| ceiling.min(linear / length_m).min(angular / angle_rad);
        let mut velocity = cap(PARAMETER_CEILING[0], speed.0, speed.1);
        let mut acceleration = cap(PARAMETER_CEILING[1], c.acceleration_m_s2, c.angular_acceleration_rad_s2);
        let mut jerk = cap(PARAMETER_CEILING[2], c.jerk_m_s3, c.angular_jerk_rad_s3);
        let j = self.joint_limits;
        for i in 0..6 {
            velocity = velocity
                .min(j.velocity_rad_s[i] / bend.first[i])
                .min(libm::sqrt(0.5 * j.acceleration_rad_s2[i] / bend.second[i]))
                .min(libm::cbrt(j.jerk_rad_s3[i] / (3.0 * bend.third[i])));
            acceleration = acceleration.min(0.5 * j.acceleration_rad_s2[i] / bend.first[i]);
            jerk = jerk.min(j.jerk_rad_s3[i] / (3.0 * bend.first[i]));
        }
        for i in 0..6 {
            acceleration = acceleration.min(j.jerk_rad_s3[i] / (9.0 * bend.second[i] * velocity));
        }
        Ok(AxisLimits { velocity: [velocity], acceleration: [acceleration], jerk: [jerk] })
    }

    /// The greatest derivatives of the joint angles along the line.
    fn bend_along(
        &self,
        line: &Line,
        (from, to): (f64, f64),
        q_start_rad: &Joints,
    ) -> Result<Bend, ArmError> {
        let step = (to - from) / LINE_INTERVALS as f64;
        let signs = self.signs(q_start_rad);
        let mut bend = Bend { first: [0.0; 6], second: [0.0; 6], third: [0.0; 6] };
        let mut previous: Option<JointsOnLine> = None;
        for sample in 0..=LINE_INTERVALS {
            let fraction = sample as f64 / LINE_INTERVALS as f64;
            let near = previous.map_or(*q_start_rad, |p| p.q_rad);
            let here = self
                .joints_at(line, from + (to - from) * fraction, &near)
                .map_err(|reason| ArmError::LineUnreachable { fraction, reason })?;
            let manipulability_m3 = self.geometry.manipulability_m3(&here.q_rad);
            let leaves_branch =
                self.signs(&here.q_rad) != signs || manipulability_m3 < LEAST_MANIPULABILITY_M3;
            if leaves_branch || previous.is_some_and(|p| !p.predicts(&here, step)) {
                return Err(ArmError::LineSingular { fraction, manipulability_m3 });
            }
            bend.include(&here, previous.as_ref(), step);
            previous = Some(here);
        }
        Ok(bend)
    }

    /// The signs that name a branch of the inverse kinematics.
    fn signs(&self, q_rad: &Joints) -> [bool; 3] {
        let f = self.geometry.singularity_factors(q_rad);
        [f.elbow > 0.0, f.wrist > 0.0, f.shoulder_m > 0.0]
    }
}

impl JointsOnLine {
    /// Is `next` where the mean of both slopes leads in `step`?
    fn predicts(&self, next: &Self, step: f64) -> bool {
        (0..6).all(|i| {
            let predicted = self.q_rad[i] + 0.5 * step * (self.first[i] + next.first[i]);
            (next.q_rad[i] - predicted).abs() <= PREDICTION_TOLERANCE_RAD
        })
    }
}

/// Greatest absolute derivatives of the joint angles by the path parameter.
struct Bend {
    first: Joints,
    second: Joints,
    third: Joints,
}

impl Bend {
    fn include(&mut self, here: &JointsOnLine, previous: Option<&JointsOnLine>, step: f64) {
        for i in 0..6 {
            self.first[i] = self.first[i].max(here.first[i].abs());
            self.second[i] = self.second[i].max(here.second[i].abs());
            if let Some(previous) = previous.filter(|_| step != 0.0) {
                let third = (here.second[i] - previous.second[i]) / step;
                self.third[i] = self.third[i].max(third.abs());
            }
        }
    }
}
