//! Contacts of a step: selects those that enter the solver, and applies its result.

use nalgebra::Vector3;

use super::MomentModes;
use super::step::plus;
use crate::manipulator::contact::{BaseDrive, ContactPlacement};
use crate::manipulator::geometry::SphereLayout;
use crate::manipulator::pressing::force;
use crate::manipulator::state::{StepInput, StepReport};
use crate::manipulator::step::MAX_ROUNDS;

/// Distance, m, from the predicted tool position beyond which a contact does not initially enter the solver.
const NEAR_M: f64 = 5.0e-6;

impl<const N: usize> MomentModes<N> {
    /// Adds the contact impulses to the free velocities. A contact that the tool does not reach carries no
    /// force, so only those near the predicted motion enter the solver; if the solution reaches another one,
    /// the solve is repeated with it.
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
        let [_, before] = self.freedoms();
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

    /// Marks the contacts that are closer than `margin_m` to the tool after a step with velocities `v`;
    /// returns true if there are new ones.
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
            // Contacts of the same sphere are usually consecutive.
            if plane.sphere_index != of {
                // The solver counts the contact of an unknown sphere as rejected.
                let Some(fixed) = self.common.sphere_layout.get(plane.sphere_index) else { continue };
                of = plane.sphere_index;
                let [x, z] = self.shape.point(fixed.link, fixed.along_m);
                let along = |row: &[f64; N]| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
                let [turn, along_x, along_z] = self.dynamics.jacobian[fixed.link].each_ref().map(along);
                let own = Vector3::new(along_x + turn * z, v[1], along_z - turn * x);
                let centre = Vector3::new(x, self.common.state.position[1], z);
                velocity = axes * (own + drive.linear + drive.angular.cross(&centre));
            }
            *enters = plane.end_gap_m(dt) + dt * velocity.dot(&plane.normal) < margin_m;
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
        let step = self.common.contact_step(dt, drive, input);
        let (shape, dynamics, enters) = (&self.shape, &self.dynamics, &self.enters);
        let lateral_m = self.common.state.position[1];
        let solver = &mut self.contact;
        solver.collect(
            &step,
            report,
            |index| enters[index],
            |sphere, direction| {
                let SphereLayout { link, along_m, radius_m, .. } = step.spheres[sphere];
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
                ContactPlacement { link: 0, point, force }
            },
        );
        if solver.is_empty() {
            return free;
        }
        solver.chain.matrix = dynamics.matrix;
        solver.solve(&free, &step, report);
        let mut impulse = [0.0; N];
        solver.impulses(|_, size, force| impulse = plus(&impulse, size, force), |_, _| ());
        plus(&free, 1.0, &self.factor.solve(&impulse))
    }
}
