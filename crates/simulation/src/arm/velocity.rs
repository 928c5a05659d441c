//! `servo_jv`: moves joints at given rates and stops each one in time at the end of its range.

use super::gantry::AXES;
use super::kinematics::Joints;
use super::motion::{JointMotion, Motion};
use super::trajectory::{AxisState, Goal, Segment};
use super::{Arm, ArmError, ArmGeometry};
use messages::MAX_ARM_JOINTS;

/// Amount by which rounding may push a joint beyond its range.
const RANGE_SLACK_RAD: f64 = 1e-9;

impl Arm {
    pub(super) fn turn_joints(&mut self, qd_rad_s: &Joints) -> Result<(), ArmError> {
        self.parameters.check_absent(qd_rad_s)?;
        let limits = self.parameters.joint_limits.velocity_rad_s;
        for (i, (&given_rad_s, &maximum_rad_s)) in qd_rad_s.iter().zip(&limits).enumerate() {
            // NaN is in no range, so this rejects it too.
            if !(-maximum_rad_s..=maximum_rad_s).contains(&given_rad_s) {
                return Err(ArmError::JointRateOutsideLimits { joint: i + 1, given_rad_s, maximum_rad_s });
            }
        }
        self.check_stop()?;
        let motion = self.plan_rates(qd_rad_s)?;
        self.motion = Motion::Joint(motion);
        Ok(())
    }

    /// Rejects a switch from a path to joint space if a joint could not stop within its range.
    pub(super) fn check_stop(&self) -> Result<(), ArmError> {
        let now = self.joint_state();
        (0..MAX_ARM_JOINTS)
            .try_for_each(|i| if self.overruns(&now, i) { Err(self.range_ends(i)) } else { Ok(()) })
    }

    /// Advances one tick at the given rates. A joint that could no longer stop in time after this tick starts
    /// its stop now.
    pub(super) fn step_rates(&mut self, mut motion: JointMotion, mut rates: Joints) {
        motion.tick += 1;
        let next = self.at_rates(&motion, &rates);
        let ends: [bool; MAX_ARM_JOINTS] =
            std::array::from_fn(|i| rates[i] != 0.0 && self.overruns(&next, i));
        let Some(first) = ends.iter().position(|ends| *ends) else {
            self.publish(&self.parameters.geometry.frames(&next.position), &next);
            self.motion = Motion::Joint(motion);
            return;
        };
        rates = std::array::from_fn(|i| if ends[i] { 0.0 } else { rates[i] });
        match self.plan_rates(&rates) {
            Ok(motion) => {
                self.state.fault = Some(self.range_ends(first));
                self.step_joints(motion);
            }
            Err(error) => self.give_up(error),
        }
    }

    fn plan_rates(&mut self, rates: &Joints) -> Result<JointMotion, ArmError> {
        let goal = if *rates == Joints::default() { Goal::Standstill } else { Goal::Velocity(*rates) };
        let segment = Segment { start: self.joint_state(), goal, limits: self.joint_axis_limits(1.0) };
        let duration_s = self.joint_planner.plan(&segment)?;
        self.joint_planner.commit();
        Ok(JointMotion { segment, duration_s, tick: 0, next: None })
    }

    /// Returns the joints at the motion's tick: on the plan until its end, then at constant rates.
    fn at_rates(&self, motion: &JointMotion, rates: &Joints) -> AxisState<MAX_ARM_JOINTS> {
        let time_s = self.time_s(motion.tick);
        let mut joints = self.joint_planner.sample(time_s);
        let beyond_s = time_s - motion.duration_s;
        if beyond_s > 0.0 {
            for (position, rate) in joints.position.iter_mut().zip(rates) {
                *position += rate * beyond_s;
            }
            (joints.velocity, joints.acceleration) = (*rates, Joints::default());
        }
        joints
    }

    /// Returns true if joint `i` leaves its range even when it stops from here in minimum time.
    fn overruns(&self, joints: &AxisState<MAX_ARM_JOINTS>, i: usize) -> bool {
        let limits = &self.parameters.joint_limits;
        let (least, most) = stop_range(
            joints.velocity[i],
            joints.acceleration[i],
            limits.acceleration_rad_s2[i],
            limits.jerk_rad_s3[i],
        );
        let position = joints.position[i];
        position + least < limits.lower_rad[i] - RANGE_SLACK_RAD
            || position + most > limits.upper_rad[i] + RANGE_SLACK_RAD
    }

    fn range_ends(&self, i: usize) -> ArmError {
        let limits = &self.parameters.joint_limits;
        let (lower_rad, upper_rad) = (limits.lower_rad[i], limits.upper_rad[i]);
        match (&self.parameters.geometry, AXES.get(i)) {
            (ArmGeometry::Gantry(_), Some(&axis)) => {
                ArmError::TravelEnds { axis, lower_m: lower_rad, upper_m: upper_rad }
            }
            _ => ArmError::JointRangeEnds { joint: i + 1, lower_rad, upper_rad },
        }
    }
}

/// Returns the minimum and maximum displacement of an axis that stops from velocity `v` and acceleration `a`
/// in minimum time within its acceleration and jerk limits.
///
/// The profile has jerk -j, possibly constant deceleration, then jerk +j (signs for a positive velocity).
/// With peak deceleration p these phases reduce the velocity by (p² - a²)/2j, p T and p²/2j, which add up to
/// v.
fn stop_range(v: f64, a: f64, most_a: f64, j: f64) -> (f64, f64) {
    // The sign of the velocity that would result from just ramping the acceleration to zero.
    let sign = if v + a * a.abs() / (2.0 * j) < 0.0 { -1.0 } else { 1.0 };
    let (v, a) = (sign * v, sign * a);
    let triangle = libm::sqrt((j * v + 0.5 * a * a).max(0.0));
    let peak = triangle.min(most_a).max(-a);
    let constant_s = if peak > 0.0 { ((v + 0.5 * (a * a) / j) / peak - peak / j).max(0.0) } else { 0.0 };
    let first_s = ((a + peak) / j).max(0.0);
    let at = |t: f64| t * (v + t * (0.5 * a - t * j / 6.0));
    let first_m = at(first_s);
    let v1 = v + first_s * (a - 0.5 * j * first_s);
    let constant_m = constant_s * (v1 - 0.5 * peak * constant_s);
    let v2 = v1 - peak * constant_s;
    let last_s = peak / j;
    let end = first_m + constant_m + last_s * (v2 - 0.5 * peak * last_s + j * last_s * last_s / 6.0);
    // Turning points of the first phase: v + a t - j t²/2 = 0.
    let root = libm::sqrt((a * a + 2.0 * j * v).max(0.0));
    let turns = [(a - root) / j, (a + root) / j].map(|t| at(t.clamp(0.0, first_s)));
    let least = turns.into_iter().fold(end.min(0.0), f64::min);
    let most = turns.into_iter().fold(end.max(0.0), f64::max);
    if sign > 0.0 { (least, most) } else { (-most, -least) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arm::{AxisLimits, Planner};

    /// The stopping range agrees with Ruckig's own stop, sampled at 400 points: the end within 1e-9, the
    /// extremes within the sample spacing.
    #[test]
    fn the_stopping_range_is_that_of_ruckig() {
        let mut planner = Planner::<1>::new();
        let mut seed = 1u64;
        let mut uniform = |low: f64, high: f64| {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            low + (high - low) * (seed >> 11) as f64 / (1u64 << 53) as f64
        };
        let (mut worst_inside, mut worst_outside) = (0.0f64, 0.0f64);
        for _ in 0..3_000 {
            let (most_a, j) = (uniform(1.0, 8.0), uniform(10.0, 100.0));
            let (v, a) = (uniform(-3.0, 3.0) * uniform(0.0, 1.0), uniform(-1.0, 1.0) * most_a);
            let start = AxisState { position: [0.0], velocity: [v], acceleration: [a] };
            let limits = AxisLimits { velocity: [10.0], acceleration: [most_a], jerk: [j] };
            let segment = Segment { start, goal: Goal::Standstill, limits };
            let duration_s = planner.plan(&segment).unwrap();
            let (least, most) = stop_range(v, a, most_a, j);
            let (mut low, mut high) = (0.0f64, 0.0f64);
            for k in 0..=400 {
                let x = planner.sample_candidate(duration_s * f64::from(k) / 400.0).position[0];
                (low, high) = (low.min(x), high.max(x));
            }
            worst_outside = worst_outside.max(least - low).max(high - most);
            worst_inside = worst_inside.max(low - least).max(most - high);
        }
        println!("Ruckig's stop leaves the range by {worst_outside:.1e}, fills it to {worst_inside:.1e}");
        assert!(worst_outside < 1e-9);
        // Error between two samples of a stop lasting at most about a second: (T/400)²/8 times 8 rad/s².
        assert!(worst_inside < 2e-5);
    }
}
