//! One step of the planar chain.
//!
//! Linearly implicit Euler: `(M + dt D + dt^2 K) dv = dt (f - dt K v) + J' P`, where the contact impulses P
//! come from the same velocity solve, then `q += dt v`. A state at rest in contact is an exact equilibrium.
//! ROS2 (see [`Integrator::Hybrid`]) solves the same operator twice, with gamma dt instead of dt.

use nalgebra::Vector3;

use super::articulated::{Generalised, Spatial};
use super::contact::{BaseDrive, ContactPlacement};
use super::coupling::Freedoms;
use super::error::ManipulatorError;
use super::geometry::SphereLayout;
use super::loads::{Frame, Loads};
use super::parameters::Integrator;
use super::pressing::{self, MAX_FREEDOMS, MOUNT};
use super::state::{StepInput, StepReport};
use super::tendon::turns;
use super::{MAX_JOINTS, Manipulator, ManipulatorModel};

/// 1 - 1/sqrt 2, the choice that makes ROS2 L-stable.
pub(super) const GAMMA: f64 = 1.0 - core::f64::consts::FRAC_1_SQRT_2;
/// Fraction of its stop within which every flexure must be for a Rosenbrock step.
pub(super) const FREE_SHARE: f64 = 0.9;
/// Maximum solves per step of linearly implicit Euler. Each one drops the assumptions that the previous one
/// violated.
pub(super) const MAX_ROUNDS: usize = 4;

/// The joint stops that are part of a solve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stops {
    /// Those that the motion without contacts approaches.
    Near,
    /// All: the impulses of the others can throw a flexure past any stop.
    All,
}

/// The configuration in which a stage of a step is evaluated.
#[derive(Debug, Clone, Copy)]
pub(super) enum Stage {
    /// At the start of the step.
    Start,
    /// At the end of the first Rosenbrock stage.
    Trial,
}

impl Stage {
    /// Selects the configuration of this stage.
    pub fn of<'c, C>(self, start: &'c C, trial: &'c C) -> &'c C {
        match self {
            Stage::Start => start,
            Stage::Trial => trial,
        }
    }
}

/// Diagonals of the operator: elastic stiffness and damping of flexures and mount.
#[derive(Debug, Clone)]
struct Diagonals {
    stiffness: Generalised,
    damping: Generalised,
}

impl Manipulator {
    /// See [`super::ManipulatorModel::step`].
    pub(super) fn take_step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        let (drive, frame) = self.common.begin(dt_s, input)?;
        let before = self.velocities();
        let rosenbrock = self.rosenbrock(dt_s, input, &frame);
        let mut report = StepReport::none();
        let after = match rosenbrock {
            Ok((after, error)) => {
                report.integrator = Integrator::Hybrid;
                report.error_estimate_rad = error;
                self.common.state.results.clear();
                self.common.state.stop_torque_nm.fill(0.0);
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

    fn velocities(&self) -> Generalised {
        Generalised::of(&self.common.state.velocity)
    }

    fn positions(&self) -> Generalised {
        Generalised::of(&self.common.state.position)
    }

    /// Returns the damping, and stiffness including pressed stops and the tendons' diagonal part (never below
    /// zero).
    fn diagonals(&self) -> Diagonals {
        let mut stiffness =
            Generalised { joint: self.stiffness, mount: self.common.parameters.mount_stiffness_n_per_m };
        for (i, stop) in self.pressed.stiffness().iter().enumerate() {
            stiffness.joint[i] = (stiffness.joint[i] + self.tendon.stiffness[i]).max(0.0) + stop;
        }
        let damping = Generalised { joint: self.damping, mount: self.common.mount_damping };
        Diagonals { stiffness, damping }
    }

    /// Returns the generalised forces of springs, dampers and tendons at `q`, `v`, minus `K y`.
    fn elastic_forces(
        &self,
        q: &Generalised,
        v: &Generalised,
        y: &Generalised,
        d: &Diagonals,
    ) -> Generalised {
        let mut f = Generalised::ZERO;
        for (i, stop) in self.pressed.drive().iter().enumerate() {
            f.joint[i] = self.tendon.torque[i] + stop
                - self.stiffness[i] * (q.joint[i] - self.rest[i])
                - self.damping[i] * v.joint[i]
                - d.stiffness.joint[i] * y.joint[i];
        }
        for k in 0..3 {
            let stiffness = self.common.parameters.mount_stiffness_n_per_m[k];
            f.mount[k] = -stiffness * (q.mount[k] + y.mount[k]) - self.common.mount_damping[k] * v.mount[k];
        }
        self.coupling.subtract_stiffness(y, &mut f);
        f
    }

    /// Factors M + h D + h^2 K with its coupling.
    fn factor(&mut self, h: f64, d: &Diagonals, at: Stage) {
        let diagonal = Generalised::ZERO.plus(h, &d.damping).plus(h * h, &d.stiffness);
        let configuration = at.of(&self.configuration, &self.trial);
        self.articulated.factor(&self.layout, configuration, &diagonal);
        let solve = |rhs: &Generalised, out: &mut Generalised| {
            *out = self.articulated.solve(&[[0.0; 3]; MAX_JOINTS + 1], rhs);
        };
        self.coupling.update(&self.tendon.terms(), h * h, solve);
    }

    /// Returns A^-1 (f + loads).
    fn solve_loads(&self, f: &Generalised) -> Generalised {
        let mut rhs = *f;
        rhs.mount[1] += self.loads.lateral;
        let mut v = self.articulated.solve(&self.loads.force, &rhs);
        self.coupling.correct(&mut v);
        v
    }

    fn linearly_implicit_euler(
        &mut self,
        dt: f64,
        input: &StepInput,
        (drive, frame): (&BaseDrive, &Frame),
        report: &mut StepReport,
    ) -> Generalised {
        let (q, v) = (self.positions(), self.velocities());
        self.pressed.collect(
            &self.common.parameters,
            dt,
            &self.deflection(&q),
            &self.common.state.stop_torque_nm,
        );
        let mut d = self.stage((&q, &v), dt, input, frame, Stage::Start);
        let (mut round, mut expected) = (1, v);
        let mut stops = Stops::Near;
        let mut after = loop {
            let free = self.free_velocity(dt, (&q, &v), &d);
            let after = self.with_contacts(dt, input, drive, &d, (free, stops), report);
            let turned = self.turns(&expected, &after);
            let passed = stops == Stops::Near && self.passes_stop(dt, &q, &after);
            let released = self.pressed.release(dt, &after.joint, &self.common.state.stop_torque_nm);
            if !(turned || released || passed) || (round >= MAX_ROUNDS && !passed) {
                break after;
            }
            if passed {
                stops = Stops::All;
                self.pressed.clear();
            }
            if turned {
                expected = after;
            }
            d = self.factored_with_tendons((&q, &expected), dt, input, Stage::Start);
            round += 1;
        };
        let law = self.common.parameters.stop_law();
        for i in 0..self.layout.joints {
            after.joint[i] = law.held(dt, q.joint[i] - self.rest[i], after.joint[i]);
        }
        self.store_results(dt, drive, &after, report);
        let next = q.plus(dt, &after);
        next.copy_to(&mut self.common.state.position);
        after
    }

    /// Returns true if a flexure ends past a stop that was not part of the solve.
    fn passes_stop(&self, dt: f64, q: &Generalised, after: &Generalised) -> bool {
        let law = self.common.parameters.stop_law();
        (0..self.layout.joints).any(|i| {
            let listed = |side| self.contact.has_hard_stop(MOUNT + i, side);
            law.is_passed(dt, q.joint[i] - self.rest[i], after.joint[i], listed)
        })
    }

    fn turns(&self, before: &Generalised, after: &Generalised) -> bool {
        turns(&self.tendon.slides_on, &self.tendon.slope, [&before.joint, &after.joint])
    }

    /// Returns the velocities after the step without contacts.
    fn free_velocity(&self, dt: f64, (q, v): (&Generalised, &Generalised), d: &Diagonals) -> Generalised {
        let f = self.elastic_forces(q, v, &Generalised::ZERO.plus(dt, v), d);
        v.plus(dt, &self.solve_loads(&f))
    }

    /// Adds the contact and stop impulses to the free velocities.
    fn with_contacts(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        d: &Diagonals,
        (free, stops): (Generalised, Stops),
        report: &mut StepReport,
    ) -> Generalised {
        let step = self.common.contact_step(dt, drive, input);
        let (layout, configuration, state) = (&self.layout, &self.configuration, &self.common.state);
        let lateral_m = state.position[1];
        let solver = &mut self.contact;
        solver.collect(
            &step,
            report,
            |_| true,
            |sphere, direction| {
                let SphereLayout { link, along_m, radius_m, .. } = step.spheres[sphere];
                let centre = configuration.point(link, along_m);
                let point = Vector3::new(centre[0], lateral_m, centre[1]) - direction[0] * radius_m;
                ContactPlacement { link, point, force: direction.map(|d| pressing::force(&point, &d)) }
            },
        );
        let law = self.common.parameters.stop_law();
        for i in 0..layout.joints {
            let (at, last_nm) = (state.position[MOUNT + i] - self.rest[i], state.stop_torque_nm[i]);
            let flexure = (MOUNT + i, self.pressed.has(i));
            match stops {
                Stops::Near => solver.collect_stop((dt, &law), flexure, (at, free.joint[i]), last_nm),
                Stops::All => solver.collect_both_stops((dt, &law), MOUNT + i, at, last_nm),
            }
        }
        if solver.is_empty() {
            return free;
        }
        let diagonal = Generalised::ZERO.plus(dt, &d.damping).plus(dt * dt, &d.stiffness);
        pressing::describe(&mut solver.chain, layout, configuration, &diagonal);
        self.coupling.describe(&mut solver.chain);
        solver.solve(pressing::ordered(&free, &mut [0.0; MAX_FREEDOMS], layout.joints), &step, report);
        let mut force: [Spatial; MAX_JOINTS + 1] = [[0.0; 3]; MAX_JOINTS + 1];
        let (mut joint, mut across) = ([0.0; MAX_JOINTS], 0.0);
        solver.impulses(
            |link, impulse, f| {
                for k in 0..3 {
                    force[link][k] += impulse * f[k];
                }
                across += impulse * f[3];
            },
            |freedom, impulse| joint[freedom - MOUNT] += impulse,
        );
        let impulse = Generalised { joint, mount: [0.0, across, 0.0] };
        let mut change = self.articulated.solve(&force, &impulse);
        self.coupling.correct(&mut change);
        free.plus(1.0, &change)
    }

    /// Stores the impulses for the next step and adds the contact moments to the loads.
    fn store_results(&mut self, dt: f64, drive: &BaseDrive, after: &Generalised, report: &mut StepReport) {
        let torque = &mut self.common.state.stop_torque_nm;
        torque.fill(0.0);
        report.stopped_joint_count =
            self.contact.stop_torques(dt, |freedom, value| torque[freedom - MOUNT] += value);
        report.stopped_joint_count += self.pressed.store(dt, &after.joint, torque);
        self.common.store_contacts(&self.contact, dt, drive, &mut self.loads.moment, report);
    }

    /// Takes a ROS2 step in free motion; returns its error estimate. `Err` leaves the state unchanged: ROS2
    /// is off (estimate 0), the motion is not free, or the estimate is above the tolerance.
    fn rosenbrock(&mut self, dt: f64, input: &StepInput, frame: &Frame) -> Result<(Generalised, f64), f64> {
        let wanted =
            self.common.parameters.integrator == Integrator::Hybrid && self.common.contacts_far(dt, input);
        let (q, v) = (self.positions(), self.velocities());
        if !wanted || self.near_stop(&q) {
            return Err(0.0);
        }
        self.pressed.clear();
        let h = GAMMA * dt;
        let d = self.stage((&q, &v), h, input, frame, Stage::Start);
        if self.tendon.channels.bind(&self.tendon.tension_n) {
            return Err(0.0);
        }
        let kv1 = self.solve_loads(&self.elastic_forces(&q, &v, &Generalised::ZERO.plus(h, &v), &d));
        let kq1 = v.plus(h, &kv1);
        if self.turns(&v, &kq1) {
            return Err(0.0);
        }

        let (q2, v2) = (q.plus(dt, &kq1), v.plus(dt, &kv1));
        self.trial.update(&self.layout, &q2.joint, &q2.mount);
        let slid = self.tendon.slides_on;
        let d = self.stage((&q2, &v2), h, input, frame, Stage::Trial);
        if self.tendon.slides_on != slid {
            return Err(0.0);
        }
        // Substituting x = kv2 + 2 kv1: A x = f2 + 2 (h D + h^2 K) kv1 - h K (v2 - 2 kq1); M drops out of the
        // right-hand side.
        let y = Generalised::ZERO.plus(h, &v2.plus(-2.0, &kq1)).plus(-2.0 * h * h, &kv1);
        let mut f = self.elastic_forces(&q2, &v2, &y, &d);
        for i in 0..self.layout.joints {
            f.joint[i] += 2.0 * h * d.damping.joint[i] * kv1.joint[i];
        }
        for k in 0..3 {
            f.mount[k] += 2.0 * h * d.damping.mount[k] * kv1.mount[k];
        }
        let kv2 = self.solve_loads(&f).plus(-2.0, &kv1);
        let kq2 = v2.plus(-2.0, &kq1).plus(h, &kv2);

        let next = q.plus(1.5 * dt, &kq1).plus(0.5 * dt, &kq2);
        let error = largest(&Generalised::ZERO.plus(0.5 * dt, &kq1).plus(0.5 * dt, &kq2).joint);
        let accurate = error <= self.common.parameters.hybrid_tolerance_rad;
        if !accurate || self.near_stop(&next) || !self.contacts_clear(dt, &next, input) {
            return Err(if error.is_finite() { error } else { f64::MAX });
        }
        next.copy_to(&mut self.common.state.position);
        Ok((v.plus(1.5 * dt, &kv1).plus(0.5 * dt, &kv2), error))
    }

    /// Returns the tendons, factored operator and loads of one stage at `q`, `v` in the start or trial
    /// configuration.
    fn stage(
        &mut self,
        (q, v): (&Generalised, &Generalised),
        h: f64,
        input: &StepInput,
        frame: &Frame,
        at: Stage,
    ) -> Diagonals {
        let d = self.factored_with_tendons((q, v), h, input, at);
        let configuration = at.of(&self.configuration, &self.trial);
        self.loads.evaluate(&self.layout, configuration, &v.joint, (&q.mount, &v.mount), frame);
        d
    }

    /// Evaluates the tendons at `q`, assuming velocities `v`, and factors the operator with them.
    fn factored_with_tendons(
        &mut self,
        (q, v): (&Generalised, &Generalised),
        h: f64,
        input: &StepInput,
        at: Stage,
    ) -> Diagonals {
        let configuration = at.of(&self.configuration, &self.trial);
        self.tendon.evaluate(
            &self.layout,
            (configuration, &q.joint, &v.joint),
            &input.tendon,
            &self.common.state.tendon,
        );
        let d = self.diagonals();
        self.factor(h, &d, at);
        d
    }

    fn near_stop(&self, q: &Generalised) -> bool {
        let reach = FREE_SHARE * self.common.parameters.joint_limit_rad;
        self.deflection(q).iter().any(|q| q.abs() > reach)
    }

    /// Returns the joint angles relative to the unloaded ones, rad.
    fn deflection(&self, q: &Generalised) -> [f64; MAX_JOINTS] {
        core::array::from_fn(|i| q.joint[i] - self.rest[i])
    }

    /// Returns true if every sphere still clears its plane in configuration `next`. Leaves `next` in the
    /// trial configuration.
    fn contacts_clear(&mut self, dt: f64, next: &Generalised, input: &StepInput) -> bool {
        if input.contacts.is_empty() {
            return true;
        }
        self.trial.update(&self.layout, &next.joint, &next.mount);
        self.common.contacts_clear(dt, input, |fixed| {
            let point = self.trial.point(fixed.link, fixed.along_m);
            Vector3::new(point[0], next.mount[1], point[1])
        })
    }

    /// Computes the flange reaction, then updates everything that depends on the new state.
    fn finish(
        &mut self,
        dt: f64,
        input: &StepInput,
        (before, after): (&Generalised, &Generalised),
        report: &mut StepReport,
    ) {
        let change = after.plus(-1.0, before);
        let last = if report.integrator == Integrator::Hybrid { Stage::Trial } else { Stage::Start };
        let configuration = last.of(&self.configuration, &self.trial);
        let mut motions: [Spatial; MAX_JOINTS + 1] = [[0.0; 3]; MAX_JOINTS + 1];
        self.articulated.link_motions(&change, &mut motions);
        let lateral = (self.common.state.position[1], change.mount[1]);
        let momentum = Loads::momentum_moment(&self.layout, configuration, &motions, lateral);
        after.copy_to(&mut self.common.state.velocity);
        self.common.react(input, &(self.loads.moment - momentum / dt), report);
        self.follow_state();
        let take_up = |t: usize| self.tendon.take_up(&self.configuration, t);
        self.common.end(input, &self.tendon.channels, take_up, report);
    }
}

fn largest(values: &[f64; MAX_JOINTS]) -> f64 {
    // Let a NaN win: it marks a failed step.
    values.iter().fold(0.0, |m, x| if x.abs() > m || x.is_nan() { x.abs() } else { m })
}
