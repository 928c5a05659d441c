//! Energy of a spatial chain, and the check that a step does not gain any.
//!
//! With little damping, a ROS2 step out of the bending plane can gain energy
//! (`crates/simulation/tests/physics/swings.rs`: 10 % over a swing of 0.4 s at 2 ms without damping). Such a
//! step is rejected and repeated with linearly implicit Euler, which damps.
//!
//! The error of a step raises and lowers the energy slightly even if the motion is accurate. The energy is
//! therefore compared not with that of the previous step, but with a ceiling that only the work of the loads
//! raises, and that is at most [`MARGIN`] above the energy.

use nalgebra::Vector3;

use super::SpatialChain;
use super::algebra::{ZERO, add_scaled, dot, upper, velocity_at};
use super::layout::Configuration;
use crate::manipulator::loads::Frame;
use crate::manipulator::state::TendonCommand;

/// Allowed relative error in the work of the loads over a step, which is integrated by the trapezoidal rule.
const WORK_SHARE: f64 = 0.1;
/// Allowed relative error if stiff tendons hold a length: their tension follows from the motion within the
/// step.
const STIFF_WORK_SHARE: f64 = 1.0;
/// Allowed relative rise of the energy within a free motion.
const MARGIN: f64 = 1e-3;

impl<const D: usize> SpatialChain<D> {
    /// Returns the kinetic energy relative to the base plus elastic energy of flexures and mount, J.
    pub(super) fn energy_of(
        &self,
        configuration: &Configuration<D>,
        position: &[f64],
        velocity: &[f64],
    ) -> f64 {
        let bent = self.stiffness.iter().zip(position).zip(&self.rest);
        let elastic: f64 = bent.map(|((k, q), rest)| 0.5 * k * (q - rest) * (q - rest)).sum();
        let (mut energy, mut motion) = (elastic, ZERO);
        for link in 0..=self.layout.joints {
            for k in self.layout.freedoms_of(link) {
                add_scaled(&mut motion, velocity[k], &configuration.axis[k]);
            }
            let centre = configuration.point(link, self.layout.body[link].centre_m);
            let body = self.layout.moments(link);
            let turn = upper(&motion);
            let along = turn.dot(&configuration.direction(link));
            energy += 0.5 * body.mass_kg * velocity_at(&centre, &motion).norm_squared()
                + 0.5 * body.across_kg_m2 * turn.norm_squared()
                + 0.5 * (body.along_kg_m2 - body.across_kg_m2) * along * along;
        }
        energy
    }

    /// Computes the generalised forces of gravity, base acceleration and rotation, and the tip wrench, at
    /// rest in the present shape.
    pub(super) fn frame_forces(&mut self, frame: &Frame, out: &mut [f64]) {
        let Frame { gravity, angular_velocity, angular_acceleration, tip_wrench } = frame;
        let all =
            [gravity, angular_velocity, angular_acceleration, &tip_wrench.force_n, &tip_wrench.torque_nm];
        out.fill(0.0);
        if all.iter().all(|vector| **vector == Vector3::zeros()) {
            return;
        }
        self.loads.evaluate(&self.layout, &self.configuration, out, frame);
        let mut sum = ZERO;
        for link in (0..=self.layout.joints).rev() {
            add_scaled(&mut sum, 1.0, &self.loads.force[link]);
            for k in self.layout.freedoms_of(link) {
                out[k] = dot(&self.configuration.axis[k], &sum);
            }
        }
    }
}

/// Work of the loads over a step, and a bound of its error, J.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LoadWork {
    work_j: f64,
    error_j: f64,
}

impl LoadWork {
    /// Adds a force in one freedom, at both ends of the step, over its displacement.
    pub fn add(&mut self, [start, end]: [f64; 2], displacement: f64, share: f64) {
        let work_j = 0.5 * (start + end) * displacement;
        self.work_j += work_j;
        self.error_j += share * work_j.abs();
    }

    /// Returns the ceiling after a step from the ceiling before it and the energy at its start.
    pub fn ceiling_j(&self, ceiling_j: f64, before_j: f64) -> f64 {
        ceiling_j.min(before_j * (1.0 + MARGIN)) + self.work_j + self.error_j
    }
}

/// Returns the allowed relative error in the work of the tendons.
pub(super) fn tendon_share(command: &TendonCommand) -> f64 {
    match command {
        TendonCommand::Force(_) | TendonCommand::EachForce(_) => WORK_SHARE,
        TendonCommand::Displacement(_) | TendonCommand::EachDisplacement(_) => STIFF_WORK_SHARE,
    }
}

/// Allowed relative error in the work of gravity, the base motion and the tip wrench.
pub(super) const FRAME_SHARE: f64 = WORK_SHARE;
