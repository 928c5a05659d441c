//! The contacts of a step: which of them the solver looks at, and what it finds.

use nalgebra::Vector3;

use super::MomentModes;
use super::step::plus;
use crate::manipulator::contact::{BaseDrive, ContactStep, Place};
use crate::manipulator::geometry::{SphereKind, SphereLayout};
use crate::manipulator::pressing::force;
use crate::manipulator::state::{StepInput, StepReport};
use crate::manipulator::step::MAX_ROUNDS;

/// Contacts farther than this from where the tool goes on to, m, do not enter the solver at first.
const NEAR_M: f64 = 5.0e-6;

impl<const N: usize> MomentModes<N> {
    /// Adds the contact impulses to the free velocities. A contact that the tool does not reach carries nothing, so the solver looks only at
    /// those that the tool would come near if it went on as before; if the solution reaches another, it is solved again with that one.
    pub(super) fn with_contacts(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        free: [f64; N],
        report: &mut StepReport,
    ) -> [f64; N] {
        if input.contacts.is_empty() {
            self.contact.clear();
            return free;
        }
        self.enters.fill(false);
        let before = Self::freedoms(&self.state.velocity);
        self.mark_near(dt, input, drive, (&before, NEAR_M));
        for _ in 1..MAX_ROUNDS {
            let after = self.with_near_contacts(dt, input, drive, free, report);
            if !self.mark_near(dt, input, drive, (&after, 0.0)) {
                return after;
            }
        }
        self.enters.fill(true);
        self.with_near_contacts(dt, input, drive, free, report)
    }

    /// Marks the contacts to which the tool is nearer than `margin_m` after a step with velocities `v`; true if there are new ones.
    fn mark_near(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        (v, margin_m): (&[f64; N], f64),
    ) -> bool {
        let axes = drive.rotation.to_rotation_matrix();
        let (mut marked, mut of, mut velocity) = (false, usize::MAX, Vector3::zeros());
        for (plane, enters) in input.contacts.iter().zip(&mut self.enters) {
            if *enters {
                continue;
            }
            // Contacts of a sphere usually follow each other.
            if plane.sphere_index != of {
                // The solver counts the contact of an unknown sphere as refused.
                let Some(fixed) = self.layout.spheres.get(plane.sphere_index) else { continue };
                of = plane.sphere_index;
                let [x, z] = self.shape.point(fixed.link, fixed.along_m);
                let along = |row: &[f64; N]| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
                let [turn, along_x, along_z] = self.dynamics.jacobian[fixed.link].each_ref().map(along);
                let own = Vector3::new(along_x + turn * z, v[1], along_z - turn * x);
                let centre = Vector3::new(x, self.state.position[1], z);
                velocity = axes * (own + drive.linear + drive.angular.cross(&centre));
            }
            *enters = plane.gap_m + dt * velocity.dot(&plane.normal) < margin_m;
            marked |= *enters;
        }
        marked
    }

    /// Adds the impulses of the marked contacts to the free velocities.
    fn with_near_contacts(
        &mut self,
        dt: f64,
        input: &StepInput,
        drive: &BaseDrive,
        free: [f64; N],
        report: &mut StepReport,
    ) -> [f64; N] {
        let parameters = &self.parameters.contact;
        let step = ContactStep { dt, drive, planes: input.contacts, parameters };
        let (layout, shape, dynamics, state) = (&self.layout, &self.shape, &self.dynamics, &self.state);
        let (lateral_m, enters) = (state.position[1], &self.enters);
        let results = &state.results[..state.result_count];
        let solver = &mut self.contact;
        solver.collect(
            &step,
            &layout.spheres,
            results,
            |index, _| enters[index],
            |sphere, direction| {
                let SphereLayout { link, along_m, radius_m, .. } = layout.spheres[sphere];
                let centre = shape.point(link, along_m);
                let point = Vector3::new(centre[0], lateral_m, centre[1]) - direction[0] * radius_m;
                let [turning, along_x, along_z] = &dynamics.jacobian[link];
                let force = direction.map(|d| {
                    let [moment, x, z, across] = force(&point, &d);
                    let mut out: [f64; N] =
                        core::array::from_fn(|k| moment * turning[k] + x * along_x[k] + z * along_z[k]);
                    out[1] += across;
                    out
                });
                Place { link: 0, point, force }
            },
        );
        report.refused_contact_count = solver.refused;
        report.contact_count = solver.contact.len();
        report.max_overlap_m = solver.max_overlap_m;
        if solver.is_empty() {
            return free;
        }
        solver.chain.matrix = dynamics.matrix;
        let outcome = solver.solve(&free, parameters);
        report.contact_iterations = outcome.iterations;
        report.contact_residual_m_per_s = outcome.residual;
        let mut impulse = [0.0; N];
        solver.impulses(|_, size, force| impulse = plus(&impulse, size, force), |_, _| ());
        plus(&free, 1.0, &self.factor.solve(&impulse))
    }

    /// Stores the impulses for the next step and adds the contact moments to the loads.
    pub(super) fn store_results(&mut self, dt: f64, drive: &BaseDrive, report: &mut StepReport) {
        let solver = &self.contact;
        self.state.result_count = solver.contact.len();
        for (k, slot) in self.state.results.iter_mut().enumerate().take(solver.contact.len()) {
            let result = solver.result(k, dt, &drive.rotation);
            let normal_force = result.normal * result.normal_force_n;
            let force = drive.rotation.inverse_transform_vector(&(normal_force + result.friction_force_n));
            self.dynamics.moment += solver.contact[k].point.cross(&force);
            report.active_contact_count += usize::from(result.normal_force_n > 0.0);
            if self.layout.spheres[result.sphere_index].kind == SphereKind::Burr {
                report.burr_normal_force_n += normal_force;
            }
            *slot = result;
        }
    }
}
