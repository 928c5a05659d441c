//! What the rows of the contact solver are made of: a contact's directions, the targets of contacts and joint
//! stops.

use nalgebra::Vector3;

use super::parameters::ManipulatorParameters;

/// A flexure enters the solver if the free step would take it beyond this fraction of its stop.
const STOP_SHARE: f64 = 0.9;
/// Maximum return rate of a flexure that is past its stop, rad/s.
const STOP_RETURN_RAD_PER_S: f64 = 5.0;

/// The two stops of a flexure, at plus and minus the same angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct StopLaw {
    pub limit_rad: f64,
    pub stiffness_nm_per_rad: f64,
}

impl StopLaw {
    /// The stop that a free step of `dt` s approaches, for a flexure at `q_rad` turning at `rate_rad_per_s`;
    /// `last_nm` is its stop torque in the last step.
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

    /// Velocity toward the free range that the stop on side `sign` requires after carrying `last_nm`, rad/s.
    pub fn target(&self, dt: f64, sign: f64, q_rad: f64, last_nm: f64) -> f64 {
        let explained = last_nm / self.stiffness_nm_per_rad;
        target(self.limit_rad + sign * q_rad, explained, STOP_RETURN_RAD_PER_S, dt)
    }
}

impl ManipulatorParameters {
    /// The flexures' stops.
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
    /// 1 / (k dt^2).
    pub compliance: f64,
    /// Lower bound for rate toward the free range + compliance * impulse, rad/s.
    pub target: f64,
    /// N m s.
    pub impulse: f64,
}

/// Target velocity of a unilateral row: the whole gap may close within the step. Overlap that the last force
/// explains stays; the rest is pushed out at `fastest` at most.
pub(super) fn target(gap: f64, explained: f64, fastest: f64, dt: f64) -> f64 {
    if gap >= 0.0 { -gap / dt } else { explained / dt + ((-gap - explained) / dt).min(fastest) }
}

/// Two unit tangents, the first in the bending plane unless the normal is nearly perpendicular to it.
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
