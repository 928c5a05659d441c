//! Tip Jacobian and tip compliance at the present state.
//!
//! At rest the generalised forces of springs, tendons and contacts cancel. A small change of the tensions T,
//! of the base's pose and of a wrench W on the tip then moves the freedoms by
//!
//! `dq = K⁻¹ (Bᵀ dT + Jᵀ dW)`, with `K = diag(k) + sum over contacts of k_c f fᵀ`
//!
//! k are the springs of flexures, mount and pressed stops with the tendons' part at constant tension, B the
//! slopes of the tendons with the share of the tension that friction leaves, J the motion of the tip, and f
//! the unit force of a contact along its normal. These are the terms of the step's implicit operator without
//! masses. As there, the turning of loads with the tool (gravity, contact forces) is left out. K depends on
//! the contacts that press and on the bone as it is; the friction of contacts and the sliding state of
//! tendons do not change. As in the step, a flexure's wrap changes the friction in itself but not in more
//! distal ones: at a friction of 0.2 and a bend of 50 degrees, the columns of a sliding tendon are 8 % too
//! long.
//!
//! A chain needs no matrix factorization: from base to tip, every spring adds its flexibility to that of the
//! link before it, and every contact takes away a part (Sherman and Morrison), so the cost is O(freedoms +
//! contacts). Springs in series like this are the force-deflection rule for flexible manipulators; see
//! Siciliano and Khatib (eds.), Springer Handbook of Robotics, 2nd ed., ch. 11.

use nalgebra::{Isometry3, Vector3};

use super::MAX_TENDONS;
use super::common::Common;
use super::contact::Factor;
use super::contact::chain::add_scaled;
use super::spatial::algebra::{Spatial, ZERO, dot, force_at};
use super::state::ManipulatorState;
use super::tendon::{Channels, planar_slopes, sign};

/// Least stiffness of a freedom relative to that of its own spring: tendons of a tool that buckles cannot
/// make it softer.
const LEAST_STIFFNESS: f64 = 1e-6;

/// Derivatives of the pose of the tip, world axes; columns of six are linear, then angular.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipJacobian {
    /// Twist of the tip per rate of the tension of each tendon, m/N and rad/N.
    pub per_tension: [[f64; 6]; MAX_TENDONS],
    /// Twist of the tip per component of the twist of the base.
    pub per_base: [[f64; 6]; 6],
    /// Displacement of the tip per component of a force and torque on it, at constant tensions.
    pub compliance: [[f64; 6]; 6],
}

/// Motion of a link (angular, then linear), base axes at the base origin, per unit of each tension, component
/// of the base's motion, and component of a force on the link.
#[derive(Debug, Clone)]
pub struct LinkMotion {
    per_tension: [Spatial; MAX_TENDONS],
    per_base: [Spatial; 6],
    flexibility: [Spatial; 6],
}

#[inline(always)]
fn cross([a, b, c]: &[f64; 3], [x, y, z]: &[f64; 3]) -> [f64; 3] {
    [b * z - c * y, c * x - a * z, a * y - b * x]
}

const UNIT: [Spatial; 6] = {
    let mut unit = [ZERO; 6];
    let mut i = 0;
    while i < 6 {
        unit[i][i] = 1.0;
        i += 1;
    }
    unit
};

impl LinkMotion {
    /// Returns the motion of the base.
    pub(super) fn of_base() -> Self {
        Self { per_tension: [ZERO; MAX_TENDONS], per_base: UNIT, flexibility: [ZERO; 6] }
    }

    /// Continues to the next link across a spring that moves it along `axis`; `pull` is the generalised force
    /// on it per unit of each tension.
    pub(super) fn cross(&mut self, axis: &Spatial, stiffness: f64, pull: &[f64; MAX_TENDONS]) {
        let (flexibility, mut moved) = (1.0 / stiffness, [0.0; 6]);
        for k in 0..6 {
            moved[k] = flexibility * axis[k];
        }
        for k in 0..6 {
            add_scaled(&mut self.flexibility[k], moved[k], axis);
        }
        for t in 0..MAX_TENDONS {
            if pull[t] != 0.0 {
                add_scaled(&mut self.per_tension[t], pull[t], &moved);
            }
        }
    }

    /// Adds a contact of the link: a spring along the unit force `f` to the world.
    pub(super) fn support(&mut self, f: &Spatial, stiffness: f64) {
        let mut moved = ZERO;
        for (column, x) in self.flexibility.iter().zip(f) {
            add_scaled(&mut moved, *x, column);
        }
        let scale = -1.0 / (1.0 / stiffness + dot(f, &moved));
        let Self { per_tension, per_base, flexibility } = self;
        for column in per_tension.iter_mut().chain(per_base).chain(flexibility) {
            let along = dot(f, column);
            add_scaled(column, scale * along, &moved);
        }
    }

    /// Returns the Jacobian at a point of the link, base axes, as seen from the world.
    pub(super) fn at(&self, point: &Vector3<f64>, t_world_base: &Isometry3<f64>) -> TipJacobian {
        let rotation = t_world_base.rotation.to_rotation_matrix();
        let (mut to_world, at) = ([[0.0; 3]; 3], [point.x, point.y, point.z]);
        for row in 0..3 {
            for column in 0..3 {
                to_world[row][column] = rotation[(row, column)];
            }
        }
        let twist = |motion: &Spatial| {
            let [w, v] = [[motion[0], motion[1], motion[2]], [motion[3], motion[4], motion[5]]];
            let (turned, mut out) = (cross(&w, &at), ZERO);
            for row in 0..3 {
                for k in 0..3 {
                    out[row] += to_world[row][k] * (v[k] + turned[k]);
                    out[3 + row] += to_world[row][k] * w[k];
                }
            }
            out
        };
        // Columns of inputs at `point`: linear, then angular, along the world's axes.
        let inputs = |columns: &[Spatial; 6], point: &[f64; 3]| {
            let mut out = [ZERO; 6];
            for k in 0..3 {
                let (axis, mut sums) = (to_world[k], [ZERO; 2]);
                let moment = cross(point, &axis);
                for i in 0..3 {
                    add_scaled(&mut sums[0], moment[i], &columns[i]);
                    add_scaled(&mut sums[0], axis[i], &columns[3 + i]);
                    add_scaled(&mut sums[1], axis[i], &columns[i]);
                }
                (out[k], out[3 + k]) = (twist(&sums[0]), twist(&sums[1]));
            }
            out
        };
        TipJacobian {
            per_tension: self.per_tension.each_ref().map(twist),
            per_base: inputs(&self.per_base, &[0.0; 3]),
            compliance: inputs(&self.flexibility, &at),
        }
    }
}

/// A tool with a few freedoms, each of which moves all links.
pub(super) struct FewFreedoms<const N: usize> {
    /// Stiffness.
    pub operator: [[f64; N]; N],
    /// Motion of the last link per unit of each freedom.
    pub axis: [Spatial; N],
    pull: [[f64; N]; MAX_TENDONS],
    /// Generalised force of the contacts per unit of the base's motion, negative.
    base: [[f64; N]; 6],
}

impl<const N: usize> FewFreedoms<N> {
    /// Returns freedoms without stiffness, motion and forces.
    pub fn new() -> Self {
        let none = [0.0; N];
        Self { operator: [none; N], axis: [ZERO; N], pull: [none; MAX_TENDONS], base: [none; 6] }
    }

    /// Adds a spring along the displacement `row`.
    pub fn add_spring(&mut self, row: &[f64; N], stiffness: f64) {
        for k in 0..N {
            add_scaled(&mut self.operator[k], stiffness * row[k], row);
        }
    }

    /// Adds the torques of tendons along the displacement `row`, per unit of each tension.
    pub fn add_pull(&mut self, row: &[f64; N], torque: &[f64; MAX_TENDONS]) {
        for t in 0..MAX_TENDONS {
            if torque[t] != 0.0 {
                add_scaled(&mut self.pull[t], torque[t], row);
            }
        }
    }

    /// Adds a contact: a spring along the unit force `f`, whose generalised force is `on`, to the world.
    pub fn add_support(&mut self, on: &[f64; N], f: &Spatial, stiffness: f64) {
        self.add_spring(on, stiffness);
        for k in 0..6 {
            add_scaled(&mut self.base[k], stiffness * f[k], on);
        }
    }

    /// Returns the motion of the last link; of a tool that buckles, that of the base.
    pub fn tip_motion(&self) -> LinkMotion {
        let mut motion = LinkMotion::of_base();
        let Some(factor) = Factor::of(&self.operator) else { return motion };
        // The operator is symmetric, so one solution for each component of the motion serves all forces.
        let axes: [[f64; N]; 6] = core::array::from_fn(|i| core::array::from_fn(|k| self.axis[k][i]));
        let solved = axes.each_ref().map(|axis| factor.solve(axis));
        let moved = |force: &[f64; N]| {
            let mut sum = ZERO;
            for k in 0..N {
                for i in 0..6 {
                    sum[i] += force[k] * solved[i][k];
                }
            }
            sum
        };
        motion.per_tension = self.pull.each_ref().map(moved);
        motion.flexibility = axes.each_ref().map(moved);
        for (column, base) in motion.per_base.iter_mut().zip(&self.base) {
            add_scaled(column, -1.0, &moved(base));
        }
        motion
    }
}

/// Returns the stiffness of a freedom with its tendons and stop.
pub(super) fn stiffness(own: f64, tendons: f64, stop: f64) -> f64 {
    (own + tendons).max(LEAST_STIFFNESS * own) + stop
}

/// A contact that presses.
pub(super) struct Support {
    /// Unit force along its normal, base axes at the base origin.
    pub force: Spatial,
    pub sphere: usize,
    pub link: usize,
}

/// Returns the contacts that pressed in the last step, from base to tip.
pub(super) fn supports(common: &Common) -> impl Iterator<Item = Support> + '_ {
    let base = common.state.base.t_world_base;
    let pressing = common.state.results.iter().filter(|result| result.normal_force_n > 0.0);
    pressing.map(move |result| {
        let (sphere, fixed) =
            (&common.spheres[result.sphere_index], &common.sphere_layout[result.sphere_index]);
        let normal = base.rotation.inverse_transform_vector(&result.normal);
        let centre = base.rotation.inverse_transform_vector(&(sphere.centre_m - base.translation.vector));
        let force = force_at(&centre, &Vector3::zeros(), &normal);
        Support { force, sphere: result.sphere_index, link: fixed.link }
    })
}

/// Tensions of the tendons along the flexures, from base to tip.
pub(super) struct Pulls<'t> {
    channels: &'t Channels,
    tension_n: [f64; MAX_TENDONS],
    sliding: [f64; MAX_TENDONS],
    wrap_rad: [f64; MAX_TENDONS],
}

impl<'t> Pulls<'t> {
    pub fn of(channels: &'t Channels, state: &ManipulatorState) -> Self {
        let tension_n = state.report.tendon_tension_n;
        Self { channels, tension_n, sliding: state.sliding(), wrap_rad: [0.0; MAX_TENDONS] }
    }

    /// Returns the share of the tension of tendon `t` at the next flexure, which turns the channel by
    /// `turn_rad`; the tension there; and half of `mu` times the sliding state times that tension.
    pub fn next(&mut self, t: usize, turn_rad: f64) -> [f64; 3] {
        let (mu, tension_n) = (self.channels.cable[t].friction_coefficient, self.tension_n[t]);
        if mu == 0.0 || tension_n == 0.0 {
            return [1.0, tension_n, 0.0];
        }
        let wrap_rad = self.wrap_rad[t] + 0.5 * turn_rad;
        self.wrap_rad[t] += turn_rad;
        let share = libm::exp(-mu * self.sliding[t] * wrap_rad);
        [share, share * tension_n, 0.5 * mu * self.sliding[t] * share * tension_n]
    }

    /// Returns the tendons' stiffness of planar flexure `i`, bent by `q` rad, and the torque on it per unit
    /// of each tension: the formulas of [`super::tendon`].
    pub fn planar(&mut self, i: usize, q: f64, half: [f64; 2]) -> (f64, [f64; MAX_TENDONS]) {
        let (mut stiffness, mut pull) = (0.0, [0.0; MAX_TENDONS]);
        for t in (0..self.channels.count).filter(|t| self.channels.flexures(*t).contains(&i)) {
            let (offset_m, gap_m) = (self.channels.offset_m[t][0], self.channels.cable[t].gap_m);
            let [slope, curvature] = planar_slopes(offset_m, gap_m, half);
            let [share, local_n, winding] = self.next(t, q.abs());
            stiffness += winding * slope * sign(q) - local_n * curvature;
            pull[t] = share * slope;
        }
        (stiffness, pull)
    }
}
