//! The burr's contacts and motor, and the loads of cutting on the motor and the tool.
//!
//! A contact with normal force F and cutting coefficient mu pushes the burr along its surface with `mu F (w x
//! n)`, where w is the unit spin axis and n the contact normal, toward the burr: nothing at the pole, mu F at
//! the side. It also loads the motor with the torque `mu F r_eff` through the drive shaft, which runs inside
//! the tube without turning it; torque times speed is the cutting power of [`crate::bone::cutting`]. Both
//! come from the last tick's contacts. On a cutter longer than a ball, the side forces on the balls behind
//! the front one also produce a torque.
//!
//! A motor with stall torque M_s turns at `(1 - M/M_s)` times the commanded speed: the speed-torque line of a
//! DC motor at constant voltage. At M_s it stalls, and the burr rubs without cutting until the load drops.
//! Drive shaft friction adds to M, and a compliant shaft lets the burr lag behind the motor:
//! [`super::drive_shaft`].

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::Simulation;
use super::drive_shaft::{Load, Torsion, TorsionState};
use crate::bone::cutting::lever_share;
use crate::bone::{Ball, BurrContact};
use crate::manipulator::{ManipulatorModel, ProxySphere, Wrench};

/// Model of the motor and the side force, as enabled by the scene.
#[derive(Debug, Clone, Copy)]
pub(super) struct BurrDrive {
    /// Stall torque of the motor, N m; `None` if it never stalls.
    pub stall_torque_nm: Option<f64>,
    /// Scene key of the stall torque.
    pub stall_key: &'static str,
    /// Friction torque of the drive shaft in the tube, N m.
    pub friction_torque_nm: f64,
    /// Torsional compliance of the drive shaft.
    pub torsion: Option<Torsion>,
    /// Whether cutting pushes the burr sideways.
    pub side_force: bool,
    /// Ratio of cutting force to normal force.
    pub cutting_coefficient: f64,
    pub state: BurrDriveState,
}

/// State of the burr drive.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct BurrDriveState {
    /// Commanded speed, rad/s.
    pub command_rad_per_s: f64,
    /// Torque of the last contacts on a turning motor, N m.
    pub torque_nm: f64,
    /// Side force on the burr, world, N.
    pub side_force_n: [f64; 3],
    /// Torque of the side forces about the burr centre, world, N m: 0 for a ball, whose contacts push through
    /// the centre. Keyframes store it separately, and only for a longer cutter.
    #[serde(skip)]
    pub side_torque_nm: [f64; 3],
    /// State of a compliant shaft; keyframes store it separately, and only if there is one.
    #[serde(skip)]
    pub shaft: TorsionState,
}

/// Distance from the spin axis at which contacts cut.
#[derive(Debug, Clone, Copy)]
enum Lever {
    /// For a ball: from the direction of each contact.
    Ball { radius_m: f64 },
    /// For a cutter of several balls: the mean over the touched bone.
    Mean { lever_m: f64 },
}

impl BurrDrive {
    /// Returns whether the scene models any part of the burr drive, which then has state to save.
    pub fn is_modelled(&self) -> bool {
        self.side_force || self.stall_torque_nm.is_some() || self.torsion.is_some()
    }

    /// Returns the load torque on the motor from the last tick's contacts and the shaft friction, N m.
    fn brake_nm(&self) -> f64 {
        self.state.torque_nm + self.friction_torque_nm
    }

    /// Returns the speed under the last tick's torque, rad/s; with a compliant shaft, the burr's mean over
    /// the tick.
    fn turn(&mut self, dt_s: f64) -> f64 {
        let command = self.state.command_rad_per_s;
        let (stall_torque_nm, brake_nm) = (self.stall_torque_nm, self.brake_nm());
        match (&self.torsion, stall_torque_nm) {
            (Some(torsion), _) => {
                let load = Load { command_rad_per_s: command, stall_torque_nm, brake_nm };
                torsion.turn(&mut self.state.shaft, &load, dt_s)
            }
            (None, None) => command,
            (None, Some(stall_nm)) => command * (1.0 - brake_nm / stall_nm).max(0.0),
        }
    }

    /// Computes the loads from the contacts of a tick, given the cutting lever arm, spin axis and speed.
    fn take(&mut self, contacts: &[BurrContact], lever: Lever, axis: &Vector3<f64>, speed_rad_per_s: f64) {
        let (mut torque_nm, mut side_n, mut moment_nm) = (0.0, Vector3::zeros(), Vector3::zeros());
        for contact in contacts {
            let cutting_n = self.cutting_coefficient * contact.normal_force_n;
            torque_nm += match lever {
                Lever::Ball { radius_m } => cutting_n * radius_m * lever_share(contact.axis_cosine),
                Lever::Mean { lever_m } => cutting_n * lever_m,
            };
            let across_n = axis.cross(&contact.normal) * cutting_n;
            side_n += across_n;
            moment_nm += (axis * -contact.behind_m).cross(&across_n);
        }
        self.state.torque_nm = torque_nm;
        // A stationary burr only rubs, which is contact friction.
        let sense = if speed_rad_per_s == 0.0 { 0.0 } else { speed_rad_per_s.signum() };
        let seen = |vector: Vector3<f64>| if self.side_force { (vector * sense).into() } else { [0.0; 3] };
        let is_long = matches!(lever, Lever::Mean { .. });
        (self.state.side_force_n, self.state.side_torque_nm) =
            (seen(side_n), if is_long { seen(moment_nm) } else { [0.0; 3] });
    }
}

impl Simulation<'_> {
    /// Collects the burr's balls and their contacts with bone that carry force.
    pub(super) fn find_burr_contacts(&mut self) {
        self.burr_contacts.clear();
        self.balls_behind.clear();
        let spheres = self.manipulator.proxy_spheres();
        // The burr's spheres are the last ones, from back to front.
        let balls = self.manipulator.parameters().cutter.balls();
        let behind = spheres.iter().rev().take(balls.len()).skip(1);
        let ball = |sphere: &ProxySphere| Ball { centre_m: sphere.centre_m, radius_m: sphere.radius_m };
        self.balls_behind.extend(behind.map(ball));
        let axis = self.manipulator.t_world_tip().rotation * Vector3::z();
        for result in self.manipulator.contact_results().iter().filter(|result| result.normal_force_n > 0.0) {
            let from_front = spheres.len().checked_sub(result.sphere_index + 1);
            let ball = from_front.and_then(|number| balls.get(number));
            let body = self.rigid.as_ref().and_then(|rigid| rigid.body_of_plane(result.contact_index));
            if let Some(ball) = ball
                && body.is_none()
            {
                self.burr_contacts.push(BurrContact {
                    normal: result.normal,
                    normal_force_n: result.normal_force_n,
                    axis_cosine: result.normal.dot(&axis),
                    behind_m: ball.behind_m,
                });
            }
        }
    }

    /// Sets the burr's speed for the tick. Reports a stall to the controller that drives the burr.
    pub(super) fn turn_burr(&mut self) {
        let (before, stalled_before) = (self.burr_speed_rad_per_s, self.burr_drive.state.shaft.is_stalled);
        self.burr_speed_rad_per_s = self.burr_drive.turn(self.dt_s);
        let drive = &self.burr_drive;
        // A shaft that winds up holds the burr for a while, which is not a stall.
        let comes_to_stand = match drive.torsion {
            Some(_) => drive.state.shaft.is_stalled && !stalled_before,
            None => {
                let stands = self.burr_speed_rad_per_s == 0.0 && drive.state.command_rad_per_s != 0.0;
                stands && before != 0.0
            }
        };
        if comes_to_stand {
            let (torque_nmm, stall_nmm) =
                (drive.state.torque_nm * 1e3, drive.stall_torque_nm.unwrap_or(f64::INFINITY) * 1e3);
            let friction = match drive.friction_torque_nm {
                0.0 => String::new(),
                nm => format!(", shaft friction {} N mm", nm * 1e3),
            };
            let key = drive.stall_key;
            let reason = format!(
                "burr: motor stalled: cutting torque {torque_nmm:.3} N mm{friction}, `{key}` is {stall_nmm}"
            );
            self.tell_burr_driver(reason);
        }
        self.manipulator.set_burr_turns(self.burr_speed_rad_per_s != 0.0);
    }

    /// Returns the force of the last tick's cutting on the tool's tip.
    pub(super) fn cutting_wrench(&self) -> Wrench {
        let BurrDriveState { side_force_n, side_torque_nm, .. } = self.burr_drive.state;
        Wrench { force_n: side_force_n.into(), torque_nm: side_torque_nm.into() }
    }

    /// Returns whether a tick's side force also has a torque that the next tick needs.
    pub(super) fn has_side_torque(&self) -> bool {
        self.burr_drive.side_force && self.manipulator.parameters().cutter.only_radius_m().is_none()
    }

    /// Applies the tick's burr contacts to the drive; `lever_m` is for a cutter of several balls.
    pub(super) fn load_burr(&mut self, lever_m: f64) {
        if !self.burr_drive.is_modelled() {
            return;
        }
        let radius_m = self.manipulator.parameters().cutter.only_radius_m();
        let lever = radius_m.map_or(Lever::Mean { lever_m }, |radius_m| Lever::Ball { radius_m });
        let axis = self.manipulator.t_world_tip().rotation * Vector3::z();
        self.burr_drive.take(&self.burr_contacts, lever, &axis, self.burr_speed_rad_per_s);
    }
}
