//! The burr's motor, and what cutting does to it and to the tool.
//!
//! A contact that presses with F and cuts with the coefficient mu pushes the burr along its surface with `mu F (w x n)`, w being the unit
//! spin axis and n the contact's normal, toward the burr: nothing at the pole, mu F at the side. It also takes the torque `mu F r_eff` from
//! the motor, through the drive shaft, which runs in the tube and does not turn it; torque times speed is the cutting power of
//! [`crate::bone::cutting`]. Both are those of the last tick's contacts.
//!
//! A motor with a stall torque M_s turns at `(1 - M/M_s)` times the commanded speed: the line of a DC motor at a constant voltage. At M_s
//! it stands, and its burr rubs and cuts nothing until it is pressed less.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::Simulation;
use crate::bone::BurrContact;
use crate::bone::cutting::lever_share;
use crate::manipulator::{ManipulatorModel, Wrench};

/// What of the motor and of the side force a scene models.
#[derive(Debug, Clone, Copy)]
pub(super) struct BurrDrive {
    /// Torque at which the motor stands, N m; `None`: any torque is borne.
    pub stall_torque_nm: Option<f64>,
    /// Whether cutting pushes the burr aside.
    pub side_force: bool,
    /// Cutting over normal force.
    pub cutting_coefficient: f64,
    pub state: BurrDriveState,
}

/// What a tick changes of it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct BurrDriveState {
    /// Commanded speed, rad/s.
    pub command_rad_per_s: f64,
    /// Torque that the last contacts ask of the motor if it turns, N m.
    pub torque_nm: f64,
    /// Force on the burr across its contacts, world, N.
    pub side_force_n: [f64; 3],
}

impl BurrDrive {
    /// Whether there is anything to compute, and to save.
    pub fn is_modelled(&self) -> bool {
        self.side_force || self.stall_torque_nm.is_some()
    }

    /// Speed under the last tick's torque, rad/s.
    fn speed_rad_per_s(&self) -> f64 {
        let command = self.state.command_rad_per_s;
        match self.stall_torque_nm {
            None => command,
            Some(stall_nm) => command * (1.0 - self.state.torque_nm / stall_nm).max(0.0),
        }
    }

    /// Takes the contacts of a tick on a burr of this radius, spin axis and speed.
    fn take(&mut self, contacts: &[BurrContact], radius_m: f64, axis: &Vector3<f64>, speed_rad_per_s: f64) {
        let (mut torque_nm, mut side_n) = (0.0, Vector3::zeros());
        for contact in contacts {
            let cutting_n = self.cutting_coefficient * contact.normal_force_n;
            torque_nm += cutting_n * radius_m * lever_share(contact.axis_cosine);
            side_n += axis.cross(&contact.normal) * cutting_n;
        }
        self.state.torque_nm = torque_nm;
        // One that stands rubs, and that is friction of the contact.
        let sense = if speed_rad_per_s == 0.0 { 0.0 } else { speed_rad_per_s.signum() };
        self.state.side_force_n = if self.side_force { (side_n * sense).into() } else { [0.0; 3] };
    }
}

impl Simulation<'_> {
    /// Sets the burr's speed for the tick; a motor that comes to stand is told to whoever drives the burr.
    pub(super) fn turn_burr(&mut self) {
        let (before, drive) = (self.burr_speed_rad_per_s, &self.burr_drive);
        self.burr_speed_rad_per_s = drive.speed_rad_per_s();
        let stands = self.burr_speed_rad_per_s == 0.0 && drive.state.command_rad_per_s != 0.0;
        if stands && before != 0.0 {
            let (torque_nmm, stall_nmm) =
                (drive.state.torque_nm * 1e3, drive.stall_torque_nm.unwrap_or(f64::INFINITY) * 1e3);
            let reason = format!(
                "burr: its motor stands: bone takes {torque_nmm:.3} N mm, `manipulator.burr_stall_torque_nmm` is {stall_nmm}"
            );
            self.tell_burr_driver(reason);
        }
        self.manipulator.set_burr_turns(self.burr_speed_rad_per_s != 0.0);
    }

    /// The force of the last tick's cutting on the tool's tip.
    pub(super) fn cutting_wrench(&self) -> Wrench {
        Wrench { force_n: self.burr_drive.state.side_force_n.into(), ..Wrench::zero() }
    }

    /// Takes the tick's contacts of the burr.
    pub(super) fn load_burr(&mut self) {
        if !self.burr_drive.is_modelled() {
            return;
        }
        let radius_m = self.manipulator.parameters().burr_radius_m;
        let axis = self.manipulator.t_world_tip().rotation * Vector3::z();
        self.burr_drive.take(&self.burr_contacts, radius_m, &axis, self.burr_speed_rad_per_s);
    }
}
