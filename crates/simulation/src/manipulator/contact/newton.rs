//! Solves the contact problem by Newton's method on the velocities.
//!
//! Contact is compliant, so the velocities minimise a strictly convex, piecewise smooth function:
//!
//! `1/2 |v - v*|_A^2 + sum max(0, target - v_n)^2 / (2 c) + friction(v_t)`
//!
//! with v* the free velocities and c the compliance (the primal form of Castro, Permenter and Han 2022, "An
//! Unconstrained Convex Formulation of Compliant Contact", IEEE Trans. Robotics 39(2), arXiv 2110.10107). For
//! a yielding contact another integral replaces the square, and receding obstacles add a term in their common
//! speed ([`super::patch`]); the function remains convex. Each iteration replaces every row's law by its
//! tangent, solves the chain with the pressing rows (see `chain`), and moves along the step to the minimum.
//!
//! **Friction.** The radius of each cone, mu times the normal impulse, is held while the function is
//! minimised, and then updated (alternating cones), so Coulomb's law holds without the dilation of a convex
//! cone. Within a cone, an augmented Lagrangian holds a sticking contact: impulse = projection of (q - rho
//! v_t), where q is the last impulse and rho is large enough that one update of q leaves no creep.
//!
//! All vectors of an iteration are kept per row: a solution x = v - v* obeys `A x = sum f p` with p the rows'
//! impulses, so the function's slope along a step needs only the rows' impulses and speeds.

use super::chain::{Operator, add_outer_by, add_pair_by, add_scaled_by, dot, times_by};
use super::laws::{ContactRow, StopRow, Tangent, bound_miss, onto_disc};
use super::patch::Patch;
use crate::manipulator::parameters::ContactParameters;
use crate::manipulator::row::Stop;

/// The cones are updated once the residual of the rows' laws is below this fraction of that of the cones.
const RENEWAL_SHARE: f64 = 0.5;
/// Number of iterations after which the cones change by only half the difference: in a jam, a wider cone can
/// press harder on the others, and they on it in turn.
const PATIENCE: usize = 28;
/// Fraction of the initial slope at which the search along a step ends.
const SEARCH_SHARE: f64 = 0.01;
/// Maximum evaluations of a search.
const SEARCH_EVALUATIONS: usize = 20;

/// Maximum work of pushing out overlap per step, J. A tool that is jammed between walls resists with hundreds
/// of newtons: without this limit, the walls would do work on it out of nothing.
const PUSH_OUT_J: f64 = 1.0e-4;

/// Residual, relative to the tolerance, beyond which a solve starts again from the free motion: the last
/// tick's impulses can lead it far away, from where each step is short.
const LOST_SHARE: f64 = 1.0e3;

/// Outcome of a solve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::manipulator) struct Outcome {
    /// Number of factorisations with contact rows.
    pub iterations: usize,
    /// Largest speed by which a row violates its law, m/s (rad/s for stops).
    pub residual: f64,
}

/// The rows of one step on their chain, or on another operator.
pub(super) struct Problem<'s, const N: usize, O> {
    pub chain: &'s mut O,
    /// Contact rows, ordered by link.
    pub row: &'s mut [ContactRow<N>],
    pub stop: &'s mut [StopRow],
    /// Recession law of the receding rows.
    pub patch: Patch,
    /// Free motion of each link, and free velocity of each freedom.
    pub free_motion: &'s [[f64; N]],
    pub free: &'s [f64],
    pub parameters: &'s ContactParameters,
}

/// [`Problem::solve`], compiled for each instruction set. No operation is reordered or fused, so the result
/// is bit-identical.
impl<const N: usize, O: Operator<N>> pulp::WithSimd for Problem<'_, N, O> {
    type Output = Outcome;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, simd: S) -> Outcome {
        self.solve(simd)
    }
}

impl<const N: usize, O: Operator<N>> Problem<'_, N, O> {
    /// Iterates until every row satisfies its law within the tolerance, or the iteration limit is reached; in
    /// that case, iterates again from the free motion. Iterates on if pushing out overlap does too much work,
    /// in all at most twice the limit. Leaves the impulses in the rows.
    #[inline(always)]
    fn solve<S: pulp::Simd>(&mut self, simd: S) -> Outcome {
        self.start(simd);
        let most = self.parameters.max_iterations;
        let mut outcome = self.iterate(simd, true, most);
        if outcome.residual > LOST_SHARE * self.parameters.tolerance_m_per_s {
            self.drop_impulses();
            let again = self.iterate(simd, false, most);
            outcome = Outcome { iterations: outcome.iterations + again.iterations, ..again };
        }
        if outcome.iterations < 2 * most && self.slow_push_out() {
            let on = self.iterate(simd, false, most.min(2 * most - outcome.iterations));
            outcome = Outcome { iterations: outcome.iterations + on.iterations, ..on };
        }
        self.settle();
        outcome
    }

    /// Slows the push-out of overlap if it does more than [`PUSH_OUT_J`]; returns whether it does.
    #[inline(always)]
    fn slow_push_out(&mut self) -> bool {
        let contacts_j: f64 = self.row.iter().map(|row| row.impulse[0] * row.push).sum();
        let stops_j: f64 = self.stop.iter().map(|row| row.stop.impulse * row.stop.push).sum();
        let work_j = contacts_j + stops_j;
        if work_j <= PUSH_OUT_J {
            return false;
        }
        let slower = 1.0 - PUSH_OUT_J / work_j;
        self.row.iter_mut().for_each(|row| row.target -= slower * row.push);
        self.stop.iter_mut().for_each(|row| row.stop.target -= slower * row.stop.push);
        true
    }

    /// Iterates from the present impulses, at most `most` times; `warm` if they are the last tick's.
    #[inline(always)]
    fn iterate<S: pulp::Simd>(&mut self, simd: S, warm: bool, most: usize) -> Outcome {
        let mut outcome = Outcome { iterations: 0, residual: f64::INFINITY };
        while outcome.residual > self.parameters.tolerance_m_per_s && outcome.iterations < most {
            let first = warm && outcome.iterations == 0;
            outcome.iterations += 1;
            self.newton_step(simd, first);
            let length = if first { 1.0 } else { self.search() };
            self.go(length);
            let held;
            [held, outcome.residual] = self.misses();
            if held <= (RENEWAL_SHARE * outcome.residual).max(0.1 * self.parameters.tolerance_m_per_s) {
                let share = if outcome.iterations < PATIENCE { 1.0 } else { 0.5 };
                self.row.iter_mut().for_each(|row| row.renew(share));
            }
        }
        outcome
    }

    /// Returns to the free motion.
    #[inline(always)]
    fn drop_impulses(&mut self) {
        for row in self.row.iter_mut() {
            (row.impulse, row.speed) = ([0.0; 3], row.drive);
            row.begin();
        }
        for row in self.stop.iter_mut() {
            (row.stop.impulse, row.rate) = (0.0, row.free);
        }
    }

    /// Computes the free speeds and mobilities of the rows, and the speeds under the last tick's impulses.
    #[inline(always)]
    fn start<S: pulp::Simd>(&mut self, simd: S) {
        for row in self.row.iter_mut() {
            let motion = &self.free_motion[row.link];
            for j in 0..3 {
                row.drive[j] += dot(&row.force[j], motion);
            }
        }
        for stop in self.stop.iter_mut() {
            stop.free = stop.stop.sign * self.free[stop.freedom];
        }
        self.chain.pressing().clear();
        for row in self.row.iter() {
            for j in 0..3 {
                let sum = &mut self.chain.pressing().link_impulse[row.link];
                add_scaled_by(simd, sum, row.impulse[j], &row.force[j]);
            }
        }
        for stop in self.stop.iter() {
            self.chain.pressing().freedom_impulse[stop.freedom] += stop.stop.sign * stop.stop.impulse;
        }
        self.chain.factor(simd);
        self.chain.solve();
        let (mut next_row, mut next_stop) = (0, 0);
        let (row, stop) = (&mut *self.row, &mut *self.stop);
        self.chain.mobilities(
            simd,
            |freedom, mobility| {
                while next_stop < stop.len() && stop[next_stop].freedom == freedom {
                    stop[next_stop].mobility = mobility + stop[next_stop].stop.compliance;
                    next_stop += 1;
                }
            },
            |link, mobility| {
                while next_row < row.len() && row[next_row].link == link {
                    let row = &mut row[next_row];
                    let [n, a, b] = row.force.map(|f| dot(&f, &times_by(simd, mobility, &f)));
                    row.mobility = [n + row.compliance, a.max(b)];
                    next_row += 1;
                }
            },
        );
        for row in self.row.iter_mut() {
            let motion = &self.chain.motion()[row.link];
            row.speed = core::array::from_fn(|j| row.drive[j] + dot(&row.force[j], motion));
            row.begin();
        }
        for stop in self.stop.iter_mut() {
            stop.rate = stop.free + stop.stop.sign * self.chain.velocity()[stop.freedom];
        }
    }

    /// Solves the chain with the rows' tangent laws into each row's `next`.
    #[inline(always)]
    fn newton_step<S: pulp::Simd>(&mut self, simd: S, first: bool) {
        let pressing = self.chain.pressing();
        pressing.clear();
        let back = if first { self.patch.carried(self.row) } else { self.patch.root(self.row, 0.0) };
        for row in self.row.iter_mut() {
            row.linearise(first, back);
            let Tangent { normal, friction: [a, b, c], .. } = row.tangent;
            let [n, s, t] = &row.force;
            let impulse = row.tangent_law(&row.drive, 0.0);
            let (link, sum) = (&mut pressing.link[row.link], &mut pressing.link_impulse[row.link]);
            if normal > 0.0 {
                add_outer_by(simd, link, normal, n);
            }
            if row.tangent.presses() {
                add_scaled_by(simd, sum, impulse[0], n);
            }
            if row.radius > 0.0 {
                add_pair_by(simd, link, [a, b, c], [s, t]);
                add_scaled_by(simd, sum, impulse[1], s);
                add_scaled_by(simd, sum, impulse[2], t);
            }
        }
        let of_links = (&mut pressing.link[..], &mut pressing.link_impulse[..]);
        let back_law = self.patch.eliminate(self.row, back, of_links);
        for row in self.stop.iter_mut() {
            let Stop { sign, compliance, target, impulse, .. } = row.stop;
            let missing = target - row.rate;
            let ahead = impulse + (missing - compliance * impulse) / row.mobility;
            row.weight = if (if first { ahead } else { missing }) > 0.0 { 1.0 / compliance } else { 0.0 };
            pressing.freedom[row.freedom] += row.weight;
            pressing.freedom_impulse[row.freedom] += sign * row.weight * (target - row.free);
        }
        self.chain.factor(simd);
        self.chain.solve();
        let back = back_law.at(self.chain.motion());
        for row in self.row.iter_mut() {
            let motion = &self.chain.motion()[row.link];
            row.next_speed = core::array::from_fn(|j| row.drive[j] + dot(&row.force[j], motion));
            row.next = row.tangent_law(&row.next_speed, back);
        }
        for row in self.stop.iter_mut() {
            row.next_rate = row.free + row.stop.sign * self.chain.velocity()[row.freedom];
            row.next = row.weight * (row.stop.target - row.next_rate);
        }
    }

    /// Returns the slope of the function at the fraction `t` of the step.
    #[inline(always)]
    fn slope(&self, t: f64) -> f64 {
        let mut sum = 0.0;
        let back = self.patch.root(self.row, t);
        for row in self.row.iter() {
            let step: [f64; 3] = core::array::from_fn(|j| row.next_speed[j] - row.speed[j]);
            let law = row.law(&core::array::from_fn(|j| row.speed[j] + t * step[j]), back);
            for j in 0..3 {
                let carried = row.impulse[j] + t * (row.next[j] - row.impulse[j]);
                sum += (carried - law[j]) * step[j];
            }
        }
        for row in self.stop.iter() {
            let step = row.next_rate - row.rate;
            let carried = row.stop.impulse + t * (row.next - row.stop.impulse);
            sum += (carried - row.law(row.rate + t * step)) * step;
        }
        sum
    }

    /// Returns the fraction of the step at which the function is smallest, by bisection and false position on
    /// its slope, which never decreases.
    #[inline(always)]
    fn search(&self) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        let (mut slope_low, mut slope_high) = (self.slope(0.0), self.slope(1.0));
        let enough = SEARCH_SHARE * slope_low.abs();
        if slope_high <= enough || slope_low >= 0.0 {
            return 1.0;
        }
        for evaluation in 0..SEARCH_EVALUATIONS {
            let middle = if evaluation % 3 == 2 {
                0.5 * (low + high)
            } else {
                low + (high - low) * (slope_low / (slope_low - slope_high))
            };
            let slope = self.slope(middle);
            if slope.abs() <= enough {
                return middle;
            }
            if slope < 0.0 {
                (low, slope_low) = (middle, slope);
            } else {
                (high, slope_high) = (middle, slope);
            }
        }
        low + (high - low) * (slope_low / (slope_low - slope_high))
    }

    /// Moves by the fraction `length` of the step.
    #[inline(always)]
    fn go(&mut self, length: f64) {
        let blend = |from: f64, to: f64| if length == 1.0 { to } else { from + length * (to - from) };
        for row in self.row.iter_mut() {
            row.speed = core::array::from_fn(|j| blend(row.speed[j], row.next_speed[j]));
            row.impulse = core::array::from_fn(|j| blend(row.impulse[j], row.next[j]));
        }
        for row in self.stop.iter_mut() {
            row.rate = blend(row.rate, row.next_rate);
            row.stop.impulse = blend(row.stop.impulse, row.next);
        }
    }

    /// Returns the largest violations over all rows: with the cones held, and of Coulomb's law.
    #[inline(always)]
    fn misses(&self) -> [f64; 2] {
        let mut most = [0.0f64; 2];
        let back = self.patch.carried(self.row);
        for row in self.row.iter() {
            let own = row.misses(back);
            most = [most[0].max(own[0]), most[1].max(own[1])];
        }
        for row in self.stop.iter() {
            let Stop { compliance, target, impulse, .. } = row.stop;
            let own =
                bound_miss(impulse, target - row.rate - compliance * impulse, row.mobility, f64::INFINITY);
            most = [most[0].max(own), most[1].max(own)];
        }
        most
    }

    /// Removes inadmissible impulses left by rounding or by the iteration limit.
    #[inline(always)]
    fn settle(&mut self) {
        for row in self.row.iter_mut() {
            let normal = row.impulse[0].max(0.0).min(row.strength);
            let [a, b] = onto_disc([row.impulse[1], row.impulse[2]], row.friction * normal);
            row.impulse = [normal, a, b];
        }
        for row in self.stop.iter_mut() {
            row.stop.impulse = row.stop.impulse.max(0.0);
        }
    }
}
