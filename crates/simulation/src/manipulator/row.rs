//! Ingredients of the contact solver's rows: contact directions, and targets of contacts and joint stops.

use nalgebra::Vector3;

use super::parameters::ManipulatorParameters;

/// Fraction of its stop beyond which the free step must take a flexure for the stop to enter the solver.
const STOP_SHARE: f64 = 0.9;
/// Maximum return rate of a flexure past its stop, rad/s.
const STOP_RETURN_RAD_PER_S: f64 = 5.0;

/// Overlap up to which a stop has its stiffness, rad (0.05 degrees): asperities and the rounded edges of a
/// notch give way. Then its faces are in contact.
const SOFT_STOP_RAD: f64 = 0.05 * core::f64::consts::PI / 180.0;
/// Stiffness of a notch whose faces are in contact, relative to that of its stop. An assumption: stiff enough
/// that neither an impact nor a jam turns a flexure by another 0.05 degrees.
const HARD_STOP_RATIO: f64 = 100.0;

/// The two stops of a flexure, at plus and minus the same angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct StopLaw {
    pub limit_rad: f64,
    pub stiffness_nm_per_rad: f64,
    /// Overlap beyond which a stop is hard, rad.
    pub soft_rad: f64,
}

impl StopLaw {
    /// Returns the soft and the hard part of the stop that a free step of `dt` s approaches, for a flexure at
    /// `q_rad` turning at `rate_rad_per_s`; `last_nm` is its stop torque in the last step.
    pub fn near(&self, dt: f64, q_rad: f64, rate_rad_per_s: f64, last_nm: f64) -> [Option<Stop>; 2] {
        let predicted = q_rad + dt * rate_rad_per_s;
        let farthest = predicted.abs().max(q_rad.abs());
        if farthest <= STOP_SHARE * self.limit_rad {
            return [None; 2];
        }
        let [soft, hard] = self.side(dt, if predicted > 0.0 { -1.0 } else { 1.0 }, q_rad, last_nm);
        [Some(soft), (farthest > self.limit_rad).then_some(hard)]
    }

    /// Returns the soft and the hard part of the stop on one side, for a flexure at `q_rad` whose stops
    /// exerted `last_nm` in the last step.
    pub fn side(&self, dt: f64, sign: f64, q_rad: f64, last_nm: f64) -> [Stop; 2] {
        let last = (sign * last_nm).max(0.0);
        let soft = self.soft_nm(last);
        [(false, 0.0, 1.0, soft), (true, self.soft_rad, HARD_STOP_RATIO, last - soft)].map(
            |(is_hard, behind_rad, ratio, last)| {
                let stiffness = ratio * self.stiffness_nm_per_rad;
                let gap = self.limit_rad + behind_rad + sign * q_rad;
                Stop {
                    sign,
                    is_hard,
                    compliance: 1.0 / (stiffness * dt * dt),
                    target: target(gap, last / stiffness, STOP_RETURN_RAD_PER_S, dt),
                    push: push_out(gap, last / stiffness, STOP_RETURN_RAD_PER_S, dt),
                    impulse: last * dt,
                }
            },
        )
    }

    /// Returns the part of a torque that the soft part of a stop carries, N m.
    fn soft_nm(&self, torque_nm: f64) -> f64 {
        torque_nm.min(self.stiffness_nm_per_rad * self.soft_rad)
    }

    /// Returns the velocity toward the free range that the soft part of the stop on side `sign` requires
    /// after the stop carried `last_nm`, rad/s.
    pub fn target(&self, dt: f64, sign: f64, q_rad: f64, last_nm: f64) -> f64 {
        let explained = self.soft_nm(last_nm) / self.stiffness_nm_per_rad;
        target(self.limit_rad + sign * q_rad, explained, STOP_RETURN_RAD_PER_S, dt)
    }

    /// Returns the rate at which a flexure at `q_rad` ends at most 0.1 degrees past its stop, or no farther
    /// past it than it is: `rate_rad_per_s`, unless the solve with all stops has not converged.
    pub fn held(&self, dt: f64, q_rad: f64, rate_rad_per_s: f64) -> f64 {
        let end = q_rad + dt * rate_rad_per_s;
        let most = (self.limit_rad + 2.0 * self.soft_rad).max(q_rad.abs());
        if end.abs() > most { (most.copysign(end) - q_rad) / dt } else { rate_rad_per_s }
    }

    /// Returns the stiffness of a stop that exerts a torque, N m/rad.
    pub fn stiffness_at(&self, torque_nm: f64) -> f64 {
        match torque_nm.abs() {
            0.0 => 0.0,
            torque_nm if torque_nm > self.soft_nm(torque_nm) => {
                (1.0 + HARD_STOP_RATIO) * self.stiffness_nm_per_rad
            }
            _ => self.stiffness_nm_per_rad,
        }
    }

    /// Returns the elastic energy of a stop that exerts a torque, J.
    pub fn energy_j(&self, torque_nm: f64) -> f64 {
        let soft = self.soft_nm(torque_nm.abs());
        let hard = torque_nm.abs() - soft;
        0.5 * (soft * soft + hard * hard / HARD_STOP_RATIO) / self.stiffness_nm_per_rad
    }

    /// Returns true if a flexure ends in or behind the hard part of a stop that is not `listed` among the
    /// rows, from `q_rad` at the velocity `rate_rad_per_s`. `listed` is called with the side.
    pub fn is_passed(
        &self,
        dt: f64,
        q_rad: f64,
        rate_rad_per_s: f64,
        listed: impl FnOnce(f64) -> bool,
    ) -> bool {
        let end = q_rad + dt * rate_rad_per_s;
        end.abs() > self.limit_rad + self.soft_rad && !listed(-end.signum())
    }
}

impl ManipulatorParameters {
    /// Returns the flexures' stops.
    pub(super) fn stop_law(&self) -> StopLaw {
        StopLaw {
            limit_rad: self.joint_limit_rad,
            stiffness_nm_per_rad: self.joint_stop_stiffness_nm_per_rad,
            soft_rad: SOFT_STOP_RAD,
        }
    }
}

/// One part of a joint stop: `sign` is +1 at the lower stop and -1 at the upper.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stop {
    pub sign: f64,
    /// Whether this is the part behind the soft one.
    pub is_hard: bool,
    /// Compliance, 1 / (k dt^2).
    pub compliance: f64,
    /// Lower bound for rate toward the free range + compliance * impulse, rad/s.
    pub target: f64,
    /// Part of the target that pushes out overlap, rad/s.
    pub push: f64,
    /// Impulse, N m s.
    pub impulse: f64,
}

/// Returns the target velocity of a unilateral row: the whole gap may close within the step. Overlap
/// explained by the last force remains; the rest is pushed out at `fastest` at most.
pub(super) fn target(gap: f64, explained: f64, fastest: f64, dt: f64) -> f64 {
    if gap >= 0.0 { -gap / dt } else { explained / dt + unexplained(gap, explained, fastest, dt) }
}

/// Returns the part of [`target`] that pushes out overlap, at least 0.
pub(super) fn push_out(gap: f64, explained: f64, fastest: f64, dt: f64) -> f64 {
    if gap >= 0.0 { 0.0 } else { unexplained(gap, explained, fastest, dt).max(0.0) }
}

/// Returns the speed at which the part of an overlap recedes that the last impulse does not explain.
fn unexplained(gap: f64, explained: f64, fastest: f64, dt: f64) -> f64 {
    ((-gap - explained) / dt).min(fastest)
}

/// Returns two unit tangents, the first in the bending plane unless the normal is nearly perpendicular to it.
pub(super) fn tangents(normal: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let in_plane = libm::sqrt(normal.x * normal.x + normal.z * normal.z);
    let first = if in_plane > 0.1 {
        Vector3::new(normal.z / in_plane, 0.0, -normal.x / in_plane)
    } else {
        let t = Vector3::new(1.0 - normal.x * normal.x, -normal.x * normal.y, -normal.x * normal.z);
        t / libm::sqrt(t.norm_squared())
    };
    [first, normal.cross(&first)]
}
