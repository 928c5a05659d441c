//! One step of the modes, as in [`crate::manipulator::step`]: linearly implicit Euler, or ROS2 in smooth free
//! motion.

use nalgebra::Vector3;

use super::operator::FlexureLoads;
use super::tendons::{BendSums, Tendons};
use super::{MOUNT, MomentModes};
use crate::manipulator::common::Common;
use crate::manipulator::contact::BaseDrive;
use crate::manipulator::error::ManipulatorError;
use crate::manipulator::loads::Frame;
use crate::manipulator::parameters::Integrator;
use crate::manipulator::state::{StepInput, StepReport};
use crate::manipulator::step::{FREE_SHARE, GAMMA, MAX_ROUNDS, Stage};
use crate::manipulator::tendon::turns;
use crate::manipulator::{MAX_JOINTS, MAX_TENDONS, ManipulatorModel};

/// Returns a + scale b.
#[inline(always)]
pub(super) fn plus<const N: usize>(a: &[f64; N], scale: f64, b: &[f64; N]) -> [f64; N] {
    core::array::from_fn(|k| a[k] + scale * b[k])
}

#[inline(always)]
fn scaled<const N: usize>(scale: f64, a: &[f64; N]) -> [f64; N] {
    a.map(|a| scale * a)
}

/// Evaluation point of a stage: positions, velocities, the velocities assumed for tendon sliding, and y of `-
/// K y`.
#[derive(Clone, Copy)]
struct At<'a, const N: usize> {
    stage: Stage,
    h: f64,
    x: &'a [f64; N],
    v: &'a [f64; N],
    expected: &'a [f64; N],
    y: &'a [f64; N],
}

/// [`MomentModes::free_velocity`], compiled for each instruction set. No operation is reordered or fused, so
/// the result is bit-identical.
struct Free<'a, const N: usize> {
    tool: &'a mut MomentModes<N>,
    at: At<'a, N>,
    input: &'a StepInput<'a>,
    frame: &'a Frame,
}

impl<const N: usize> pulp::WithSimd for Free<'_, N> {
    type Output = [f64; N];

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, simd: S) -> [f64; N] {
        self.tool.free_velocity(simd, self.at, self.input, self.frame)
    }
}

/// [`MomentModes::rosenbrock`], compiled in the same way.
struct Rosenbrock<'a, const N: usize> {
    tool: &'a mut MomentModes<N>,
    dt: f64,
    input: &'a StepInput<'a>,
    frame: &'a Frame,
}

impl<const N: usize> pulp::WithSimd for Rosenbrock<'_, N> {
    type Output = Result<([f64; N], f64), f64>;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, simd: S) -> Self::Output {
        self.tool.rosenbrock(simd, self.dt, self.input, self.frame)
    }
}

impl<const N: usize> MomentModes<N> {
    /// See [`ManipulatorModel::step`].
    pub(super) fn take_step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        let (drive, frame) = self.common.begin(dt_s, input)?;
        let [_, before] = self.freedoms();
        let rosenbrock = if self.common.parameters.integrator == Integrator::Hybrid {
            self.common.arch.dispatch(Rosenbrock { tool: self, dt: dt_s, input, frame: &frame })
        } else {
            Err(0.0)
        };
        let mut report = StepReport::none();
        let after = match rosenbrock {
            Ok((after, error)) => {
                report.integrator = Integrator::Hybrid;
                report.error_estimate_rad = error;
                self.common.state.results.clear();
                after
            }
            Err(error) => {
                report.error_estimate_rad = error;
                self.linearly_implicit_euler(dt_s, input, (&drive, &frame), &mut report)
            }
        };
        self.finish(dt_s, input, (&before, &after), &mut report);
        Ok(report)
    }

    fn linearly_implicit_euler(
        &mut self,
        dt: f64,
        input: &StepInput,
        (drive, frame): (&BaseDrive, &Frame),
        report: &mut StepReport,
    ) -> [f64; N] {
        let [x, v] = self.freedoms();
        let arch = self.common.arch;
        let (mut round, mut expected) = (1, v);
        let after = loop {
            let y = scaled(dt, &v);
            let at = At { stage: Stage::Start, h: dt, x: &x, v: &v, expected: &expected, y: &y };
            let free = arch.dispatch(Free { tool: self, at, input, frame });
            let after = self.with_contacts(dt, input, drive, free, report);
            if round == MAX_ROUNDS || !self.turns(&expected, &after) {
                break after;
            }
            expected = after;
            round += 1;
        };
        self.common.store_contacts(&self.contact, dt, drive, &mut self.dynamics.moment, report);
        self.set_position(&plus(&x, dt, &after));
        after
    }

    fn set_position(&mut self, x: &[f64; N]) {
        self.common.state.position.copy_from_slice(x);
    }

    #[inline(always)]
    fn turns(&self, before: &[f64; N], after: &[f64; N]) -> bool {
        turns(&self.tendons.slides_on, &self.tendons.slope, [before, after])
    }

    /// Returns the velocities after a step of linearly implicit Euler without contacts.
    #[inline(always)]
    fn free_velocity<S: pulp::Simd>(
        &mut self,
        simd: S,
        at: At<'_, N>,
        input: &StepInput,
        frame: &Frame,
    ) -> [f64; N] {
        self.evaluate(simd, at, input, frame);
        plus(at.v, at.h, &self.factor.solve(&self.dynamics.force))
    }

    /// Sets the force and the factored operator of one stage: `M + h D + h² K`, and all forces at `x`, `v`
    /// minus `K y`.
    #[inline(always)]
    fn evaluate<S: pulp::Simd>(&mut self, simd: S, at: At<'_, N>, input: &StepInput, frame: &Frame) {
        let (q, y, bent) = match at.stage {
            // At the start, y is h v.
            Stage::Start => (self.bend[0], self.bend[1].map(|rate| at.h * rate), self.bent),
            Stage::Trial => (self.angles(at.x), self.basis.angles(at.y), BendSums::of(&self.trial.0)),
        };
        let start = (&self.shape, &self.motion);
        let trial = (&self.trial.0, &self.trial.1);
        let (shape, motion) = *at.stage.of(&start, &trial);
        self.tendons.evaluate(
            &self.basis,
            (shape, &bent, &q, at.expected),
            &input.tendon,
            &self.common.state.tendon,
        );
        let parameters = &self.common.parameters;
        let (limit, stop) = (parameters.joint_limit_rad, parameters.joint_stop_stiffness_nm_per_rad);
        let (mut torque, mut stiffness) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        for i in 0..MAX_JOINTS {
            // The stiffness of a flexure with its tendons is never below zero.
            let (own, least) = (self.tendons.stiffness[i], -self.stiffness[i]);
            let own = if own > least { own } else { least };
            let bend = q[i] - self.rest[i];
            let (over, under) = (bend - limit, bend + limit);
            let beyond = (if over > 0.0 { over } else { 0.0 }) + (if under < 0.0 { under } else { 0.0 });
            let pressed = if beyond == 0.0 { 0.0 } else { stop };
            torque[i] = self.tendons.torque[i] - pressed * beyond - (own + pressed) * y[i];
            stiffness[i] = at.h * at.h * (own + pressed);
        }
        let on = FlexureLoads { torque: &torque, stiffness: &stiffness };
        let of = (shape, motion, [at.x[1], at.v[1]]);
        self.dynamics.evaluate(simd, (&self.links, &self.basis), of, on, frame);
        self.add_springs(&at);
        self.factor.upper = self.dynamics.matrix;
        self.factor.factor(simd);
        if self.tendons.coupled != [false; MAX_TENDONS] {
            self.couple(simd, &at);
        }
    }

    /// Adds the springs and dampers of modes and mount.
    #[inline(always)]
    fn add_springs(&mut self, at: &At<'_, N>) {
        let Self { dynamics, common: Common { parameters, mount_damping, .. }, damping_s, basis, .. } = self;
        let (h, squared) = (at.h, at.h * at.h);
        for k in 0..MOUNT {
            let (stiffness, damping) = (parameters.mount_stiffness_n_per_m[k], mount_damping[k]);
            dynamics.force[k] -= stiffness * (at.x[k] + at.y[k]) + damping * at.v[k];
            dynamics.matrix[k][k] += h * damping + squared * stiffness;
        }
        for k in MOUNT..MOUNT + basis.modes {
            dynamics.force[k] -= at.x[k] + at.y[k] + *damping_s * at.v[k];
            dynamics.matrix[k][k] += h * *damping_s + squared;
        }
    }

    /// Adds the tendons' rank-one stiffness, symmetrised as in [`crate::manipulator::coupling`].
    #[inline(always)]
    fn couple<S: pulp::Simd>(&mut self, simd: S, at: &At<'_, N>) {
        let dot = |a: &[f64; N], b: &[f64; N]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let Self { dynamics, tendons, factor, .. } = self;
        for t in (0..tendons.channels.count).filter(|t| tendons.coupled[*t]) {
            let slope = &tendons.slope[t];
            let own = dot(slope, &factor.solve(slope));
            let cross = dot(slope, &factor.solve(&tendons.gradient[t]));
            let alpha = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
            let back = alpha * dot(slope, at.y);
            for i in 0..N {
                dynamics.force[i] -= back * slope[i];
                let scale = at.h * at.h * alpha * slope[i];
                for j in 0..N {
                    dynamics.matrix[i][j] += scale * slope[j];
                }
            }
        }
        factor.upper = dynamics.matrix;
        factor.factor(simd);
    }

    /// Takes a ROS2 step in free motion; returns its error estimate. `Err` leaves the state unchanged: ROS2
    /// is off (estimate 0), the motion is not free, or the estimate is above the tolerance.
    #[inline(always)]
    fn rosenbrock<S: pulp::Simd>(
        &mut self,
        simd: S,
        dt: f64,
        input: &StepInput,
        frame: &Frame,
    ) -> Result<([f64; N], f64), f64> {
        if !self.common.contacts_far(dt, input) {
            return Err(0.0);
        }
        let [x, v] = self.freedoms();
        if self.near_stop(&x) {
            return Err(0.0);
        }
        let h = GAMMA * dt;
        let y = scaled(h, &v);
        self.evaluate(simd, At { stage: Stage::Start, h, x: &x, v: &v, expected: &v, y: &y }, input, frame);
        if self.tendons.channels.bind(&self.tendons.tension_n) {
            return Err(0.0);
        }
        let kv1 = self.factor.solve(&self.dynamics.force);
        let kx1 = plus(&v, h, &kv1);
        if self.turns(&v, &kx1) {
            return Err(0.0);
        }
        let (x2, v2) = (plus(&x, dt, &kx1), plus(&v, dt, &kv1));
        let (q2, rate2) = (self.angles(&x2), self.basis.angles(&v2));
        self.trial.0.update(&self.links, &q2, &Self::mount_of(&x2));
        self.trial.1.update(&self.links, &self.trial.0, &rate2, &Self::mount_of(&v2));
        let slid = self.tendons.slides_on;
        // As in the planar rung, with x = kv2 + 2 kv1.
        let y = plus(&scaled(h, &plus(&v2, -2.0, &kx1)), -2.0 * h * h, &kv1);
        self.evaluate(
            simd,
            At { stage: Stage::Trial, h, x: &x2, v: &v2, expected: &v2, y: &y },
            input,
            frame,
        );
        if self.tendons.slides_on != slid {
            return Err(0.0);
        }
        for k in 0..MOUNT + self.basis.modes {
            let damping = if k < MOUNT { self.common.mount_damping[k] } else { self.damping_s };
            self.dynamics.force[k] += 2.0 * h * damping * kv1[k];
        }
        let kv2 = plus(&self.factor.solve(&self.dynamics.force), -2.0, &kv1);
        let kx2 = plus(&plus(&v2, -2.0, &kx1), h, &kv2);
        let next = plus(&plus(&x, 1.5 * dt, &kx1), 0.5 * dt, &kx2);
        let error = self.largest_bend(&plus(&scaled(0.5 * dt, &kx1), 0.5 * dt, &kx2));
        let accurate = error <= self.common.parameters.hybrid_tolerance_rad;
        if !accurate || self.near_stop(&next) || !self.contacts_clear(dt, &next, input) {
            return Err(if error.is_finite() { error } else { f64::MAX });
        }
        self.set_position(&next);
        Ok((plus(&plus(&v, 1.5 * dt, &kv1), 0.5 * dt, &kv2), error))
    }

    /// Returns the largest angle of a flexure from rest for amplitudes `x`, rad; NaN if one is.
    #[inline(always)]
    fn largest_bend(&self, x: &[f64; N]) -> f64 {
        let larger = |most: f64, q: &f64| if q.abs() > most || q.is_nan() { q.abs() } else { most };
        self.basis.angles(x).iter().fold(0.0, larger)
    }

    #[inline(always)]
    fn near_stop(&self, x: &[f64; N]) -> bool {
        self.largest_bend(x) > FREE_SHARE * self.common.parameters.joint_limit_rad
    }

    /// Returns true if every sphere still clears its plane at `next`. Leaves `next` in the trial shape.
    #[inline(always)]
    fn contacts_clear(&mut self, dt: f64, next: &[f64; N], input: &StepInput) -> bool {
        if input.contacts.is_empty() {
            return true;
        }
        let q = self.angles(next);
        self.trial.0.update(&self.links, &q, &Self::mount_of(next));
        self.common.contacts_clear(dt, input, |fixed| {
            let point = self.trial.0.point(fixed.link, fixed.along_m);
            Vector3::new(point[0], next[1], point[1])
        })
    }

    /// Computes the flange reaction, then updates everything that depends on the new state.
    fn finish(
        &mut self,
        dt: f64,
        input: &StepInput,
        (before, after): (&[f64; N], &[f64; N]),
        report: &mut StepReport,
    ) {
        let change = plus(after, -1.0, before);
        let momentum = self.dynamics.momentum_moment(&change, self.common.state.position[1]);
        self.common.state.velocity.copy_from_slice(after);
        self.common.react(input, &(self.dynamics.moment - momentum / dt), report);
        self.follow_state();
        report.stopped_joint_count = self.stopped;
        let Self { common, tendons: Tendons { channels, .. }, bent, .. } = self;
        common.end(input, channels, |t| bent.take_up_m(channels, t), report);
    }
}
