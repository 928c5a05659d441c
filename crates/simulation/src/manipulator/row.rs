//! Ingredients of the contact solver's rows: contact directions, and targets of contacts and joint stops.

use nalgebra::Vector3;

use super::parameters::ManipulatorParameters;

/// Fraction of its stop beyond which the free step must take a flexure for the stop to enter the solver.
const STOP_SHARE: f64 = 0.9;
/// Maximum return rate of a flexure past its stop, rad/s.
const STOP_RETURN_RAD_PER_S: f64 = 5.0;

/// The two stops of a flexure, at plus and minus the same angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct StopLaw {
    pub limit_rad: f64,
    pub stiffness_nm_per_rad: f64,
}

impl StopLaw {
    /// Returns the stop that a free step of `dt` s approaches, for a flexure at `q_rad` turning at
    /// `rate_rad_per_s`; `last_nm` is its stop torque in the last step.
    pub fn near(&self, dt: f64, q_rad: f64, rate_rad_per_s: f64, last_nm: f64) -> Option<Stop> {
        let predicted = q_rad + dt * rate_rad_per_s;
        if predicted.abs().max(q_rad.abs()) <= STOP_SHARE * self.limit_rad {
            return None;
        }
        let sign = if predicted > 0.0 { -1.0 } else { 1.0 };
        let last = (sign * last_nm).max(0.0);
        Some(Stop {
            sign,
            compliance: 1.0 / (self.stiffness_nm_per_rad * dt * dt),
            target: self.target(dt, sign, q_rad, last),
            impulse: last * dt,
        })
    }

    /// Returns the velocity toward the free range that the stop on side `sign` requires after carrying
    /// `last_nm`, rad/s.
    pub fn target(&self, dt: f64, sign: f64, q_rad: f64, last_nm: f64) -> f64 {
        let explained = last_nm / self.stiffness_nm_per_rad;
        target(self.limit_rad + sign * q_rad, explained, STOP_RETURN_RAD_PER_S, dt)
    }
}

impl ManipulatorParameters {
    /// Returns the flexures' stops.
    pub(super) fn stop_law(&self) -> StopLaw {
        StopLaw {
            limit_rad: self.joint_limit_rad,
            stiffness_nm_per_rad: self.joint_stop_stiffness_nm_per_rad,
        }
    }
}

/// One joint stop: `sign` is +1 at the lower stop and -1 at the upper.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stop {
    pub sign: f64,
    /// Compliance, 1 / (k dt^2).
    pub compliance: f64,
    /// Lower bound for rate toward the free range + compliance * impulse, rad/s.
    pub target: f64,
    /// Impulse, N m s.
    pub impulse: f64,
}

/// Returns the target velocity of a unilateral row: the whole gap may close within the step. Overlap
/// explained by the last force remains; the rest is pushed out at `fastest` at most.
pub(super) fn target(gap: f64, explained: f64, fastest: f64, dt: f64) -> f64 {
    if gap >= 0.0 { -gap / dt } else { explained / dt + ((-gap - explained) / dt).min(fastest) }
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
