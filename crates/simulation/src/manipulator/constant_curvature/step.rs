//! One step of the arc: linearly implicit Euler on four degrees of freedom, with contacts as in the other
//! rungs.

use nalgebra::{Matrix4, Vector3, Vector4};

use super::{ConstantCurvature, mass_matrix};
use crate::manipulator::contact::{BaseDrive, ContactPlacement};
use crate::manipulator::error::ManipulatorError;
use crate::manipulator::loads::Frame;
use crate::manipulator::state::{StepInput, StepReport, TendonCommand};
use crate::manipulator::tendon::{base_tension, sign};
use crate::manipulator::{MAX_TENDONS, ManipulatorModel};

/// Index of the bending coordinate.
const BEND: usize = 3;

/// Generalised force of the tendons on the bend, and their contribution to the implicit operator.
struct TendonTorque {
    torque_nm: f64,
    stiffness_nm_per_rad: f64,
    /// True if the step assumes that a tendon's friction does not change: it was sliding at the given rate
    /// and keeps sliding.
    slides_on: bool,
    /// See [`ConstantCurvature::lost`].
    lost: [[f64; 1]; MAX_TENDONS],
}

impl ConstantCurvature {
    /// See [`ManipulatorModel::step`].
    pub(super) fn take_step(&mut self, dt: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        let (drive, frame) = self.common.begin(dt, input)?;
        let (q, before) = (self.position(), self.velocity());
        let (loads, mut moment) = self.loads(&frame);
        let mut tendon = self.tendon_torque(before[3], &input.tendon);
        let (free, operator) = self.free_velocity(dt, &loads, &tendon);
        let mut report = StepReport::none();
        let mut after = self.with_contacts(dt, input, &drive, &operator, free, &mut report);
        if tendon.slides_on && after[3] * before[3] < 0.0 {
            tendon = self.tendon_torque(after[3], &input.tendon);
            let (free, operator) = self.free_velocity(dt, &loads, &tendon);
            report = StepReport::none();
            after = self.with_contacts(dt, input, &drive, &operator, free, &mut report);
        }
        self.lost = tendon.lost;
        self.store(dt, &drive, &mut moment, &mut report);
        moment -= self.momentum_moment(&q, &(after - before)) / dt;
        let state = &mut self.common.state;
        state.position.copy_from_slice((q + after * dt).as_slice());
        state.velocity.copy_from_slice(after.as_slice());
        self.common.react(input, &moment, &mut report);
        self.follow_state();
        let from_rest = self.deflection()[3];
        self.common.end(input, &self.channels, |t| self.channels.offset_m[t][0] * from_rest, &mut report);
        Ok(report)
    }

    /// Returns the velocities after the step without contacts, and the implicit operator with its inverse.
    fn free_velocity(
        &self,
        dt: f64,
        loads: &Vector4<f64>,
        tendon: &TendonTorque,
    ) -> (Vector4<f64>, (Matrix4<f64>, Matrix4<f64>)) {
        let (q, before) = (self.position(), self.velocity());
        let mut stiffness = self.stiffness;
        stiffness[3] = (stiffness[3] + tendon.stiffness_nm_per_rad).max(0.0);
        let mut operator = mass_matrix(&self.lumps, &self.arc, q[3]);
        for k in 0..4 {
            operator[(k, k)] += dt * self.damping[k] + dt * dt * stiffness[k];
        }
        // Positive definite, because all masses are positive and no stiffness is negative.
        let inverse = operator.try_inverse().unwrap_or_else(Matrix4::zeros);
        let elastic = -self.stiffness.component_mul(&self.deflection())
            - self.damping.component_mul(&before)
            - stiffness.component_mul(&(before * dt))
            + Vector4::new(0.0, 0.0, 0.0, tendon.torque_nm);
        (before + inverse * (loads + elastic) * dt, (operator, inverse))
    }

    /// Computes the closed form of the channel: the take-up is `d (bend - rest)`. The tension falls as
    /// `exp(-mu s phi)` along the arc, and the bend sees its mean, `(1 - exp(-x)) / x` with `x = mu s
    /// |bend|`. `rate`, the bend rate, shows whether a saturated sliding state is about to reverse.
    fn tendon_torque(&self, rate: f64, command: &TendonCommand) -> TendonTorque {
        let bend = self.position()[3];
        let lost = [[0.0]; MAX_TENDONS];
        let mut sum = TendonTorque { torque_nm: 0.0, stiffness_nm_per_rad: 0.0, slides_on: false, lost };
        for t in 0..self.channels.count {
            let p = &self.channels.cable[t];
            let slope = self.channels.offset_m[t][0];
            let take_up = self.take_up_m(t);
            let tension = base_tension(p, command, t, take_up);
            if tension <= 0.0 {
                continue;
            }
            let sliding = self.common.state.tendon[t].sliding_at(take_up, p);
            let x = p.friction_coefficient * sliding * bend.abs();
            sum.torque_nm += tension * mean_share(x) * slope;
            sum.lost[t] = [(1.0 - mean_share(x)) * slope];
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

    /// Returns the tendons' stiffness of the bend at constant tensions and sliding states, N m/rad, and the
    /// torque on it per unit of each tension, m.
    pub(super) fn tendons_on_bend(&self) -> (f64, [f64; MAX_TENDONS]) {
        let (bend, state) = (self.position()[BEND], &self.common.state);
        let (mut stiffness, mut pull) = (0.0, [0.0; MAX_TENDONS]);
        for t in 0..self.channels.count {
            let (slope, mu) = (self.channels.offset_m[t][0], self.channels.cable[t].friction_coefficient);
            let (tension, sliding) = (state.report.tendon_tension_n[t], state.tendon[t].sliding);
            let x = if tension > 0.0 { mu * sliding * bend.abs() } else { 0.0 };
            pull[t] = mean_share(x) * slope;
            stiffness -= tension * mean_share_slope(x) * mu * slope * sliding * sign(bend);
        }
        (stiffness, pull)
    }

    /// Returns the generalised loads, and the moment of all loads about the base origin.
    fn loads(&self, frame: &Frame) -> (Vector4<f64>, Vector3<f64>) {
        let (q, v) = (self.position(), self.velocity());
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
        let tip = self.arc.place(self.common.parameters.burr_centre_m(), q[3]);
        let (force, torque) = (&frame.tip_wrench.force_n, &frame.tip_wrench.torque_nm);
        let bend = force.x * tip.first[0] + force.z * tip.first[1] + torque.y;
        loads += Vector4::new(force.x, force.y, force.z, bend);
        let position = Vector3::new(q[0] + tip.point[0], q[1], q[2] + tip.point[1]);
        (loads, moment + position.cross(force) + torque)
    }

    /// Returns the moment about the base origin that changes the velocities by `change`.
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
        let step = self.common.contact_step(dt, drive, input);
        let (arc, q) = (&self.arc, self.position());
        let solver = &mut self.contact;
        solver.collect(
            &step,
            report,
            |_| true,
            |sphere, direction| {
                let lever = direction[0] * -step.spheres[sphere].radius_m;
                let place = arc.place(self.sphere_z_m[sphere], q[3]);
                let point = Vector3::new(q[0] + place.point[0], q[1], q[2] + place.point[1]) + lever;
                let per_bend = Vector3::new(place.first[0], 0.0, place.first[1])
                    + Vector3::y().cross(&lever) * place.share;
                ContactPlacement {
                    link: 0,
                    point,
                    force: direction.map(|d| [d.x, d.y, d.z, d.dot(&per_bend)]),
                }
            },
        );
        let from_rest = q[BEND] - self.rest_rad;
        let last_nm = self.common.state.stop_torque_nm[0];
        if solver.is_empty() {
            solver.collect_stop((dt, &self.stop), (BEND, false), (from_rest, free[BEND]), last_nm);
        } else {
            solver.collect_both_stops((dt, &self.stop), BEND, from_rest, last_nm);
        }
        if solver.is_empty() {
            return free;
        }
        // One body whose motions are the four freedoms: the operator is its inertia.
        for k in 0..4 {
            solver.chain.axis[k] = core::array::from_fn(|j| f64::from(u8::from(j == k)));
            solver.chain.body[0][k] = core::array::from_fn(|j| operator[(k, j)]);
        }
        solver.solve(free.as_slice(), &step, report);
        let (mut impulse, mut stop) = (Vector4::zeros(), 0.0);
        solver.impulses(
            |_, size, force| impulse += Vector4::from_column_slice(force) * size,
            |_, size| stop += size,
        );
        impulse[BEND] += stop;
        free + inverse * impulse
    }

    fn store(&mut self, dt: f64, drive: &BaseDrive, moment: &mut Vector3<f64>, report: &mut StepReport) {
        self.common.store_contacts(&self.contact, dt, drive, moment, report);
        let mut torque = 0.0;
        self.contact.stop_torques(dt, |_, value| torque += value);
        self.common.state.stop_torque_nm[0] = torque;
        report.stopped_joint_count = usize::from(torque != 0.0) * self.joint_count();
    }
}

/// Returns (1 - exp(-x)) / x.
fn mean_share(x: f64) -> f64 {
    if x.abs() < 1e-5 { 1.0 - 0.5 * x } else { -libm::expm1(-x) / x }
}

/// Returns d/dx of [`mean_share`].
fn mean_share_slope(x: f64) -> f64 {
    if x.abs() < 1e-3 { -0.5 + x / 3.0 - x * x / 8.0 } else { (libm::exp(-x) - mean_share(x)) / x }
}
