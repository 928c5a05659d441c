//! One step of the chain.
//!
//! Linearly implicit Euler: `(M + dt D + dt^2 K) dv = dt (f - dt K v) + J' P`, where the contact impulses P come from the same velocity
//! solve, then `q += dt v`. A state at rest in contact is an exact equilibrium. ROS2 (see [`Integrator::Hybrid`]) solves the same
//! operator twice, with gamma dt in place of dt.

use nalgebra::{Point3, Vector3};

use super::articulated::{Generalised, Spatial};
use super::contact::{BaseDrive, ContactStep, Place};
use super::error::{ManipulatorError, check};
use super::geometry::{SphereKind, SphereLayout};
use super::loads::{Frame, Loads};
use super::parameters::Integrator;
use super::pressing::{self, MAX_FREEDOMS};
use super::state::{BaseMotion, ProxySphere, StepInput, StepReport, Wrench};
use super::tendon::turns;
use super::validation::validate;
use super::{MAX_JOINTS, Manipulator};

/// 1 - 1/sqrt 2, the choice that makes ROS2 L-stable.
pub(super) const GAMMA: f64 = 1.0 - core::f64::consts::FRAC_1_SQRT_2;
/// A Rosenbrock step requires every flexure to be within this fraction of its stop.
pub(super) const FREE_SHARE: f64 = 0.9;
/// Maximum solves per step of linearly implicit Euler. Each one drops the assumptions that the previous one violated.
pub(super) const MAX_ROUNDS: usize = 4;
/// A Rosenbrock step requires every contact candidate to stay farther away than this at the current velocity, m.
const CLEARANCE_M: f64 = 50.0e-6;

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
    /// Advances by `dt_s` (1e-7 to 0.1 s). Refused input is an error and changes nothing. Unusable contacts are skipped and counted in
    /// the report.
    pub fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        validate(dt_s, input)?;
        let (drive, frame) = base_motion(&self.state.base, &self.parameters.gravity_m_per_s2, dt_s, input)?;
        let before = self.velocities();
        let rosenbrock = self.rosenbrock(dt_s, input, &frame);
        let mut report = StepReport::none();
        let after = match rosenbrock {
            Ok((after, error)) => {
                report.integrator = Integrator::Hybrid;
                report.error_estimate_rad = error;
                self.state.result_count = 0;
                self.state.stop_torque_nm = [0.0; MAX_JOINTS];
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
        Generalised { joint: self.state.joint_velocity_rad_per_s, mount: self.state.mount_velocity_m_per_s }
    }

    fn positions(&self) -> Generalised {
        Generalised { joint: self.state.joint_position_rad, mount: self.state.mount_displacement_m }
    }

    /// Damping, and stiffness including pressed stops and the tendons' diagonal part (never below zero).
    fn diagonals(&self) -> Diagonals {
        let mut stiffness =
            Generalised { joint: self.stiffness, mount: self.parameters.mount_stiffness_n_per_m };
        for (i, stop) in self.pressed.stiffness().iter().enumerate() {
            stiffness.joint[i] = (stiffness.joint[i] + self.tendon.stiffness[i]).max(0.0) + stop;
        }
        let damping = Generalised { joint: self.damping, mount: self.mount_damping };
        Diagonals { stiffness, damping }
    }

    /// Generalised forces of springs, dampers and tendons at `q`, `v`, minus `K y`.
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
            let stiffness = self.parameters.mount_stiffness_n_per_m[k];
            f.mount[k] = -stiffness * (q.mount[k] + y.mount[k]) - self.mount_damping[k] * v.mount[k];
        }
        self.coupling.subtract_stiffness(&y.joint, 1.0, &mut f.joint);
        f
    }

    /// Factors M + h D + h^2 K with its coupling.
    fn factor(&mut self, h: f64, d: &Diagonals, at: Stage) {
        let diagonal = Generalised::ZERO.plus(h, &d.damping).plus(h * h, &d.stiffness);
        let configuration = at.of(&self.configuration, &self.trial);
        self.articulated.factor(&self.layout, configuration, &diagonal);
        self.coupling.update(&self.articulated, &self.tendon, h * h);
    }

    /// A^-1 (f + loads).
    fn solve_loads(&self, f: &Generalised) -> Generalised {
        let mut rhs = *f;
        rhs.mount[1] += self.loads.lateral;
        self.coupling.correct(self.articulated.solve(&self.loads.force, &rhs))
    }

    fn linearly_implicit_euler(
        &mut self,
        dt: f64,
        input: &StepInput,
        (drive, frame): (&BaseDrive, &Frame),
        report: &mut StepReport,
    ) -> Generalised {
        let (q, v) = (self.positions(), self.velocities());
        self.pressed.collect(&self.parameters, dt, &self.deflection(&q), &self.state.stop_torque_nm);
        let mut d = self.stage((&q, &v), dt, input, frame, Stage::Start);
        let (mut round, mut expected) = (1, v);
        let after = loop {
            let free = self.free_velocity(dt, (&q, &v), &d);
            let after = self.with_contacts(dt, input, drive, &d, free, report);
            let turned = self.turns(&expected, &after);
            let released = self.pressed.release(dt, &after.joint, &self.state.stop_torque_nm);
            if round == MAX_ROUNDS || !(turned || released) {
                break after;
            }
            if turned {
                expected = after;
            }
            d = self.factored_with_tendons((&q, &expected), dt, input, Stage::Start);
            round += 1;
        };
        self.store_results(dt, drive, &after, report);
        let next = q.plus(dt, &after);
        self.state.joint_position_rad = next.joint;
        self.state.mount_displacement_m = next.mount;
        after
    }

    fn turns(&self, before: &Generalised, after: &Generalised) -> bool {
        turns(&self.tendon.slides_on, &self.tendon.slope, [&before.joint, &after.joint])
    }

    /// Velocities after the step without contacts.
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
        free: Generalised,
        report: &mut StepReport,
    ) -> Generalised {
        let parameters = &self.parameters.contact;
        let step = ContactStep { dt, drive, planes: input.contacts, parameters };
        let (layout, configuration, state) = (&self.layout, &self.configuration, &self.state);
        let lateral_m = state.mount_displacement_m[1];
        let results = &state.results[..state.result_count];
        let solver = &mut self.contact;
        solver.collect(
            &step,
            &layout.spheres,
            results,
            |_, _| true,
            |sphere, direction| {
                let SphereLayout { link, along_m, radius_m, .. } = layout.spheres[sphere];
                let centre = configuration.point(link, along_m);
                let point = Vector3::new(centre[0], lateral_m, centre[1]) - direction[0] * radius_m;
                Place { link, point, force: direction.map(|d| pressing::force(&point, &d)) }
            },
        );
        let law = self.parameters.stop_law();
        for i in (0..layout.joints).filter(|i| !self.pressed.has(*i)) {
            let moving = (state.joint_position_rad[i] - self.rest[i], free.joint[i]);
            solver.collect_stop((dt, &law), pressing::MOUNT + i, moving, state.stop_torque_nm[i]);
        }
        report.refused_contact_count = solver.refused;
        report.contact_count = solver.contact.len();
        report.max_overlap_m = solver.max_overlap_m;
        if solver.is_empty() {
            return free;
        }
        let diagonal = Generalised::ZERO.plus(dt, &d.damping).plus(dt * dt, &d.stiffness);
        pressing::describe(&mut solver.chain, layout, configuration, &diagonal);
        self.coupling.describe(pressing::MOUNT, &mut solver.chain);
        let outcome =
            solver.solve(pressing::ordered(&free, &mut [0.0; MAX_FREEDOMS], layout.joints), parameters);
        report.contact_iterations = outcome.iterations;
        report.contact_residual_m_per_s = outcome.residual;
        let mut force: [Spatial; MAX_JOINTS + 1] = [[0.0; 3]; MAX_JOINTS + 1];
        let (mut joint, mut across) = ([0.0; MAX_JOINTS], 0.0);
        solver.impulses(
            |link, impulse, f| {
                for k in 0..3 {
                    force[link][k] += impulse * f[k];
                }
                across += impulse * f[3];
            },
            |freedom, impulse| joint[freedom - pressing::MOUNT] += impulse,
        );
        let impulse = Generalised { joint, mount: [0.0, across, 0.0] };
        free.plus(1.0, &self.coupling.correct(self.articulated.solve(&force, &impulse)))
    }

    /// Stores the impulses for the next step and adds the contact moments to the loads.
    fn store_results(&mut self, dt: f64, drive: &BaseDrive, after: &Generalised, report: &mut StepReport) {
        let torque = &mut self.state.stop_torque_nm;
        torque.fill(0.0);
        report.stopped_joint_count =
            self.contact.stop_torques(dt, |freedom, value| torque[freedom - pressing::MOUNT] = value);
        report.stopped_joint_count += self.pressed.store(dt, &after.joint, torque);
        self.state.result_count = self.contact.contact.len();
        for k in 0..self.contact.contact.len() {
            let result = self.contact.result(k, dt, &drive.rotation);
            let normal_force = result.normal * result.normal_force_n;
            let force = drive.rotation.inverse_transform_vector(&(normal_force + result.friction_force_n));
            self.loads.moment += self.contact.contact[k].point.cross(&force);
            report.active_contact_count += usize::from(result.normal_force_n > 0.0);
            if self.layout.spheres[result.sphere_index].kind == SphereKind::Burr {
                report.burr_normal_force_n += normal_force;
            }
            self.state.results[k] = result;
        }
    }

    /// Takes a ROS2 step in free motion; returns its error estimate. `Err` leaves the state unchanged: ROS2 is off (estimate 0), the
    /// motion is not free, or the estimate is above the tolerance.
    fn rosenbrock(&mut self, dt: f64, input: &StepInput, frame: &Frame) -> Result<(Generalised, f64), f64> {
        let wanted =
            self.parameters.integrator == Integrator::Hybrid && contacts_far(&self.spheres, dt, input);
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
        // Substituting x = kv2 + 2 kv1: A x = f2 + 2 (h D + h^2 K) kv1 - h K (v2 - 2 kq1); M drops out of the right-hand side.
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
        let accurate = error <= self.parameters.hybrid_tolerance_rad;
        if !accurate || self.near_stop(&next) || !self.contacts_clear(&next, input) {
            return Err(if error.is_finite() { error } else { f64::MAX });
        }
        self.state.joint_position_rad = next.joint;
        self.state.mount_displacement_m = next.mount;
        Ok((v.plus(1.5 * dt, &kv1).plus(0.5 * dt, &kv2), error))
    }

    /// Tendons, factored operator and loads of one stage at `q`, `v` in the start or trial configuration.
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
            &self.state.tendon,
        );
        let d = self.diagonals();
        self.factor(h, &d, at);
        d
    }

    fn near_stop(&self, q: &Generalised) -> bool {
        let reach = FREE_SHARE * self.parameters.joint_limit_rad;
        self.deflection(q).iter().any(|q| q.abs() > reach)
    }

    /// Joint angles from those without load, rad.
    fn deflection(&self, q: &Generalised) -> [f64; MAX_JOINTS] {
        core::array::from_fn(|i| q.joint[i] - self.rest[i])
    }

    /// True if every sphere still clears its plane in configuration `next`. Leaves `next` in the trial configuration.
    fn contacts_clear(&mut self, next: &Generalised, input: &StepInput) -> bool {
        if input.contacts.is_empty() {
            return true;
        }
        self.trial.update(&self.layout, &next.joint, &next.mount);
        input.contacts.iter().all(|c| {
            let fixed = &self.layout.spheres[c.sphere_index];
            let point = self.trial.point(fixed.link, fixed.along_m);
            let local = Point3::new(point[0], next.mount[1], point[1]);
            let moved = (input.base.t_world_base * local).coords - self.spheres[c.sphere_index].centre_m;
            c.gap_m + moved.dot(&c.normal) > 0.0
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
        let lateral = (self.state.mount_displacement_m[1], change.mount[1]);
        let momentum = Loads::momentum_moment(&self.layout, configuration, &motions, lateral);
        let moment = self.loads.moment - momentum / dt;
        self.state.joint_velocity_rad_per_s = after.joint;
        self.state.mount_velocity_m_per_s = after.mount;
        let mount = |k: usize| {
            self.parameters.mount_stiffness_n_per_m[k] * self.state.mount_displacement_m[k]
                + self.mount_damping[k] * self.state.mount_velocity_m_per_s[k]
        };
        let force = Vector3::new(mount(0), mount(1), mount(2));
        let rotation = input.base.t_world_base.rotation;
        report.flange_wrench = Wrench { force_n: rotation * force, torque_nm: rotation * moment };
        self.state.base = input.base;
        self.update_configuration();
        (report.tendon_tension_n, report.tendon_displacement_m) =
            self.tendon.advance(&self.configuration, &input.tendon, &mut self.state.tendon);
        self.state.report = *report;
    }
}

/// Mean base velocity over the step, and the base acceleration from the stated velocities.
pub(super) fn base_motion(
    old: &BaseMotion,
    gravity_m_per_s2: &Vector3<f64>,
    dt: f64,
    input: &StepInput,
) -> Result<(BaseDrive, Frame), ManipulatorError> {
    let new = &input.base;
    let rotation = old.t_world_base.rotation;
    let to_base = |v: Vector3<f64>| rotation.inverse_transform_vector(&v);
    let moved = (new.t_world_base.translation.vector - old.t_world_base.translation.vector) / dt;
    let turned = (new.t_world_base.rotation * rotation.inverse()).scaled_axis() / dt;
    let allowed = "a pose that the base reaches within the step at no more than 100 m/s and 1000 rad/s";
    check("base.t_world_base speed", libm::sqrt(moved.norm_squared()), allowed, |v| v <= 100.0)?;
    check("base.t_world_base turn", libm::sqrt(turned.norm_squared()), allowed, |v| v <= 1000.0)?;
    let acceleration = (new.linear_velocity_m_per_s - old.linear_velocity_m_per_s) / dt;
    let turn = (new.angular_velocity_rad_per_s - old.angular_velocity_rad_per_s) / dt;
    let drive = BaseDrive { rotation, linear: to_base(moved), angular: to_base(turned) };
    let frame = Frame {
        gravity: to_base(gravity_m_per_s2 - acceleration),
        angular_velocity: to_base(new.angular_velocity_rad_per_s),
        angular_acceleration: to_base(turn),
        tip_wrench: Wrench {
            force_n: to_base(input.tip_wrench.force_n),
            torque_nm: to_base(input.tip_wrench.torque_nm),
        },
    };
    Ok((drive, frame))
}

/// True if no sphere reaches its plane within the step at its current velocity. An unusable contact counts as near, so that the Euler
/// step refuses and counts it.
pub(super) fn contacts_far(spheres: &[ProxySphere], dt: f64, input: &StepInput) -> bool {
    input.contacts.iter().all(|c| {
        let far = |s: &ProxySphere| c.gap_m + dt * s.velocity_m_per_s.dot(&c.normal) > CLEARANCE_M;
        c.gap_m > CLEARANCE_M && spheres.get(c.sphere_index).is_some_and(far)
    })
}

fn largest(values: &[f64; MAX_JOINTS]) -> f64 {
    // Let a NaN win: it marks a failed step.
    values.iter().fold(0.0, |m, x| if x.abs() > m || x.is_nan() { x.abs() } else { m })
}
