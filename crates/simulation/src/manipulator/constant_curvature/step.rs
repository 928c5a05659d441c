//! One step of the arc: linearly implicit Euler on four degrees of freedom, contacts as in the other rungs.

use nalgebra::{Matrix4, Vector3, Vector4};

use super::{ConstantCurvature, mass_matrix};
use crate::manipulator::contact::{BaseDrive, ContactStep, Place};
use crate::manipulator::error::ManipulatorError;
use crate::manipulator::geometry::SphereKind;
use crate::manipulator::loads::Frame;
use crate::manipulator::row::StopLaw;
use crate::manipulator::state::{StepInput, StepReport, TendonCommand, Wrench};
use crate::manipulator::step::base_motion;
use crate::manipulator::tendon::{base_tension, sign};
use crate::manipulator::validation::validate;

/// Index of the bending coordinate.
const BEND: usize = 3;

/// Generalised force of the tendons on the bend, and their contribution to the implicit operator.
struct TendonTorque {
    torque_nm: f64,
    stiffness_nm_per_rad: f64,
    /// True if the step assumes that a tendon's friction does not change: it was sliding at the given rate and keeps sliding.
    slides_on: bool,
}

impl ConstantCurvature {
    /// Advances by `dt_s` (1e-7 to 0.1 s). Unusable contacts are skipped and counted in the report.
    ///
    /// # Errors
    /// The input is not finite or out of range. A refused step changes nothing.
    pub fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        validate(dt_s, input)?;
        let gravity = &self.parameters.gravity_m_per_s2;
        let (drive, frame) = base_motion(&self.state.base, gravity, dt_s, input)?;
        let dt = dt_s;
        let (q, before) = (self.state.position, self.state.velocity);
        let (loads, mut moment) = self.loads(&frame);
        let tendon = self.tendon_torque(before[3], &input.tendon);
        let (free, operator) = self.free_velocity(dt, &loads, &tendon);
        let mut report = StepReport::none();
        let mut after = self.with_contacts(dt, input, &drive, &operator, free, &mut report);
        if tendon.slides_on && after[3] * before[3] < 0.0 {
            let tendon = self.tendon_torque(after[3], &input.tendon);
            let (free, operator) = self.free_velocity(dt, &loads, &tendon);
            report = StepReport::none();
            after = self.with_contacts(dt, input, &drive, &operator, free, &mut report);
        }
        self.store(dt, &drive, &mut moment, &mut report);
        self.state.position = q + after * dt;
        moment -= self.momentum_moment(&q, &(after - before)) / dt;
        self.finish(input, &after, moment, &mut report);
        Ok(report)
    }

    /// Velocities after the step without contacts, and the implicit operator with its inverse.
    fn free_velocity(
        &self,
        dt: f64,
        loads: &Vector4<f64>,
        tendon: &TendonTorque,
    ) -> (Vector4<f64>, (Matrix4<f64>, Matrix4<f64>)) {
        let (q, before) = (&self.state.position, &self.state.velocity);
        let mut stiffness = self.stiffness;
        stiffness[3] = (stiffness[3] + tendon.stiffness_nm_per_rad).max(0.0);
        let mut operator = mass_matrix(&self.lumps, &self.arc, q[3]);
        for k in 0..4 {
            operator[(k, k)] += dt * self.damping[k] + dt * dt * stiffness[k];
        }
        // Positive definite, because all masses are positive and no stiffness is negative.
        let inverse = operator.try_inverse().unwrap_or_else(Matrix4::zeros);
        let elastic = -self.stiffness.component_mul(&self.deflection())
            - self.damping.component_mul(before)
            - stiffness.component_mul(&(before * dt))
            + Vector4::new(0.0, 0.0, 0.0, tendon.torque_nm);
        (before + inverse * (loads + elastic) * dt, (operator, inverse))
    }

    /// Closed form of the channel: the take-up is `d (bend - rest)`. The tension falls as `exp(-mu s phi)` along the arc, and the bend sees
    /// its mean, `(1 - exp(-x)) / x` with `x = mu s |bend|`. `rate`, the bend rate, tells whether a saturated sliding state is about to
    /// reverse.
    fn tendon_torque(&self, rate: f64, command: &TendonCommand) -> TendonTorque {
        let bend = self.state.position[3];
        let mut sum = TendonTorque { torque_nm: 0.0, stiffness_nm_per_rad: 0.0, slides_on: false };
        for t in 0..self.channels.count {
            let p = &self.channels.cable[t];
            let slope = self.channels.offset_m[t][0];
            let take_up = self.take_up_m(t);
            let tension = base_tension(p, command, t, take_up);
            if tension <= 0.0 {
                continue;
            }
            let sliding = self.state.tendon[t].sliding_at(take_up, p);
            let x = p.friction_coefficient * sliding * bend.abs();
            sum.torque_nm += tension * mean_share(x) * slope;
            if command.is_displacement() {
                sum.stiffness_nm_per_rad += p.stiffness_n_per_m * mean_share(x) * slope * slope;
            }
            let loss = -tension * mean_share_slope(x) * p.friction_coefficient * slope;
            sum.stiffness_nm_per_rad += loss * sliding * sign(bend);
            if sliding.abs() >= 1.0 && sliding * slope * rate >= 0.0 {
                sum.slides_on |= p.friction_coefficient > 0.0;
            } else {
                sum.stiffness_nm_per_rad += loss * bend.abs() / p.presliding_m * slope;
            }
        }
        sum
    }

    /// Generalised loads, and the moment of all loads about the base origin.
    fn loads(&self, frame: &Frame) -> (Vector4<f64>, Vector3<f64>) {
        let (q, v) = (&self.state.position, &self.state.velocity);
        let (mut loads, mut moment) = (Vector4::zeros(), Vector3::zeros());
        let w = &frame.angular_velocity;
        for lump in &self.lumps {
            let place = self.arc.place(lump.z_m, q[3]);
            let position = Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]);
            let [x, z] = place.first;
            let velocity = Vector3::new(v[0] + v[3] * x, v[1], v[2] + v[3] * z);
            let own = Vector3::new(place.second[0], 0.0, place.second[1]) * (v[3] * v[3]);
            let force = (frame.gravity
                - own
                - frame.angular_acceleration.cross(&position)
                - w.cross(&w.cross(&position))
                - w.cross(&velocity) * 2.0)
                * lump.mass_kg;
            let spin = -lump.inertia_kg_m2 * frame.angular_acceleration.y;
            loads += Vector4::new(force.x, force.y, force.z, force.x * x + force.z * z + place.share * spin);
            moment += position.cross(&force) + Vector3::new(0.0, spin, 0.0);
        }
        let tip = self.arc.place(self.parameters.burr_centre_m(), q[3]);
        let (force, torque) = (&frame.tip_wrench.force_n, &frame.tip_wrench.torque_nm);
        let bend = force.x * tip.first[0] + force.z * tip.first[1] + torque.y;
        loads += Vector4::new(force.x, force.y, force.z, bend);
        let position = Vector3::new(q[0] + tip.point[0], q[1], q[2] + tip.point[1]);
        (loads, moment + position.cross(force) + torque)
    }

    /// The moment about the base origin that changes the velocities by `change`.
    fn momentum_moment(&self, q: &Vector4<f64>, change: &Vector4<f64>) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for lump in &self.lumps {
            let place = self.arc.place(lump.z_m, q[3]);
            let position = Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]);
            let [x, z] = place.first;
            let v = Vector3::new(change[0] + change[3] * x, change[1], change[2] + change[3] * z);
            sum += position.cross(&(v * lump.mass_kg));
            sum.y += lump.inertia_kg_m2 * place.share * change[3];
        }
        sum
    }

    fn with_contacts(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        (operator, inverse): &(Matrix4<f64>, Matrix4<f64>),
        free: Vector4<f64>,
        report: &mut StepReport,
    ) -> Vector4<f64> {
        let parameters = self.parameters.contact;
        let step = ContactStep { dt, drive, planes: input.contacts, parameters: &parameters };
        let (arc, spheres, q) = (&self.arc, &self.sphere_layout, &self.state.position);
        let results = &self.state.results[..self.state.result_count];
        let solver = &mut self.contact;
        solver.collect(
            &step,
            spheres,
            results,
            |_, _| true,
            |sphere, direction| {
                let lever = direction[0] * -spheres[sphere].radius_m;
                let place = arc.place(self.sphere_z_m[sphere], q[3]);
                let point = Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]) + lever;
                let per_bend = Vector3::new(place.first[0], 0.0, place.first[1])
                    + Vector3::y().cross(&lever) * place.share;
                Place { link: 0, point, force: direction.map(|d| [d.x, d.y, d.z, d.dot(&per_bend)]) }
            },
        );
        let law = StopLaw { limit_rad: self.limit_rad, stiffness_nm_per_rad: self.stop_stiffness_nm_per_rad };
        let from_rest = q[BEND] - self.rest_rad;
        solver.collect_stop((dt, &law), BEND, (from_rest, free[BEND]), self.state.stop_torque_nm);
        report.refused_contact_count = solver.refused;
        report.contact_count = solver.contact.len();
        report.max_overlap_m = solver.max_overlap_m;
        if solver.is_empty() {
            return free;
        }
        // One body whose four freedoms are its motions: the operator is its inertia.
        for k in 0..4 {
            solver.chain.axis[k] = core::array::from_fn(|j| f64::from(u8::from(j == k)));
            solver.chain.body[0][k] = core::array::from_fn(|j| operator[(k, j)]);
        }
        let outcome = solver.solve(free.as_slice(), &parameters);
        report.contact_iterations = outcome.iterations;
        report.contact_residual_m_per_s = outcome.residual;
        let (mut impulse, mut stop) = (Vector4::zeros(), 0.0);
        solver.impulses(
            |_, size, force| impulse += Vector4::from_column_slice(force) * size,
            |_, size| stop += size,
        );
        impulse[BEND] += stop;
        free + inverse * impulse
    }

    fn store(&mut self, dt: f64, drive: &BaseDrive, moment: &mut Vector3<f64>, report: &mut StepReport) {
        let solver = &self.contact;
        self.state.result_count = solver.contact.len();
        for (k, slot) in self.state.results.iter_mut().enumerate().take(solver.contact.len()) {
            let result = solver.result(k, dt, &drive.rotation);
            let normal_force = result.normal * result.normal_force_n;
            let force = drive.rotation.inverse_transform_vector(&(normal_force + result.friction_force_n));
            *moment += solver.contact[k].point.cross(&force);
            report.active_contact_count += usize::from(result.normal_force_n > 0.0);
            if self.sphere_layout[result.sphere_index].kind == SphereKind::Burr {
                report.burr_normal_force_n += normal_force;
            }
            *slot = result;
        }
        let mut torque = 0.0;
        solver.stop_torques(dt, |_, value| torque = value);
        self.state.stop_torque_nm = torque;
        report.stopped_joint_count = usize::from(torque != 0.0) * self.bend[0].len();
    }

    /// Computes the flange reaction, then updates everything that depends on the new state.
    fn finish(
        &mut self,
        input: &StepInput,
        after: &Vector4<f64>,
        moment: Vector3<f64>,
        report: &mut StepReport,
    ) {
        self.state.velocity = *after;
        let force = self.stiffness.component_mul(&self.state.position) + self.damping.component_mul(after);
        let rotation = input.base.t_world_base.rotation;
        report.flange_wrench = Wrench { force_n: rotation * force.xyz(), torque_nm: rotation * moment };
        self.state.base = input.base;
        self.update_configuration();
        for t in 0..self.channels.count {
            let (take_up_m, cable) = (self.take_up_m(t), &self.channels.cable[t]);
            (report.tendon_tension_n[t], report.tendon_displacement_m[t]) =
                self.state.tendon[t].advance(take_up_m, cable, &input.tendon, t);
        }
        self.state.report = *report;
    }
}

/// (1 - exp(-x)) / x.
fn mean_share(x: f64) -> f64 {
    if x.abs() < 1e-5 { 1.0 - 0.5 * x } else { -libm::expm1(-x) / x }
}

/// d/dx of [`mean_share`].
fn mean_share_slope(x: f64) -> f64 {
    if x.abs() < 1e-3 { -0.5 + x / 3.0 - x * x / 8.0 } else { (libm::exp(-x) - mean_share(x)) / x }
}
