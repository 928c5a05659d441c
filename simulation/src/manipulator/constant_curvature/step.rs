//! One step of the arc: linearly implicit Euler on four degrees of freedom, contacts by Gauss-Seidel on accumulated impulses.

use nalgebra::{Matrix4, Vector3, Vector4};

use super::{ConstantCurvature, mass_matrix};
use crate::manipulator::contact::{BaseDrive, ContactStep, LastContacts};
use crate::manipulator::error::ManipulatorError;
use crate::manipulator::geometry::SphereKind;
use crate::manipulator::loads::Frame;
use crate::manipulator::row::{Stop, StopLaw, cone, tangents};
use crate::manipulator::state::{ContactResult, StepInput, StepReport, TendonCommand, Wrench};
use crate::manipulator::step::{base_motion, validate};
use crate::manipulator::tendon::{base_tension, sign};

/// One contact: Jacobian rows of normal and tangents.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row {
    contact: usize,
    sphere: usize,
    point: Vector3<f64>,
    direction: [Vector3<f64>; 3],
    jacobian: [Vector4<f64>; 3],
    response: [Vector4<f64>; 3],
    friction: f64,
    drive: [f64; 3],
    compliance: f64,
    target: f64,
    impulse: [f64; 3],
    shift: f64,
}

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
        let (free, inverse) = self.free_velocity(dt, &loads, &tendon);
        let mut report = StepReport::none();
        let mut after = self.with_contacts(dt, input, &drive, &inverse, free, &mut report);
        if tendon.slides_on && after[3] * before[3] < 0.0 {
            let tendon = self.tendon_torque(after[3], &input.tendon);
            let (free, inverse) = self.free_velocity(dt, &loads, &tendon);
            report = StepReport::none();
            after = self.with_contacts(dt, input, &drive, &inverse, free, &mut report);
        }
        self.store(dt, &drive, &mut moment, &mut report);
        self.state.position = q + after * dt;
        moment -= self.momentum_moment(&q, &(after - before)) / dt;
        self.finish(input, &after, moment, &mut report);
        Ok(report)
    }

    /// Velocities after the step without contacts, and the inverse of the implicit operator.
    fn free_velocity(
        &self,
        dt: f64,
        loads: &Vector4<f64>,
        tendon: &TendonTorque,
    ) -> (Vector4<f64>, Matrix4<f64>) {
        let (q, before) = (&self.state.position, &self.state.velocity);
        let mut stiffness = self.stiffness;
        stiffness[3] = (stiffness[3] + tendon.stiffness_nm_per_rad).max(0.0);
        let mut operator = mass_matrix(&self.lumps, &self.arc, q[3]);
        for k in 0..4 {
            operator[(k, k)] += dt * self.damping[k] + dt * dt * stiffness[k];
        }
        // Positive definite, because all masses are positive and no stiffness is negative.
        let inverse = operator.try_inverse().unwrap_or_else(Matrix4::zeros);
        let elastic = -self.stiffness.component_mul(q)
            - self.damping.component_mul(before)
            - stiffness.component_mul(&(before * dt))
            + Vector4::new(0.0, 0.0, 0.0, tendon.torque_nm);
        (before + inverse * (loads + elastic) * dt, inverse)
    }

    /// Closed form of the channel: the take-up is `side d bend`. The tension falls as `exp(-mu s phi)` along the arc, and the bend sees
    /// its mean, `(1 - exp(-x)) / x` with `x = mu s |bend|`. `rate`, the bend rate, tells whether a saturated sliding state is about to
    /// reverse.
    fn tendon_torque(&self, rate: f64, command: &TendonCommand) -> TendonTorque {
        let p = &self.parameters.tendon;
        let bend = self.state.position[3];
        let mut sum = TendonTorque { torque_nm: 0.0, stiffness_nm_per_rad: 0.0, slides_on: false };
        for t in 0..self.channels.count {
            let slope = self.channels.offset_m[t][0];
            let take_up = slope * bend;
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
        let p = &self.parameters;
        let burr = p.joint_positions_m[p.joint_positions_m.len() - 1] + p.tip_offset_m;
        let tip = self.arc.place(burr, q[3]);
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
        inverse: &Matrix4<f64>,
        free: Vector4<f64>,
        report: &mut StepReport,
    ) -> Vector4<f64> {
        self.collect(dt, input, drive, inverse, report);
        self.collect_stop(dt, &free);
        let stop_response = inverse.column(3).into_owned();
        let mut velocity = free;
        for row in &self.rows {
            velocity += (0..3).map(|j| row.response[j] * row.impulse[j]).sum::<Vector4<f64>>();
        }
        if let Some(stop) = &self.stop {
            velocity += stop_response * (stop.sign * stop.impulse);
        }
        let contact = &self.parameters.contact;
        let any = !self.rows.is_empty() || self.stop.is_some();
        while any && report.iterations < contact.max_iterations {
            report.iterations += 1;
            let mut residual = 0.0f64;
            self.rows.iter_mut().for_each(|row| row.relax(&mut velocity, &mut residual));
            if let Some(stop) = &mut self.stop {
                relax_stop(stop, &stop_response, &mut velocity, &mut residual);
            }
            report.residual_m_per_s = residual;
            if residual <= contact.tolerance_m_per_s {
                break;
            }
        }
        velocity
    }

    fn collect(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        inverse: &Matrix4<f64>,
        report: &mut StepReport,
    ) {
        self.rows.clear();
        self.used.fill(false);
        let contact = self.parameters.contact;
        let step = ContactStep { dt, drive, planes: input.contacts, parameters: &contact };
        let results = &self.state.results[..self.state.result_count];
        let mut last = LastContacts { results, used: &mut self.used };
        let considered = input.contacts.iter().take(last.used.len());
        let q = &self.state.position;
        for (index, plane) in considered.enumerate() {
            let Some(sphere) = self.sphere_layout.get(plane.sphere_index) else { continue };
            if !plane.is_usable() {
                continue;
            }
            let normal = drive.rotation.inverse_transform_vector(plane.normal.as_ref());
            let [t0, t1] = tangents(&normal);
            let lever = normal * -sphere.radius_m;
            let place = self.arc.place(self.sphere_z_m[plane.sphere_index], q[3]);
            let point = Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]) + lever;
            let per_bend =
                Vector3::new(place.first[0], 0.0, place.first[1]) + Vector3::y().cross(&lever) * place.share;
            let direction = [normal, t0, t1];
            let jacobian = direction.map(|d| Vector4::new(d.x, d.y, d.z, d.dot(&per_bend)));
            let base_velocity = drive.linear + drive.angular.cross(&point);
            let (target, impulse) = last.start(&step, plane, &[t0, t1]);
            let row = Row {
                contact: index,
                sphere: plane.sphere_index,
                point,
                direction,
                jacobian,
                response: jacobian.map(|j| inverse * j),
                friction: contact.friction_of(sphere.kind),
                drive: direction.map(|d| d.dot(&base_velocity)),
                compliance: step.compliance(),
                target,
                impulse,
                shift: 0.0,
            };
            report.max_overlap_m = report.max_overlap_m.max(-plane.gap_m);
            self.rows.push(row);
        }
        self.rows.sort_unstable_by_key(|row| (row.sphere, row.contact));
        report.contact_count = self.rows.len();
        report.refused_contact_count = input.contacts.len() - self.rows.len();
    }

    fn collect_stop(&mut self, dt: f64, free: &Vector4<f64>) {
        let law = StopLaw { limit_rad: self.limit_rad, stiffness_nm_per_rad: self.stop_stiffness_nm_per_rad };
        self.stop = law.near(dt, self.state.position[3], free[3], self.state.stop_torque_nm);
    }

    fn store(&mut self, dt: f64, drive: &BaseDrive, moment: &mut Vector3<f64>, report: &mut StepReport) {
        self.state.result_count = self.rows.len();
        for (slot, row) in self.state.results.iter_mut().zip(&self.rows) {
            let [normal, t0, t1] = row.direction;
            let friction = (t0 * row.impulse[1] + t1 * row.impulse[2]) / dt;
            let normal_force = normal * (row.impulse[0] / dt);
            *moment += row.point.cross(&(normal_force + friction));
            report.active_contact_count += usize::from(row.impulse[0] > 0.0);
            if self.sphere_layout[row.sphere].kind == SphereKind::Burr {
                report.burr_normal_force_n += drive.rotation * normal_force;
            }
            *slot = ContactResult {
                contact_index: row.contact,
                sphere_index: row.sphere,
                normal: drive.rotation * normal,
                normal_force_n: row.impulse[0] / dt,
                friction_force_n: drive.rotation * friction,
            };
        }
        self.state.stop_torque_nm = self.stop.map_or(0.0, |stop| stop.sign * stop.impulse / dt);
        report.stopped_joint_count = usize::from(self.state.stop_torque_nm != 0.0) * self.bend[0].len();
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
        let p = &self.parameters.tendon;
        for t in 0..self.channels.count {
            let take_up_m = self.channels.offset_m[t][0] * self.state.position[3];
            (report.tendon_tension_n[t], report.tendon_displacement_m[t]) =
                self.state.tendon[t].advance(take_up_m, p, &input.tendon, t);
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

impl Row {
    /// Relaxes the contact: the normal impulse first, then friction within its Coulomb cone.
    fn relax(&mut self, velocity: &mut Vector4<f64>, residual: &mut f64) {
        let mobility = |a: usize, b: usize, row: &Row| row.jacobian[a].dot(&row.response[b]);
        let old = self.impulse;
        let speed = self.jacobian[0].dot(velocity) + self.drive[0];
        let whole = mobility(0, 0, self) + self.compliance;
        let normal = (old[0] + (self.target - speed - self.compliance * old[0]) / whole).max(0.0);
        *residual = residual.max((normal - old[0]).abs() * whole);
        *velocity += self.response[0] * (normal - old[0]);
        self.impulse[0] = normal;
        let radius = self.friction * normal;
        let mut new = [0.0; 2];
        if radius > 0.0 {
            // The arc has a single bending coordinate, so only the mount keeps the tangential mobility regular.
            let w = [mobility(1, 1, self), mobility(1, 2, self), mobility(2, 2, self)];
            let free = [1, 2].map(|k| self.jacobian[k].dot(velocity) + self.drive[k]);
            let free = [free[0] - w[0] * old[1] - w[1] * old[2], free[1] - w[1] * old[1] - w[2] * old[2]];
            new = cone(&w, &free, radius, &mut self.shift);
            *residual = residual.max((w[0] * (new[0] - old[1])).abs()).max((w[2] * (new[1] - old[2])).abs());
        }
        for k in 0..2 {
            *velocity += self.response[k + 1] * (new[k] - old[k + 1]);
        }
        self.impulse = [normal, new[0], new[1]];
    }
}

/// Relaxes the joint stop. `response` is the velocity change caused by a unit impulse on the bend.
fn relax_stop(stop: &mut Stop, response: &Vector4<f64>, velocity: &mut Vector4<f64>, residual: &mut f64) {
    let whole = response[3] + stop.compliance;
    let speed = stop.sign * velocity[3] + stop.compliance * stop.impulse;
    let impulse = (stop.impulse + (stop.target - speed) / whole).max(0.0);
    let change = impulse - stop.impulse;
    stop.impulse = impulse;
    *velocity += response * (stop.sign * change);
    *residual = residual.max(change.abs() * whole);
}
