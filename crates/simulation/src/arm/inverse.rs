//! Analytic inverse kinematics of the Universal Robots arms: up to eight branches.
//!
//! The derivation follows Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms"
//! (2013): shoulder left or right, wrist up or down, elbow up or down.

use super::kinematics::{Joints, UrGeometry};
use nalgebra::{Isometry3, Vector3};
use std::f64::consts::{FRAC_PI_2, TAU};
use thiserror::Error;

/// `|sin q5|` below which wrist 3 is undefined: rounding would decide its angle.
const WRIST_SINGULAR_SIN: f64 = 1e-7;

/// Amount by which rounding may push a cosine past 1 before a pose counts as out of reach (2e-10 rad² of
/// joint angle).
const COSINE_SLACK: f64 = 1e-10;

/// Why a pose of the tool's base has no inverse kinematics solution.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum KinematicsError {
    /// The pose has a NaN or infinite component, or its quaternion is not of unit length.
    #[error("invalid pose: a number is not finite, or the quaternion is not of length 1")]
    InvalidPose,
    /// The wrist would be inside the unreachable cylinder around the base axis.
    #[error(
        "too close to the base axis: the wrist would be {distance_m} m from it; allowed: at least \
         {minimum_m} m; move the goal or the arm base"
    )]
    TooCloseToBase {
        /// Distance of wrist 2 from the base axis.
        distance_m: f64,
        /// The smallest possible distance (d4).
        minimum_m: f64,
    },
    /// The wrist would be too far from the shoulder, or too close to it.
    #[error(
        "out of reach: the wrist would be {distance_m} m from the shoulder; allowed: {minimum_m} to \
         {maximum_m} m; move the goal or the arm base"
    )]
    OutOfReach {
        /// Distance of wrist 1 from the shoulder in the arm's plane, for the branch with the smallest miss.
        distance_m: f64,
        /// Distance with the arm folded, `||a2| - |a3||`.
        minimum_m: f64,
        /// Distance with the arm stretched, `|a2| + |a3|`.
        maximum_m: f64,
    },
    /// Wrists 1 and 3 turn about the same line: there are infinitely many solutions.
    #[error(
        "wrist singularity: |sin q5| = {sin_q5}; allowed: at least {minimum}; \
         tilt the goal or use a joint command"
    )]
    WristSingular {
        /// |sin q5| at the goal.
        sin_q5: f64,
        /// The smallest accepted value.
        minimum: f64,
    },
    /// The joint axes are dependent: no joint rates move the tool base along the path.
    #[error("singularity: the joints cannot move the tool in every direction there; move the goal")]
    Singular,
    /// The numeric inverse found no joint angles within the limits.
    #[error(
        "no solution within the joint limits: the closest misses the pose by {missed_m} m and {missed_rad} \
         rad; move the goal or the arm base"
    )]
    NotReached {
        /// Distance of the tool base from the goal.
        missed_m: f64,
        /// Approximate angle between the two orientations.
        missed_rad: f64,
    },
    /// The goal rotates the tool, which a gantry cannot.
    #[error(
        "the pose is rotated by {turned_rad} rad, but a gantry keeps the tool's orientation (within \
         {allowed_rad} rad); send the orientation of `State.t_world_base`, or choose another `arm.model`"
    )]
    Turned {
        /// Angle between the goal and the tool.
        turned_rad: f64,
        /// The largest accepted angle.
        allowed_rad: f64,
    },
    /// The goal is beyond the travel of a gantry axis.
    #[error(
        "gantry axis {axis} out of range: {given_m} m, its travel is {lower_m} to {upper_m} m from the \
         start; move the goal, or increase `arm.travel_mm`"
    )]
    BeyondTravel {
        /// The axis.
        axis: char,
        /// Its required position.
        given_m: f64,
        /// Lower end of its travel.
        lower_m: f64,
        /// Upper end of its travel.
        upper_m: f64,
    },
    /// The scene has no arm.
    #[error("no arm to move the tool (`arm.model` is \"fixed\"); choose another `arm.model`")]
    NoJoints,
    /// Every branch violates a joint limit.
    #[error("all {branches} solutions for the pose violate the joint limits; move the goal or the arm base")]
    OutsideJointLimits {
        /// Number of solutions tried.
        branches: usize,
    },
}

/// The solutions for one pose, each joint in (-2 pi, 2 pi).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InverseSolutions {
    q_rad: [Joints; 8],
    count: usize,
    /// Shoulder angle and |sin q5| of a shoulder branch that has no solution because its wrist is singular.
    wrist_singular: Option<(f64, f64)>,
}

impl InverseSolutions {
    /// Returns the solutions in fixed branch order (shoulder, wrist, elbow).
    pub fn as_slice(&self) -> &[Joints] {
        &self.q_rad[..self.count]
    }
}

impl UrGeometry {
    /// Returns all analytic solutions (2 to 8) for the tool's base at `t_base_tool`. Omits a shoulder branch
    /// whose wrist is singular.
    pub fn inverse(&self, t_base_tool: &Isometry3<f64>) -> Result<InverseSolutions, KinematicsError> {
        check_pose(t_base_tool)?;
        let t_base_flange = match &self.t_flange_tool {
            Some(tool) => t_base_tool * tool.inverse(),
            None => *t_base_tool,
        };
        let flange = FlangeAxes::new(&t_base_flange, self.d6_m);
        let radius_m = libm::hypot(flange.wrist_m.x, flange.wrist_m.y);
        if radius_m < self.d4_m {
            return Err(KinematicsError::TooCloseToBase { distance_m: radius_m, minimum_m: self.d4_m });
        }
        // The wrist offset d4 along the shoulder axis (sin q1, -cos q1, 0) determines q1.
        let direction = libm::atan2(flange.wrist_m.y, flange.wrist_m.x) + FRAC_PI_2;
        let half_angle = libm::acos(self.d4_m / radius_m);
        let mut found = InverseSolutions { q_rad: [Joints::default(); 8], count: 0, wrist_singular: None };
        let mut reach = ClosestMiss::default();
        for q1 in [direction + half_angle, direction - half_angle] {
            self.solve_wrist(&flange, q1, &mut found, &mut reach);
        }
        match (found.count, found.wrist_singular) {
            (0, Some((_, sin_q5))) => {
                Err(KinematicsError::WristSingular { sin_q5, minimum: WRIST_SINGULAR_SIN })
            }
            (0, None) => Err(reach.into_error(self)),
            _ => Ok(found),
        }
    }

    /// Returns the solution within the limits that is closest to `q_reference_rad` (least sum of squared
    /// joint differences, in radians). Unwraps every joint by whole turns toward the reference. Rejects the
    /// pose as singular if the wrist is singular in the shoulder branch closer to the reference, because the
    /// other shoulder's solutions would flip the arm.
    pub fn inverse_nearest(
        &self,
        t_base_tool: &Isometry3<f64>,
        q_reference_rad: &Joints,
        lower_rad: &Joints,
        upper_rad: &Joints,
    ) -> Result<Joints, KinematicsError> {
        let solutions = self.inverse(t_base_tool)?;
        let mut best: Option<(f64, Joints)> = None;
        for solution in solutions.as_slice() {
            let Some(q) = unwrap_towards(solution, q_reference_rad, lower_rad, upper_rad) else { continue };
            let distance: f64 =
                (0..q.len()).map(|i| (q[i] - q_reference_rad[i]) * (q[i] - q_reference_rad[i])).sum();
            if best.is_none_or(|(least, _)| distance < least) {
                best = Some((distance, q));
            }
        }
        let (_, q) = best.ok_or(KinematicsError::OutsideJointLimits { branches: solutions.count })?;
        let turn_to = |q1: f64| libm::remainder(q1 - q_reference_rad[0], TAU).abs();
        match solutions.wrist_singular {
            Some((q1, sin_q5)) if turn_to(q1) < turn_to(q[0]) => {
                Err(KinematicsError::WristSingular { sin_q5, minimum: WRIST_SINGULAR_SIN })
            }
            _ => Ok(q),
        }
    }

    /// Solves the two wrist branches of one shoulder branch.
    fn solve_wrist(
        &self,
        flange: &FlangeAxes,
        q1: f64,
        found: &mut InverseSolutions,
        miss: &mut ClosestMiss,
    ) {
        let (sin1, cos1) = libm::sincos(q1);
        // The shoulder axis in the flange frame is (sin q5 cos q6, -sin q5 sin q6, cos q5).
        let shoulder_axis = Vector3::new(sin1, -cos1, 0.0);
        let (along_x, along_y, along_z) =
            (shoulder_axis.dot(&flange.x), shoulder_axis.dot(&flange.y), shoulder_axis.dot(&flange.z));
        let sin5 = libm::hypot(along_x, along_y);
        if sin5 < WRIST_SINGULAR_SIN {
            found.wrist_singular = Some((q1, sin5));
            return;
        }
        for sign in [1.0, -1.0] {
            let q5 = libm::atan2(sign * sin5, along_z);
            let q6 = libm::atan2(-sign * along_y, sign * along_x);
            let (sin6, cos6) = libm::sincos(q6);
            // Axis of wrist 2, which lies in the arm's plane.
            let wrist2_axis = -(flange.x * sin6 + flange.y * cos6);
            let elbow_target = flange.wrist_m - wrist2_axis * self.d5_m;
            let plane_x = Vector3::new(cos1, sin1, 0.0);
            let plane = [elbow_target.dot(&plane_x), elbow_target.z - self.d1_m];
            let q234 = libm::atan2(wrist2_axis.dot(&plane_x), -wrist2_axis.z);
            self.solve_elbow(plane, q234, [q1, q5, q6], found, miss);
        }
    }

    /// Solves the two elbow branches of one wrist branch: planar two-link inverse kinematics for `plane` (m,
    /// shoulder at the origin).
    fn solve_elbow(
        &self,
        plane: [f64; 2],
        q234: f64,
        [q1, q5, q6]: [f64; 3],
        found: &mut InverseSolutions,
        miss: &mut ClosestMiss,
    ) {
        let (a2, a3) = (self.a2_m, self.a3_m);
        let distance_squared = plane[0] * plane[0] + plane[1] * plane[1];
        let cos3 = (distance_squared - a2 * a2 - a3 * a3) / (2.0 * a2 * a3);
        if cos3.abs() > 1.0 + COSINE_SLACK {
            miss.record(cos3.abs(), distance_squared.sqrt());
            return;
        }
        let elbow = libm::acos(cos3.clamp(-1.0, 1.0));
        for q3 in [elbow, -elbow] {
            let (sin3, cos3) = libm::sincos(q3);
            let q2 = libm::atan2(plane[1], plane[0]) - libm::atan2(a3 * sin3, a2 + a3 * cos3);
            let q = [q1, q2, q3, q234 - q2 - q3, q5, q6, 0.0];
            found.q_rad[found.count] = q.map(|angle| libm::remainder(angle, TAU));
            found.count += 1;
        }
    }
}

/// The flange's axes and the intersection of wrist axes 2 and 3, in the base frame.
struct FlangeAxes {
    x: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
    wrist_m: Vector3<f64>,
}

impl FlangeAxes {
    fn new(t_base_flange: &Isometry3<f64>, d6_m: f64) -> Self {
        let rotation = t_base_flange.rotation.to_rotation_matrix();
        let axis = |i| rotation.matrix().column(i).into_owned();
        let z: Vector3<f64> = axis(2);
        Self { x: axis(0), y: axis(1), z, wrist_m: t_base_flange.translation.vector - z * d6_m }
    }
}

/// |cos q3| and distance (m) of the branch with the smallest miss.
#[derive(Default)]
struct ClosestMiss(Option<(f64, f64)>);

impl ClosestMiss {
    fn record(&mut self, cosine: f64, distance_m: f64) {
        if self.0.is_none_or(|(least, _)| cosine < least) {
            self.0 = Some((cosine, distance_m));
        }
    }

    fn into_error(self, geometry: &UrGeometry) -> KinematicsError {
        let (upper, fore) = (geometry.a2_m.abs(), geometry.a3_m.abs());
        KinematicsError::OutOfReach {
            distance_m: self.0.map_or(f64::NAN, |(_, distance)| distance),
            minimum_m: (upper - fore).abs(),
            maximum_m: upper + fore,
        }
    }
}

/// Rejects a pose with a non-finite component or a quaternion whose length is off by more than 1e-6.
pub(super) fn check_pose(pose: &Isometry3<f64>) -> Result<(), KinematicsError> {
    let finite = pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|x| x.is_finite());
    if finite && (pose.rotation.coords.norm() - 1.0).abs() < 1e-6 {
        Ok(())
    } else {
        Err(KinematicsError::InvalidPose)
    }
}

/// Returns `q` plus whole turns, each joint as close to the reference as its limits allow; `None` if a joint
/// has no such angle.
fn unwrap_towards(q: &Joints, reference: &Joints, lower: &Joints, upper: &Joints) -> Option<Joints> {
    let mut unwrapped = *q;
    for i in 0..q.len() {
        let turns = libm::rint((reference[i] - q[i]) / TAU);
        let nearest = [turns, turns - 1.0, turns + 1.0].map(|n| q[i] + n * TAU);
        unwrapped[i] = nearest.into_iter().find(|angle| (lower[i]..=upper[i]).contains(angle))?;
    }
    Some(unwrapped)
}
