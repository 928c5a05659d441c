//! Cartesian paths of the tool base (a straight line or a rotation about a pivot), and limits on the path
//! parameter that keep the tool and the joints within their own limits.

use super::geometry::ArmGeometry;
use super::inverse::KinematicsError;
use super::kinematics::{Joints, LinkFrames, solve_rates, stack};
use super::parameters::{ArmError, CartesianLimits, JointLimits};
use super::serial::Redundancy;
use super::trajectory::AxisLimits;
use messages::MAX_ARM_JOINTS;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// Number of intervals at which a path is checked before it is accepted.
const PATH_INTERVALS: usize = 32;
/// |det J| below which a path is rejected as singular (UR5: typically 0.05 to 0.1 m³).
pub(crate) const LEAST_MANIPULABILITY_M3: f64 = 1e-4;
/// Difference of the joint angles at the next sample from their trapezoidal prediction above which a path
/// counts as singular.
const PREDICTION_TOLERANCE_RAD: f64 = 0.05;
/// Tolerance for a goal on the extended line: 1e-9 m and 1e-9 rad, a thousandth of the specified micrometre.
const SAME_LINE_TOLERANCE: f64 = 1e-9;
/// Upper limits of the path parameter's rates (1/s, 1/s², 1/s³), which keep very short paths well scaled.
const PARAMETER_CEILING: [f64; 3] = [1e4, 1e6, 1e8];

/// Shape of a path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
enum Course {
    /// The origin moves along a straight line.
    Straight { translation_m: Vector3<f64> },
    /// A point of the tool axis stays at `pivot_m`. In the tool frame, it starts at `in_tool_m` and moves by
    /// `shift_m`.
    Pivot { pivot_m: Vector3<f64>, in_tool_m: Vector3<f64>, shift_m: Vector3<f64> },
}

/// A translation and a rotation about a fixed axis, both proportional to one parameter: 0 at the start, 1 at
/// the goal. Base frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Path {
    start: Isometry3<f64>,
    rotation_rad: Vector3<f64>,
    course: Course,
}

/// Maximum speed of the tool's base on a path.
#[derive(Clone, Copy, Debug)]
pub(super) struct PathSpeed {
    /// Speed of the origin, m/s.
    pub(super) linear_m_s: f64,
    /// Speed of rotation, rad/s.
    pub(super) angular_rad_s: f64,
}

/// Section of a path between two values of its parameter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stretch {
    pub(super) from: f64,
    pub(super) to: f64,
}

impl Stretch {
    /// The whole path.
    pub(super) const WHOLE: Stretch = Stretch { from: 0.0, to: 1.0 };
}

impl Path {
    /// Creates a straight path from `start` to `goal` with the shorter rotation.
    pub(super) fn straight(start: &Isometry3<f64>, goal: &Isometry3<f64>) -> Self {
        let turn = goal.rotation * start.rotation.inverse();
        let translation_m = goal.translation.vector - start.translation.vector;
        Self { start: *start, rotation_rad: turn.scaled_axis(), course: Course::Straight { translation_m } }
    }

    /// Creates a path from `start` to `goal` about a pivot through which the tool slides. The pivot's
    /// position in the tool frame is interpolated linearly between start and goal.
    pub(super) fn about(start: &Isometry3<f64>, goal: &Isometry3<f64>, pivot_m: &Vector3<f64>) -> Self {
        let pivot = Point3::from(*pivot_m);
        let in_tool_m = start.inverse_transform_point(&pivot).coords;
        let shift_m = goal.inverse_transform_point(&pivot).coords - in_tool_m;
        let turn = goal.rotation * start.rotation.inverse();
        let course = Course::Pivot { pivot_m: *pivot_m, in_tool_m, shift_m };
        Self { start: *start, rotation_rad: turn.scaled_axis(), course }
    }

    /// Returns the tool base's pose at `parameter`, which may lie outside [0, 1].
    pub(super) fn pose(&self, parameter: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_scaled_axis(self.rotation_rad * parameter);
        let rotation = turn * self.start.rotation;
        let position = match &self.course {
            Course::Straight { translation_m } => self.start.translation.vector + translation_m * parameter,
            Course::Pivot { pivot_m, in_tool_m, shift_m } => {
                pivot_m - rotation * (in_tool_m + shift_m * parameter)
            }
        };
        Isometry3::from_parts(Translation3::from(position), rotation)
    }

    /// Returns the first and second derivative of the pose with respect to the parameter (linear m, angular
    /// rad; base axes).
    fn derivatives(&self, parameter: f64, pose: &Isometry3<f64>) -> (Vector6<f64>, Vector6<f64>) {
        let w = &self.rotation_rad;
        match &self.course {
            Course::Straight { translation_m } => (stack(translation_m, w), Vector6::zeros()),
            Course::Pivot { in_tool_m, shift_m, .. } => {
                let to_pivot = pose.rotation * (in_tool_m + shift_m * parameter);
                let shift = pose.rotation * shift_m;
                let first = -w.cross(&to_pivot) - shift;
                let second = -w.cross(&w.cross(&to_pivot)) - w.cross(&shift) * 2.0;
                (stack(&first, w), stack(&second, &Vector3::zeros()))
            }
        }
    }

    /// Returns the parameter at which this line, extended, reaches `goal`; `None` if it misses the goal or
    /// the path is not straight.
    pub(super) fn parameter_of(&self, goal: &Isometry3<f64>, now: f64) -> Option<f64> {
        let Course::Straight { translation_m } = &self.course else { return None };
        let here = self.pose(now);
        let ahead_m = goal.translation.vector - here.translation.vector;
        let ahead_rad = (goal.rotation * here.rotation.inverse()).scaled_axis();
        let length_squared = translation_m.norm_squared() + self.rotation_rad.norm_squared();
        let along = translation_m.dot(&ahead_m) + self.rotation_rad.dot(&ahead_rad);
        let step = along / length_squared;
        let missed_m = (ahead_m - translation_m * step).norm();
        let missed_rad = (ahead_rad - self.rotation_rad * step).norm();
        (missed_m <= SAME_LINE_TOLERANCE && missed_rad <= SAME_LINE_TOLERANCE).then_some(now + step)
    }
}

/// Joint angles on a path, with their first and second derivatives with respect to the path parameter.
#[derive(Clone, Copy, Debug)]
pub(super) struct JointsOnPath {
    pub(super) q_rad: Joints,
    pub(super) first: Joints,
    pub(super) second: Joints,
    pub(super) frames: LinkFrames,
    /// Derivatives of the tool base's origin with respect to the path parameter, m.
    origin_m: [Vector3<f64>; 2],
}

/// The properties of the arm that path following needs.
#[derive(Clone, Copy)]
pub(super) struct PathFollower<'a> {
    pub(super) geometry: &'a ArmGeometry,
    pub(super) joint_limits: &'a JointLimits,
    pub(super) cartesian_limits: &'a CartesianLimits,
}

impl PathFollower<'_> {
    /// Returns the joint angles that put the tool's base exactly on the path, in the branch nearest to
    /// `q_near_rad`. With seven joints, the redundant one keeps its angle from `q_near_rad`.
    pub(super) fn joints_at(
        &self,
        path: &Path,
        parameter: f64,
        q_near_rad: &Joints,
    ) -> Result<JointsOnPath, KinematicsError> {
        let limits = self.joint_limits;
        let pose = path.pose(parameter);
        let [lower_rad, upper_rad] = [&limits.lower_rad, &limits.upper_rad];
        let q_rad =
            self.geometry.inverse_nearest(&pose, q_near_rad, lower_rad, upper_rad, Redundancy::Held)?;
        let frames = self.geometry.frames(&q_rad);
        let (jacobian, held) = (self.geometry.jacobian(&frames), self.geometry.held_joint());
        let singular = self.geometry.singular(&q_rad);
        let (twist, curve) = path.derivatives(parameter, &pose);
        let first = solve_rates(&jacobian, held, &twist).ok_or(singular)?;
        let second =
            solve_rates(&jacobian, held, &(curve - self.geometry.bias_acceleration(&frames, &first)))
                .ok_or(singular)?;
        let origin_m = [&twist, &curve].map(|derivative| derivative.fixed_rows::<3>(0).into_owned());
        Ok(JointsOnPath { q_rad, first, second, frames, origin_m })
    }

    /// Checks a section of the path, rejects it if the arm cannot follow it, and returns limits on the path
    /// parameter that keep the tool base within its limits and `speed`, and the joints within theirs.
    ///
    /// With q(s(t)): q̇ = q' ṡ, q̈ = q' s̈ + q'' ṡ², q⃛ = q' s⃛ + 3 q'' ṡ s̈ + q''' ṡ³. Each joint's
    /// acceleration limit is split evenly between its two terms, its jerk limit among its three; the same
    /// goes for the tool base's origin on a curved path. q''' is a finite difference of q''.
    pub(super) fn limits_along(
        &self,
        path: &Path,
        stretch: Stretch,
        q_start_rad: &Joints,
        speed: PathSpeed,
    ) -> Result<AxisLimits<1>, ArmError> {
        let bend = self.bend_along(path, stretch, q_start_rad)?;
        let ([length_m, curve_m, twist_m], angle_rad) = (bend.origin_m, path.rotation_rad.norm());
        let c = self.cartesian_limits;
        let (half, third) = if curve_m > 0.0 { (0.5, 1.0 / 3.0) } else { (1.0, 1.0) };
        let cap =
            |ceiling: f64, linear: f64, angular: f64| ceiling.min(linear / length_m).min(angular / angle_rad);
        let mut velocity = cap(PARAMETER_CEILING[0], speed.linear_m_s, speed.angular_rad_s)
            .min(libm::sqrt(half * c.acceleration_m_s2 / curve_m))
            .min(libm::cbrt(third * c.jerk_m_s3 / twist_m));
        let mut acceleration =
            cap(PARAMETER_CEILING[1], half * c.acceleration_m_s2, c.angular_acceleration_rad_s2);
        let mut jerk = cap(PARAMETER_CEILING[2], third * c.jerk_m_s3, c.angular_jerk_rad_s3);
        let j = self.joint_limits;
        // A gantry's axes have the limits of the tool base, which are already satisfied.
        let joints = self.geometry.joints();
        for i in 0..joints {
            velocity = velocity
                .min(j.velocity_rad_s[i] / bend.first[i])
                .min(libm::sqrt(0.5 * j.acceleration_rad_s2[i] / bend.second[i]))
                .min(libm::cbrt(j.jerk_rad_s3[i] / (3.0 * bend.third[i])));
            acceleration = acceleration.min(0.5 * j.acceleration_rad_s2[i] / bend.first[i]);
            jerk = jerk.min(j.jerk_rad_s3[i] / (3.0 * bend.first[i]));
        }
        for i in 0..joints {
            acceleration = acceleration.min(j.jerk_rad_s3[i] / (9.0 * bend.second[i] * velocity));
        }
        acceleration = acceleration.min(c.jerk_m_s3 / (9.0 * curve_m * velocity));
        Ok(AxisLimits { velocity: [velocity], acceleration: [acceleration], jerk: [jerk] })
    }

    /// Returns the maximum derivatives of the joint angles and of the tool base's origin along the path.
    fn bend_along(&self, path: &Path, stretch: Stretch, q_start_rad: &Joints) -> Result<Bend, ArmError> {
        let Stretch { from, to } = stretch;
        let step = (to - from) / PATH_INTERVALS as f64;
        let branch = self.geometry.branch(q_start_rad);
        let mut bend = Bend::default();
        let mut previous: Option<JointsOnPath> = None;
        for sample in 0..=PATH_INTERVALS {
            let fraction = sample as f64 / PATH_INTERVALS as f64;
            let near = previous.map_or(*q_start_rad, |p| p.q_rad);
            let here = self
                .joints_at(path, from + (to - from) * fraction, &near)
                .map_err(|reason| ArmError::PathUnreachable { fraction, reason })?;
            let manipulability_m3 = self.geometry.manipulability_on_path_m3(&here.q_rad);
            if self.geometry.turns() && manipulability_m3 < LEAST_MANIPULABILITY_M3 {
                return Err(ArmError::PathSingular { fraction, manipulability_m3 });
            }
            if self.geometry.branch(&here.q_rad) != branch
                || previous.is_some_and(|p| !p.predicts(&here, step))
            {
                return Err(ArmError::PathJumps { fraction });
            }
            bend.include(&here, previous.as_ref(), step);
            previous = Some(here);
        }
        Ok(bend)
    }
}

impl JointsOnPath {
    /// Returns true if the mean of both slopes over `step` predicts `next`.
    fn predicts(&self, next: &Self, step: f64) -> bool {
        (0..MAX_ARM_JOINTS).all(|i| {
            let predicted = self.q_rad[i] + 0.5 * step * (self.first[i] + next.first[i]);
            (next.q_rad[i] - predicted).abs() <= PREDICTION_TOLERANCE_RAD
        })
    }
}

/// Maximum absolute derivatives with respect to the path parameter.
#[derive(Default)]
struct Bend {
    first: Joints,
    second: Joints,
    third: Joints,
    /// First, second and third derivative of the tool base's origin.
    origin_m: [f64; 3],
}

impl Bend {
    fn include(&mut self, here: &JointsOnPath, previous: Option<&JointsOnPath>, step: f64) {
        for (greatest, derivative) in self.origin_m.iter_mut().zip(&here.origin_m) {
            *greatest = greatest.max(derivative.norm());
        }
        for i in 0..MAX_ARM_JOINTS {
            self.first[i] = self.first[i].max(here.first[i].abs());
            self.second[i] = self.second[i].max(here.second[i].abs());
        }
        let Some(previous) = previous.filter(|_| step != 0.0) else { return };
        let third_m = (here.origin_m[1] - previous.origin_m[1]).norm() / step.abs();
        self.origin_m[2] = self.origin_m[2].max(third_m);
        for i in 0..MAX_ARM_JOINTS {
            let third = (here.second[i] - previous.second[i]) / step;
            self.third[i] = self.third[i].max(third.abs());
        }
    }
}
