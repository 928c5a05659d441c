//! One step of a spatial chain: linearly implicit Euler, or ROS2 in free motion, as in the planar rung.

use nalgebra::Vector3;

use super::SpatialChain;
use super::algebra::{Spatial, ZERO, add_scaled, force_at};
use super::energy::{FRAME_SHARE, LoadWork, tendon_share};
use super::layout::SpatialLayout;
use super::tendon::Motion;
use crate::manipulator::ManipulatorModel;
use crate::manipulator::contact::{BaseDrive, ContactPlacement};
use crate::manipulator::error::ManipulatorError;
use crate::manipulator::geometry::SphereLayout;
use crate::manipulator::loads::Frame;
use crate::manipulator::parameters::Integrator;
use crate::manipulator::state::{StepInput, StepReport};
use crate::manipulator::step::{FREE_SHARE, GAMMA, MAX_ROUNDS, Stage, Stops};
use crate::manipulator::tendon::turns;

/// Work vectors of a step, one entry per degree of freedom.
#[derive(Debug, Clone, Default)]
pub(super) struct Work {
    before: Vec<f64>,
    after: Vec<f64>,
    /// Velocities assumed for the tendons.
    expected: Vec<f64>,
    next: Vec<f64>,
    /// Stiffness including the tendons' diagonal part.
    stiffness: Vec<f64>,
    diagonal: Vec<f64>,
    rhs: Vec<f64>,
    y: Vec<f64>,
    kv1: Vec<f64>,
    kq1: Vec<f64>,
    q2: Vec<f64>,
    v2: Vec<f64>,
    kv2: Vec<f64>,
    /// Generalised forces of gravity, base and tip.
    frame_force: Vec<f64>,
    /// Tendon forces at the start of the step.
    first_pull: Vec<f64>,
    motions: Vec<Spatial>,
}

impl Work {
    pub fn new(freedoms: usize, links: usize) -> Self {
        let blank = || vec![0.0; freedoms];
        Self {
            before: blank(),
            after: blank(),
            expected: blank(),
            next: blank(),
            stiffness: blank(),
            diagonal: blank(),
            rhs: blank(),
            y: blank(),
            kv1: blank(),
            kq1: blank(),
            q2: blank(),
            v2: blank(),
            kv2: blank(),
            frame_force: blank(),
            first_pull: blank(),
            motions: vec![ZERO; links],
        }
    }
}

/// Diagonal parts of a stage's operator, to be filled.
struct Diagonals<'a> {
    /// Stiffness including the tendons' part.
    stiffness: &'a mut [f64],
    /// Diagonal that the factored operator adds to the mass matrix.
    diagonal: &'a mut [f64],
}

/// Sets `out[i] = f(i)` for every degree of freedom.
fn fill(out: &mut [f64], f: impl Fn(usize) -> f64) {
    for (i, out) in out.iter_mut().enumerate() {
        *out = f(i);
    }
}

impl<const D: usize> SpatialChain<D> {
    /// See [`ManipulatorModel::step`].
    pub(super) fn take_step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        let (drive, frame) = self.common.begin(dt_s, input)?;
        // Moved out and back so that the step does not allocate.
        let mut work = core::mem::take(&mut self.work);
        work.before.copy_from_slice(&self.common.state.velocity);
        let mut report = StepReport::none();
        match self.rosenbrock(dt_s, input, &frame, &mut work) {
            Ok(error) => {
                report.integrator = Integrator::Hybrid;
                report.error_estimate_rad = error;
                self.common.state.results.clear();
                self.common.state.stop_torque_nm.fill(0.0);
            }
            Err(error) => {
                report.error_estimate_rad = error;
                self.linearly_implicit_euler(dt_s, input, &drive, &frame, &mut work, &mut report);
            }
        }
        self.finish(dt_s, input, &mut work, &mut report);
        self.work = work;
        Ok(report)
    }

    /// Evaluates tendons, factored operator and loads of one stage.
    fn stage(
        &mut self,
        motion: Motion<'_>,
        h: f64,
        input: &StepInput,
        frame: &Frame,
        at: Stage,
        operator: Diagonals<'_>,
    ) {
        self.factor_with_tendons(motion, h, input, at, operator);
        let configuration = at.of(&self.configuration, &self.trial);
        self.loads.evaluate(&self.layout, configuration, motion.v, frame);
    }

    /// Evaluates the tendons and factors the operator with them.
    fn factor_with_tendons(
        &mut self,
        motion: Motion<'_>,
        h: f64,
        input: &StepInput,
        at: Stage,
        operator: Diagonals<'_>,
    ) {
        let Diagonals { stiffness, diagonal } = operator;
        let configuration = at.of(&self.configuration, &self.trial);
        self.tendon.evaluate(&self.layout, motion, &input.tendon, &self.common.state.tendon);
        let stops = self.pressed.stiffness();
        fill(stiffness, |i| (self.stiffness[i] + self.tendon.stiffness[i]).max(0.0) + stops[i]);
        fill(diagonal, |i| h * self.damping[i] + h * h * stiffness[i]);
        self.articulated.factor(&self.layout, configuration, diagonal);
        let solve = |rhs: &Vec<f64>, out: &mut Vec<f64>| self.articulated.solve(&self.layout, None, rhs, out);
        self.coupling.update(&self.tendon.terms(), h * h, solve);
    }

    /// Computes the forces of springs, dampers and tendons at `q`, `v`, minus `K y`.
    fn elastic_forces(&self, motion: Motion<'_>, y: &Vec<f64>, stiffness: &[f64], out: &mut Vec<f64>) {
        let Motion { q, v } = motion;
        let stops = self.pressed.drive();
        fill(out, |i| {
            self.tendon.torque[i] + stops[i]
                - self.stiffness[i] * (q[i] - self.rest[i])
                - self.damping[i] * v[i]
                - stiffness[i] * y[i]
        });
        self.coupling.subtract_stiffness(y, out);
    }

    /// Sets out = A^-1 (f + loads).
    fn solve_loads(&mut self, f: &[f64], out: &mut Vec<f64>) {
        self.articulated.solve(&self.layout, Some(&self.loads.force), f, out);
        self.coupling.correct(out);
    }

    fn linearly_implicit_euler(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        frame: &Frame,
        work: &mut Work,
        report: &mut StepReport,
    ) {
        let q = core::mem::take(&mut self.common.state.position);
        let h = if self.explicit { 0.0 } else { dt };
        self.pressed.clear();
        if !self.explicit {
            fill(&mut work.next, |i| q[i] - self.rest[i]);
            self.pressed.collect(&self.common.parameters, dt, &work.next, &self.common.state.stop_torque_nm);
        }
        let Work { before, expected, stiffness, diagonal, .. } = &mut *work;
        let motion = Motion { q: &q, v: before };
        self.stage(motion, h, input, frame, Stage::Start, Diagonals { stiffness, diagonal });
        expected.copy_from_slice(before);
        self.common.state.position = q;
        let (mut round, mut stops) = (1, Stops::Near);
        loop {
            self.free_velocity(dt, h, work);
            self.with_contacts(dt, input, drive, (work, stops), report);
            let Work { after, expected, stiffness, diagonal, .. } = &mut *work;
            let turned =
                !self.explicit && turns(&self.tendon.slides_on, &self.tendon.slope, [expected, after]);
            let passed = !self.explicit && stops == Stops::Near && self.passes_stop(dt, after);
            let released = self.pressed.release(dt, after, &self.common.state.stop_torque_nm);
            if !(turned || released || passed) || (round >= MAX_ROUNDS && !passed) {
                break;
            }
            if passed {
                stops = Stops::All;
                self.pressed.clear();
            }
            if turned {
                expected.copy_from_slice(after);
            }
            let q = core::mem::take(&mut self.common.state.position);
            let motion = Motion { q: &q, v: expected };
            self.factor_with_tendons(motion, h, input, Stage::Start, Diagonals { stiffness, diagonal });
            self.common.state.position = q;
            round += 1;
        }
        if !self.explicit {
            let law = self.common.parameters.stop_law();
            for k in self.layout.stopped() {
                work.after[k] = law.held(dt, self.common.state.position[k] - self.rest[k], work.after[k]);
            }
        }
        self.store_results(dt, drive, &work.after, report);
        let Work { after, next, .. } = work;
        fill(next, |i| self.common.state.position[i] + dt * after[i]);
    }

    /// Returns true if a flexure ends past a stop that was not part of the solve.
    fn passes_stop(&self, dt: f64, after: &[f64]) -> bool {
        let law = self.common.parameters.stop_law();
        self.layout.stopped().any(|k| {
            let listed = |side| self.contact.has_hard_stop(k, side);
            law.is_passed(dt, self.common.state.position[k] - self.rest[k], after[k], listed)
        })
    }

    /// Computes the velocities after the step without contacts, in `work.after`.
    fn free_velocity(&mut self, dt: f64, h: f64, work: &mut Work) {
        let Work { before, after, stiffness, rhs, y, .. } = work;
        fill(y, |i| h * before[i]);
        self.elastic_forces(Motion { q: &self.common.state.position, v: before }, y, stiffness, rhs);
        self.solve_loads(rhs, after);
        for (after, before) in after.iter_mut().zip(before) {
            *after = *before + dt * *after;
        }
    }

    /// Adds the contact and stop impulses to the free velocities, `work.after`.
    fn with_contacts(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        (work, stops): (&mut Work, Stops),
        report: &mut StepReport,
    ) {
        let step = self.common.contact_step(dt, drive, input);
        let (layout, configuration, state) = (&self.layout, &self.configuration, &self.common.state);
        let solver = &mut self.contact;
        solver.collect(
            &step,
            report,
            |_| true,
            |sphere, direction| {
                let SphereLayout { link, along_m, radius_m, .. } = step.spheres[sphere];
                let point = configuration.point(link, along_m) - direction[0] * radius_m;
                ContactPlacement {
                    link,
                    point,
                    force: direction.map(|d| force_at(&point, &Vector3::zeros(), &d)),
                }
            },
        );
        let law = self.common.parameters.stop_law();
        for k in layout.stopped() {
            let (at, last_nm) = (state.position[k] - self.rest[k], state.stop_torque_nm[k]);
            let flexure = (k, self.pressed.has(k));
            match stops {
                Stops::Near => solver.collect_stop((dt, &law), flexure, (at, work.after[k]), last_nm),
                Stops::All => solver.collect_both_stops((dt, &law), k, at, last_nm),
            }
        }
        if solver.is_empty() {
            return;
        }
        layout.describe(configuration, &work.diagonal, &mut solver.chain);
        self.coupling.describe(&mut solver.chain);
        solver.solve(&work.after, &step, report);
        let Work { after, motions, rhs, y, .. } = work;
        motions.fill(ZERO);
        rhs.fill(0.0);
        solver.impulses(
            |link, impulse, force| add_scaled(&mut motions[link], impulse, force),
            |freedom, impulse| rhs[freedom] += impulse,
        );
        self.articulated.solve(layout, Some(motions), rhs, y);
        self.coupling.correct(y);
        for (v, change) in after.iter_mut().zip(y) {
            *v += *change;
        }
    }

    /// Stores the impulses for the next step and adds the contact moments to the loads.
    fn store_results(&mut self, dt: f64, drive: &BaseDrive, after: &[f64], report: &mut StepReport) {
        let torque = &mut self.common.state.stop_torque_nm;
        torque.fill(0.0);
        report.stopped_joint_count = self.contact.stop_torques(dt, |freedom, value| torque[freedom] += value);
        report.stopped_joint_count += self.pressed.store(dt, after, torque);
        self.common.store_contacts(&self.contact, dt, drive, &mut self.loads.moment, report);
    }

    /// Takes a ROS2 step in free motion into `work.next` and `work.after`; returns its error estimate. `Err`:
    /// ROS2 is off, or the motion is not smooth (estimate 0), not free, or above the tolerance.
    fn rosenbrock(&mut self, dt: f64, input: &StepInput, frame: &Frame, work: &mut Work) -> Result<f64, f64> {
        // Determined again after the next free step.
        let ceiling_j = core::mem::replace(&mut self.common.state.energy_ceiling_j, f64::INFINITY);
        let wanted =
            self.common.parameters.integrator == Integrator::Hybrid && self.common.contacts_far(dt, input);
        if !wanted || self.near_stop(&self.common.state.position) {
            return Err(0.0);
        }
        self.pressed.clear();
        // In the plane, no step has been observed to gain energy.
        let before_j = (D > 1).then(|| self.energy_j());
        if D > 1 {
            self.frame_forces(frame, &mut work.frame_force);
        }
        let q = core::mem::take(&mut self.common.state.position);
        let stages = self.rosenbrock_stages(&q, dt, input, frame, work);
        self.common.state.position = q;
        let error = stages.ok_or(0.0)?;
        let accurate = error <= self.common.parameters.hybrid_tolerance_rad;
        if !accurate || self.near_stop(&work.next) || !self.contacts_clear(dt, &work.next, input) {
            return Err(if error.is_finite() { error } else { f64::MAX });
        }
        match before_j {
            Some(before_j) if self.gains_energy([ceiling_j, before_j], input, work) => Err(error),
            _ => Ok(error),
        }
    }

    /// Sets the energy ceiling after a ROS2 step, which is in `work.next` and `work.after`; returns true if
    /// the step ends above it.
    fn gains_energy(&mut self, [ceiling_j, before_j]: [f64; 2], input: &StepInput, work: &Work) -> bool {
        let Work { next, after, frame_force, first_pull, .. } = work;
        self.trial.update(&self.layout, next);
        let after_j = self.energy_of(&self.trial, next, after);
        let (mut loads, share) = (LoadWork::default(), tendon_share(&input.tendon));
        for (k, next) in next.iter().enumerate() {
            let moved = next - self.common.state.position[k];
            loads.add([first_pull[k], self.tendon.torque[k]], moved, share);
            loads.add([frame_force[k]; 2], moved, FRAME_SHARE);
        }
        self.common.state.energy_ceiling_j = loads.ceiling_j(ceiling_j, before_j);
        // NaN marks a failed step.
        after_j > self.common.state.energy_ceiling_j || after_j.is_nan()
    }

    /// Returns the error estimate; `None` if a tendon binds, or starts or stops sliding within the step.
    fn rosenbrock_stages(
        &mut self,
        q: &[f64],
        dt: f64,
        input: &StepInput,
        frame: &Frame,
        work: &mut Work,
    ) -> Option<f64> {
        let h = GAMMA * dt;
        let Work {
            before, after, next, stiffness, diagonal, rhs, y, kv1, kq1, q2, v2, kv2, first_pull, ..
        } = work;
        let start = Motion { q, v: before };
        self.stage(start, h, input, frame, Stage::Start, Diagonals { stiffness, diagonal });
        if self.tendon.channels.bind(&self.tendon.tension_n) {
            return None;
        }
        first_pull.copy_from_slice(&self.tendon.torque);
        fill(y, |i| h * before[i]);
        self.elastic_forces(start, y, stiffness, rhs);
        self.solve_loads(rhs, kv1);
        fill(kq1, |i| before[i] + h * kv1[i]);
        if turns(&self.tendon.slides_on, &self.tendon.slope, [before, kq1]) {
            return None;
        }
        let slid = self.tendon.slides_on;
        fill(q2, |i| q[i] + dt * kq1[i]);
        fill(v2, |i| before[i] + dt * kv1[i]);
        self.trial.update(&self.layout, q2);
        let trial = Motion { q: q2, v: v2 };
        self.stage(trial, h, input, frame, Stage::Trial, Diagonals { stiffness, diagonal });
        if self.tendon.slides_on != slid {
            return None;
        }
        // As in the planar rung: substituting x = kv2 + 2 kv1 removes the mass from the right-hand side.
        fill(y, |i| h * (v2[i] - 2.0 * kq1[i]) - 2.0 * h * h * kv1[i]);
        self.elastic_forces(trial, y, stiffness, rhs);
        for i in 0..rhs.len() {
            rhs[i] += 2.0 * h * self.damping[i] * kv1[i];
        }
        self.solve_loads(rhs, kv2);
        let mut error = 0.0f64;
        for i in 0..kv2.len() {
            kv2[i] -= 2.0 * kv1[i];
            let kq2 = v2[i] - 2.0 * kq1[i] + h * kv2[i];
            next[i] = q[i] + 1.5 * dt * kq1[i] + 0.5 * dt * kq2;
            after[i] = before[i] + 1.5 * dt * kv1[i] + 0.5 * dt * kv2[i];
        }
        for joint in 0..self.layout.joints {
            let bend = self.layout.bend(joint);
            for i in bend..bend + D - SpatialLayout::<D>::BEND {
                let kq2 = v2[i] - 2.0 * kq1[i] + h * kv2[i];
                let own = (0.5 * dt * (kq1[i] + kq2)).abs();
                // Let a NaN win: it marks a failed step.
                error = if own > error || own.is_nan() { own } else { error };
            }
        }
        Some(error)
    }

    fn near_stop(&self, q: &[f64]) -> bool {
        let reach = FREE_SHARE * self.common.parameters.joint_limit_rad;
        (0..self.layout.joints).any(|joint| {
            let bend = self.layout.bend(joint);
            (q[bend] - self.rest[bend]).abs() > reach || (D > 1 && q[bend + 1].abs() > reach)
        })
    }

    /// Returns true if every sphere still clears its plane in configuration `next`.
    fn contacts_clear(&mut self, dt: f64, next: &[f64], input: &StepInput) -> bool {
        if input.contacts.is_empty() {
            return true;
        }
        self.trial.update(&self.layout, next);
        self.common.contacts_clear(dt, input, |fixed| self.trial.point(fixed.link, fixed.along_m))
    }

    /// Computes the flange reaction, then updates everything that depends on the new state.
    fn finish(&mut self, dt: f64, input: &StepInput, work: &mut Work, report: &mut StepReport) {
        let Work { before, after, next, y, motions, .. } = work;
        fill(y, |i| after[i] - before[i]);
        self.articulated.link_motions(&self.layout, y, motions);
        let moment = self.loads.moment - self.loads.momentum_moment(motions) / dt;
        self.common.state.position.copy_from_slice(next);
        self.common.state.velocity.copy_from_slice(after);
        self.common.react(input, &moment, report);
        self.follow_state();
        let Self { common, tendon, layout, .. } = self;
        common.end(input, &tendon.channels, |t| tendon.take_up(layout, next, t), report);
    }
}
