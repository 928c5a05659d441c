//! Writes the state message.

use messages::{
    AppliedCommand, ArmProtectiveStop, ArmStatus, Contact, ContactPart, Latched, MAX_ARM_JOINTS, Pose,
    TipJacobian, Wrench,
};
use nalgebra::{Isometry3, Vector3};

use super::validity::past_stops;
use super::{Simulation, numbers};
use crate::arm::{ArmMode, ProtectiveStop};
use crate::manipulator::{ManipulatorModel, SphereKind};

impl Simulation<'_> {
    /// Writes the world's state to the message; the caller computes the hash afterwards.
    pub(super) fn update_state(&mut self, latched: &Latched, removed: usize) {
        self.write_tool();
        self.write_tube();
        self.write_contacts();
        self.write_arm();
        self.write_bodies();
        let tool_energy_j = self.tool_energy_j();
        let state = &mut self.state;
        if self.initial.is_some() {
            state.tick = latched.tick + 1;
        } else {
            state.tool_energy_j = tool_energy_j;
        }
        state.sim_time_s = state.tick as f64 * self.dt_s;
        state.removed_in_tick = removed as u32;
        state.removed_total = self.bone.as_ref().map_or(0, |bone| bone.field.voxels().removed_total());
        state.burr_speed_rad_per_s = self.burr_speed_rad_per_s;
        state.burr_torque_nm = self.burr_drive.state.torque_nm;
        state.drive_shaft_wind_up_rad = self.burr_drive.state.shaft.wind_up_rad;
        state.cutting_energy_j = self.cutting_energy_j;
        state.crushing_energy_j = self.crushing_energy_j;
        state.controller_count = latched.controller_count;
        for (applied, entry) in state.applied.iter_mut().zip(&latched.commands) {
            *applied = AppliedCommand {
                sequence: entry.command.sequence,
                age_ticks: entry.age_ticks,
                source: entry.source,
                controller_index: entry.controller_index,
            };
        }
    }

    /// Writes what the present state of arm, tool and drives determines, not what a step computes.
    pub(super) fn show_pose(&mut self) {
        self.write_tool();
        self.write_tube();
        self.write_arm();
        self.state.burr_torque_nm = self.burr_drive.state.torque_nm;
        self.state.drive_shaft_wind_up_rad = self.burr_drive.state.shaft.wind_up_rad;
    }

    fn write_tool(&mut self) {
        let wrench = self.flange_wrench();
        let (state, tool) = (&mut self.state, &self.manipulator);
        let joints = tool.joint_count();
        state.joint_count = joints as u32;
        state.tendon_count = tool.tendon_count() as u32;
        state.joint_position_rad[..joints].copy_from_slice(tool.joint_positions_rad());
        state.joint_velocity_rad_per_s[..joints].copy_from_slice(tool.joint_velocities_rad_per_s());
        state.bend_rad = tool.bend_rad();
        state.tendon_tension_n = tool.tendon_tensions_n();
        state.tendon_displacement_m = tool.tendon_displacements_m();
        let t_world_tube = tool.t_world_link(0);
        state.t_world_base = match &self.tube {
            None => pose(&t_world_tube),
            Some(tube) => pose(&(t_world_tube * tube.t_base_tube().inverse())),
        };
        let burr = tool.t_world_tip();
        state.t_world_burr = pose(&burr);
        let front = burr * Isometry3::translation(0.0, 0.0, tool.parameters().cutter.front_radius_m());
        state.t_world_tip = pose(&front);
        for (slot, link) in state.t_world_link.iter_mut().zip(1..=joints) {
            *slot = pose(&tool.t_world_link(link));
        }
        state.flange_wrench =
            Wrench { force_n: numbers(&wrench.force_n), torque_nm: numbers(&wrench.torque_nm) };
        let report = tool.last_report();
        state.burr_force_n = report.burr_normal_force_n.norm();
        state.contact_iterations = report.contact_iterations as u32;
        state.contact_residual_m_per_s = report.contact_residual_m_per_s;
        state.stop_excess_rad = past_stops(tool).fold(0.0, f64::max);
    }

    /// Returns Jacobian and compliance of the tip at the present state
    /// ([`ManipulatorModel::tip_jacobian`](crate::manipulator::ManipulatorModel::tip_jacobian)).
    pub fn tip_jacobian(&self) -> TipJacobian {
        let own = self.manipulator.tip_jacobian();
        // The manipulator's base is that of the tube, and moves with the tool base.
        let tube_m = &self.manipulator.base().t_world_base.translation.vector;
        let lever_m = tube_m - Vector3::from(self.state.t_world_base.position_m);
        let mut per_base = own.per_base;
        for k in 0..3 {
            let moved = Vector3::ith(k, 1.0).cross(&lever_m);
            for (j, moved) in moved.iter().enumerate() {
                for (entry, linear) in per_base[3 + k].iter_mut().zip(&own.per_base[j]) {
                    *entry += moved * linear;
                }
            }
        }
        let mut message = TipJacobian { tick: self.state.tick, ..TipJacobian::zeroed() };
        let rows = |columns: &[[f64; 6]], out: &mut [f64]| {
            for (at, entry) in out.iter_mut().enumerate() {
                *entry = columns[at % columns.len()][at / columns.len()];
            }
        };
        rows(&own.per_tension, &mut message.per_tension);
        rows(&per_base, &mut message.per_base);
        rows(&own.compliance, &mut message.compliance);
        message
    }

    fn write_tube(&mut self) {
        let Some(tube) = &self.tube else { return };
        let at = tube.at();
        [self.state.tube_deployed_m, self.state.tube_roll_rad] = at.position;
        [self.state.tube_deploying_m_per_s, self.state.tube_rolling_rad_per_s] = at.velocity;
    }

    /// Lists the contacts that carry force; the others are only counted.
    fn write_contacts(&mut self) {
        let state = &mut self.state;
        let results = self.manipulator.contact_results();
        let spheres = self.manipulator.proxy_spheres();
        (state.wall_force_n, state.strength_share) = (0.0, 0.0);
        let mut listed = 0;
        for result in results.iter().filter(|result| result.normal_force_n > 0.0) {
            let plane = self.planes.get(result.contact_index);
            let part = spheres.get(result.sphere_index).map_or(ContactPart::Burr, |sphere| part(sphere.kind));
            if part != ContactPart::Burr {
                state.wall_force_n += result.normal_force_n;
            }
            let strength_n = plane.map_or(f64::INFINITY, |plane| plane.strength_n);
            state.strength_share = state.strength_share.max(result.normal_force_n / strength_n);
            let Some(slot) = state.contacts.get_mut(listed) else { continue };
            *slot = Contact {
                sphere_index: result.sphere_index as u32,
                part: part.code(),
                point_m: plane.map_or([0.0; 3], |plane| numbers(&plane.point_m)),
                normal: numbers(&result.normal),
                gap_m: plane.map_or(0.0, |plane| plane.gap_m),
                normal_force_n: result.normal_force_n,
                friction_force_n: numbers(&result.friction_force_n),
            };
            listed += 1;
        }
        state.contacts[listed..].fill(Contact::zeroed());
        state.contact_count = listed as u32;
        state.contact_total = results.len() as u32;
    }

    fn write_bodies(&mut self) {
        let Some(rigid) = &self.rigid else { return };
        self.state.body_count = rigid.body_count() as u32;
        for (slot, transform) in self.state.t_world_body.iter_mut().zip(rigid.poses()) {
            *slot = pose(transform);
        }
        for (slot, wrench) in self.state.wrench_on_body.iter_mut().zip(rigid.tool_wrenches()) {
            *slot = Wrench { force_n: numbers(&wrench.force_n), torque_nm: numbers(&wrench.torque_nm) };
        }
    }

    fn write_arm(&mut self) {
        let arm = self.arm.state();
        // A gantry's linear axes are not angles; the flange pose gives their positions.
        if self.arm.parameters().geometry.turns() {
            self.state.arm_joint_position_rad = arm.q_rad;
            self.state.arm_joint_velocity_rad_per_s = arm.qd_rad_s;
        }
        self.state.arm_mode = mode_followed(arm.mode).code();
        let status = match (arm.fault, arm.done) {
            (Some(_), _) => ArmStatus::Fault,
            (None, true) => ArmStatus::Done,
            (None, false) => ArmStatus::Moving,
        };
        self.state.arm_status = status.code();
        self.state.arm_joint_count = self.arm.parameters().geometry.joints() as u32;
        self.state.arm_protective_stop = match arm.protective_stop {
            ProtectiveStop::Armed => ArmProtectiveStop::None,
            ProtectiveStop::Stopped { .. } => ArmProtectiveStop::Stopped,
            ProtectiveStop::Released { .. } => ArmProtectiveStop::Released,
        }
        .code();
        self.state.arm_manipulability_m3 = self.arm.parameters().geometry.manipulability_m3(&arm.q_rad);
        self.state.t_world_flange = pose(&self.arm.t_world_flange());
        if let Some(compliance) = &self.compliance {
            let (deflected, elastic) = (compliance.base(&self.arm), compliance.state());
            for i in 0..MAX_ARM_JOINTS {
                self.state.arm_joint_position_rad[i] += elastic.deflection_rad[i];
                self.state.arm_joint_velocity_rad_per_s[i] += elastic.rate_rad_s[i];
            }
            self.state.arm_joint_deflection_rad = elastic.deflection_rad;
            let tool =
                self.arm.parameters().geometry.t_flange_tool().copied().unwrap_or_else(Isometry3::identity);
            self.state.t_world_flange = pose(&(deflected.t_world_tool * tool.inverse()));
        }
    }
}

/// Returns the message code of the arm mode.
fn mode_followed(mode: ArmMode) -> messages::ArmMode {
    match mode {
        ArmMode::Hold => messages::ArmMode::Hold,
        ArmMode::ServoJp => messages::ArmMode::ServoJp,
        ArmMode::ServoJv => messages::ArmMode::ServoJv,
        ArmMode::MoveJp => messages::ArmMode::MoveJp,
        ArmMode::ServoCp => messages::ArmMode::ServoCp,
        ArmMode::MoveCp => messages::ArmMode::MoveCp,
        ArmMode::Insert => messages::ArmMode::Insert,
        ArmMode::Rcm => messages::ArmMode::Rcm,
    }
}

fn part(kind: SphereKind) -> ContactPart {
    match kind {
        SphereKind::Shaft => ContactPart::Shaft,
        SphereKind::Segment(_) => ContactPart::Segment,
        SphereKind::Burr => ContactPart::Burr,
    }
}

/// Returns a transform as a message pose.
pub fn pose(transform: &Isometry3<f64>) -> Pose {
    let rotation = transform.rotation.coords;
    let position: &Vector3<f64> = &transform.translation.vector;
    Pose { position_m: numbers(position), orientation_xyzw: [rotation.x, rotation.y, rotation.z, rotation.w] }
}
