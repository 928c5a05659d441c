//! Energy ledger of the tool, updated by every tick.
//!
//! All energies are relative to the tool's base. The work of a tick uses the forces at its end over the
//! motions within it, as the implicit step does:
//!
//! - tendons: tension times change of the displacement at the proximal end;
//! - arm: the contacts' forces times the base's motion at their points, with the sign reversed, the work of
//!   the base's acceleration, and what a sliding outer tube changes in the springs;
//! - gravity: weight times the motion of the centre of mass;
//! - motor: the energy that cutting uses, and the cutting's side force times the tip's motion;
//! - bodies: their contacts' forces times the tool's motion.
//!
//! The energy of the tool is kinetic and elastic, with the springs of tendons, contacts and stops. What the
//! sum leaves after cutting, crushing, friction of contacts and tendons, and damping is lost to the
//! integrator, impacts and feed against cut bone. This remainder may be negative only by the integrator's
//! error; beyond a bound, the tick has created energy.

use messages::State;
use nalgebra::{Isometry3, Vector3};

use super::Simulation;
use crate::manipulator::ManipulatorModel;
use crate::rigid::ToolDrive;

/// Energy that a tick may create without a report, J, and the fractions of the work done on the tool and of
/// its energy: the error of a step that is linear in the forces and of first order in time.
const FREE_J: f64 = 1.0e-4;
const FREE_WORK_SHARE: f64 = 0.1;
const FREE_ENERGY_SHARE: f64 = 0.01;

/// Returns the energy that a tick may create without a report, J. `gross_j` is the sum of the magnitudes of
/// all works, `energy_j` the tool's energy at the end of the tick at which it is larger.
pub fn creation_bound_j(gross_j: f64, energy_j: f64) -> f64 {
    FREE_J + FREE_WORK_SHARE * gross_j + FREE_ENERGY_SHARE * energy_j
}

/// State of the tool at the start of a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct TickStart {
    t_world_base: Isometry3<f64>,
    t_world_tip: Isometry3<f64>,
    base_velocity_m_per_s: Vector3<f64>,
    mass_moment_kg_m: Vector3<f64>,
    displacement_m: [f64; messages::MAX_TENDONS],
    crushing_energy_j: f64,
    cutting_energy_j: f64,
    tool_energy_j: f64,
}

impl TickStart {
    /// Returns the tool's energy at the start, J.
    pub(super) fn tool_energy_j(&self) -> f64 {
        self.tool_energy_j
    }
}

impl Simulation<'_> {
    /// Returns the tool's state before the base and an outer tube move.
    pub(super) fn tick_start(&self) -> TickStart {
        let (tool, state) = (&self.manipulator, &self.state);
        let base = tool.base();
        TickStart {
            t_world_base: base.t_world_base,
            t_world_tip: tool.t_world_tip(),
            base_velocity_m_per_s: base.linear_velocity_m_per_s,
            mass_moment_kg_m: tool.mass_moment_kg_m(),
            displacement_m: state.tendon_displacement_m,
            crushing_energy_j: state.crushing_energy_j,
            cutting_energy_j: state.cutting_energy_j,
            tool_energy_j: state.tool_energy_j,
        }
    }

    /// Returns the tool's kinetic and elastic energy, J.
    pub(super) fn tool_energy_j(&self) -> f64 {
        let tool = &self.manipulator;
        let parameters = tool.parameters();
        let springs_j = |forces: &mut dyn Iterator<Item = f64>, stiffness: f64| {
            forces.map(|force| 0.5 * force * force / stiffness).sum::<f64>()
        };
        let contacts = tool.contact_results().iter().filter(|result| !self.is_body(result.contact_index));
        tool.energy_j()
            + tool.stop_energy_j()
            + springs_j(&mut tool.tendon_tensions_n().into_iter(), parameters.tendon.stiffness_n_per_m)
            + springs_j(
                &mut contacts.map(|result| result.normal_force_n),
                parameters.contact.stiffness_n_per_m,
            )
    }

    fn is_body(&self, plane: usize) -> bool {
        self.rigid.as_ref().is_some_and(|rigid| rigid.body_of_plane(plane).is_some())
    }

    /// Adds a tick to the ledger in the state. `slid_j` is what an outer tube changed in the springs.
    pub(super) fn balance_energy(&mut self, start: &TickStart, slid_j: f64, drive: &ToolDrive) {
        let tool = &self.manipulator;
        let base = tool.base();
        let rotation = base.t_world_base.rotation;
        let turned = (rotation * start.t_world_base.rotation.inverse()).scaled_axis();
        let from_m = start.t_world_base.translation.vector;
        let carried_m = base.t_world_base.translation.vector - from_m;
        let carried = |point: &Vector3<f64>| carried_m + turned.cross(&(point - from_m));

        let mut tendon_j = 0.0;
        let tensions_n = tool.tendon_tensions_n().into_iter();
        let displacements_m = tool.tendon_displacements_m().into_iter().zip(start.displacement_m);
        for (tension_n, (displacement_m, before_m)) in tensions_n.zip(displacements_m) {
            tendon_j += tension_n * (displacement_m - before_m);
        }
        let (mut arm_j, mut body_j, mut friction_j) = (slid_j, 0.0, 0.0);
        for result in tool.contact_results().iter().filter(|result| result.normal_force_n > 0.0) {
            let index = result.sphere_index;
            let (Some(sphere), Some(reach)) = (tool.proxy_spheres().get(index), self.reach.get(index)) else {
                continue;
            };
            let moved_m = sphere.centre_m - reach.from_m;
            let force_n = result.normal * result.normal_force_n + result.friction_force_n;
            arm_j -= force_n.dot(&carried(&reach.from_m));
            if self.is_body(result.contact_index) {
                body_j += force_n.dot(&moved_m);
            } else {
                friction_j -= result.friction_force_n.dot(&moved_m);
            }
        }
        // The mass moment turns with the base, which does no work on the shape.
        let shifted_kg_m = rotation * (tool.mass_moment_kg_m() - start.mass_moment_kg_m);
        let acceleration = (base.linear_velocity_m_per_s - start.base_velocity_m_per_s) / self.dt_s;
        arm_j -= acceleration.dot(&shifted_kg_m);
        let gravity_j = tool.parameters().gravity_m_per_s2.dot(&shifted_kg_m);
        let tip = tool.t_world_tip();
        let tip_m = start.t_world_tip.translation.vector;
        let tip_moved_m = tip.translation.vector - tip_m - carried(&tip_m);
        let tip_turned = (tip.rotation * start.t_world_tip.rotation.inverse()).scaled_axis() - turned;
        let side_j = drive.tip_wrench.force_n.dot(&tip_moved_m) + drive.tip_wrench.torque_nm.dot(&tip_turned);
        friction_j += tool.tendon_friction_w() * self.dt_s;
        let damping_j = tool.damping_w() * self.dt_s;

        let energy_j = self.tool_energy_j();
        let crushed_j = self.crushing_energy_j - start.crushing_energy_j;
        let cut_j = self.cutting_energy_j - start.cutting_energy_j;
        let works_j = [tendon_j, arm_j, gravity_j, body_j, side_j];
        let left_j = works_j.iter().sum::<f64>() - (energy_j - start.tool_energy_j) - crushed_j;
        let gross_j: f64 = works_j.iter().map(|work_j| work_j.abs()).sum();
        let bound_j = creation_bound_j(gross_j, energy_j.max(start.tool_energy_j));
        let state: &mut State = &mut self.state;
        state.tool_energy_j = energy_j;
        state.tendon_work_j += tendon_j;
        state.arm_work_j += arm_j;
        state.gravity_work_j += gravity_j;
        state.body_work_j += body_j;
        state.motor_work_j += cut_j + side_j;
        state.friction_energy_j += friction_j;
        state.damping_energy_j += damping_j;
        state.numerical_energy_j += left_j - friction_j - damping_j;
        state.energy_created_j += (-left_j - bound_j).max(0.0);
    }
}
