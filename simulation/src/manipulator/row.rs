//! Rows of the contact solver: Coulomb's law for a contact, the unilateral law for a joint stop, each solved exactly.

use nalgebra::Vector3;

use super::parameters::ManipulatorParameters;

/// Newton iterations on the secular equation of one sliding contact.
const CONE_STEPS: usize = 8;

/// One contact in probe space. Directions have the components (omega_y, x, z, y).
#[derive(Debug, Clone, Copy)]
pub(super) struct Row {
    pub contact: usize,
    pub sphere: usize,
    pub probe: usize,
    pub friction: f64,
    pub normal: [f64; 4],
    pub tangent: [[f64; 4]; 2],
    /// Velocity of the contact point due to the base motion alone, along normal and tangents.
    pub drive: [f64; 3],
    /// 1 / (k_c dt^2).
    pub compliance: f64,
    /// Lower bound for normal velocity + compliance * impulse, m/s.
    pub target: f64,
    /// 1 / (R_nn + compliance).
    pub inverse: f64,
    /// Tangential mobility: 00 01 11.
    pub tangential: [f64; 3],
    /// Normal and tangential impulse, N s.
    pub impulse: [f64; 3],
    /// Shift of the secular equation, kept between sweeps.
    pub shift: f64,
    /// Impulse before the sweep.
    pub before: [f64; 3],
    /// Conjugate-gradient search direction.
    pub direction: [f64; 3],
}

pub(super) const EMPTY_ROW: Row = Row {
    contact: 0,
    sphere: 0,
    probe: 0,
    friction: 0.0,
    normal: [0.0; 4],
    tangent: [[0.0; 4]; 2],
    drive: [0.0; 3],
    compliance: 0.0,
    target: 0.0,
    inverse: 0.0,
    tangential: [0.0; 3],
    impulse: [0.0; 3],
    shift: 0.0,
    before: [0.0; 3],
    direction: [0.0; 3],
};

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
    /// The stop that a free step of `dt` s approaches, for a flexure at `q_rad` turning at `rate_rad_per_s`; `last_nm` is its stop torque
    /// in the last step.
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
            ..EMPTY_STOP
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
    pub compliance: f64,
    pub target: f64,
    pub inverse: f64,
    pub impulse: f64,
    pub before: f64,
    pub direction: f64,
}

pub(super) const EMPTY_STOP: Stop =
    Stop { sign: 1.0, compliance: 0.0, target: 0.0, inverse: 0.0, impulse: 0.0, before: 0.0, direction: 0.0 };

impl Row {
    /// Sets the directions from a normal in base axes; returns the two tangents.
    pub fn orient(&mut self, normal: &Vector3<f64>, radius_m: f64) -> [Vector3<f64>; 2] {
        let lever = normal * -radius_m;
        let tangents = tangents(normal);
        self.normal = [0.0, normal.x, normal.z, normal.y];
        self.tangent = tangents.map(|t| [t.x * lever.z - t.z * lever.x, t.x, t.z, t.y]);
        tangents
    }

    /// Probe impulse for normal and tangential impulses `p`.
    #[inline(always)]
    pub fn combined(&self, p: &[f64; 3]) -> [f64; 4] {
        let [t0, t1] = &self.tangent;
        [0, 1, 2, 3].map(|j| self.normal[j] * p[0] + t0[j] * p[1] + t1[j] * p[2])
    }

    /// Relaxes the contact at sphere velocity `local` (omega_y, x, z, y): the normal impulse first, then friction within its Coulomb
    /// cone. Raises `residual` to the largest velocity change.
    #[inline(always)]
    pub fn relax(&mut self, local: &[f64; 4], residual: &mut f64) {
        let velocity = dot4(&self.normal, local) + self.drive[0];
        let wanted = self.target - velocity - self.compliance * self.impulse[0];
        let normal = (self.impulse[0] + wanted * self.inverse).max(0.0);
        *residual = residual.max((normal - self.impulse[0]).abs() / self.inverse);
        self.impulse[0] = normal;
        let radius = self.friction * normal;
        if radius == 0.0 {
            self.impulse[1] = 0.0;
            self.impulse[2] = 0.0;
            return;
        }
        let [w00, w01, w11] = self.tangential;
        let old = [self.impulse[1], self.impulse[2]];
        let free = [
            dot4(&self.tangent[0], local) + self.drive[1] - w00 * old[0] - w01 * old[1],
            dot4(&self.tangent[1], local) + self.drive[2] - w01 * old[0] - w11 * old[1],
        ];
        let new = cone(&self.tangential, &free, radius, &mut self.shift);
        self.impulse[1] = new[0];
        self.impulse[2] = new[1];
        let change = [new[0] - old[0], new[1] - old[1]];
        *residual = residual.max((w00 * change[0]).abs()).max((w11 * change[1]).abs());
    }
}

impl Stop {
    /// Relaxes the stop at joint velocity `rate`; returns the change in joint impulse.
    #[inline(always)]
    pub fn relax(&mut self, rate: f64, residual: &mut f64) -> f64 {
        let velocity = self.sign * rate + self.compliance * self.impulse;
        let impulse = (self.impulse + (self.target - velocity) * self.inverse).max(0.0);
        let change = impulse - self.impulse;
        self.impulse = impulse;
        *residual = residual.max(change.abs() / self.inverse);
        self.sign * change
    }
}

/// Conjugate-gradient beta: the ratio of the squared gradients, 0 after a step that increased the gradient.
#[inline(always)]
pub(super) fn search_share(squared: f64, last: f64) -> f64 {
    if last > 0.0 && squared <= last { squared / last } else { 0.0 }
}

/// Extrapolates a value that a sweep changed from `before` along the search direction, and updates that direction.
#[inline(always)]
pub(super) fn search_on(share: f64, value: &mut f64, before: f64, direction: &mut f64) {
    let change = *value - before;
    *value += share * *direction;
    *direction = share * *direction + change;
}

/// 4-vector dot product in the order (omega, x, z, y).
#[inline(always)]
fn dot4(a: &[f64; 4], b: &[f64; 4]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
}

/// Target velocity of a unilateral row: the whole gap may close within the step. Overlap that the last force explains stays; the rest is
/// pushed out at `fastest` at most.
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

/// Coulomb's law for one contact: the impulse p with |p| <= radius such that v = free + W p vanishes, or |p| = radius and v opposes p. On
/// the circle, (W + shift 1) p = -free; Newton's method on 1/|p| finds the shift (More and Sorensen 1983, "Computing a trust region
/// step", SIAM J. Sci. Stat. Comput. 4(3), eq. 3.10).
#[inline(always)]
pub(super) fn cone(w: &[f64; 3], free: &[f64; 2], radius: f64, shift: &mut f64) -> [f64; 2] {
    let solve = |s: f64, b: &[f64; 2]| {
        let (a, d) = (w[0] + s, w[2] + s);
        let inverse = 1.0 / (a * d - w[1] * w[1]);
        [(d * b[0] - w[1] * b[1]) * inverse, (a * b[1] - w[1] * b[0]) * inverse]
    };
    let rhs = [-free[0], -free[1]];
    let stick = solve(0.0, &rhs);
    if stick[0] * stick[0] + stick[1] * stick[1] <= radius * radius {
        *shift = 0.0;
        return stick;
    }
    let mut s = *shift;
    let mut p = solve(s, &rhs);
    for _ in 0..CONE_STEPS {
        let squared = p[0] * p[0] + p[1] * p[1];
        let norm = libm::sqrt(squared);
        if (norm - radius).abs() <= 1e-9 * radius {
            break;
        }
        let q = solve(s, &p);
        let slope = p[0] * q[0] + p[1] * q[1];
        s = (s + squared / slope * (norm - radius) / radius).max(0.0);
        p = solve(s, &rhs);
    }
    *shift = s;
    let scale = radius / libm::sqrt(p[0] * p[0] + p[1] * p[1]);
    [p[0] * scale, p[1] * scale]
}
