//! The burr's contacts and motor, and what cutting does to it and to the tool.
//!
//! A contact that presses with F and cuts with the coefficient mu pushes the burr along its surface with `mu
//! F (w x n)`, w being the unit spin axis and n the contact's normal, toward the burr: nothing at the pole,
//! mu F at the side. It also takes the torque `mu F r_eff` from the motor, through the drive shaft, which
//! runs in the tube and does not turn it; torque times speed is the cutting power of
//! [`crate::bone::cutting`]. Both are those of the last tick's contacts. A cutter that is longer than a ball
//! is also turned by the side forces on the balls behind its front one.
//!
//! A motor with a stall torque M_s turns at `(1 - M/M_s)` times the commanded speed: the line of a DC motor
//! at a constant voltage. At M_s it stands, and its burr rubs and cuts nothing until it is pressed less. The
//! friction of a drive shaft adds to M, and one that twists lets the burr lag behind the motor:
//! [`super::drive_shaft`].

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::Simulation;
use super::drive_shaft::{Load, Torsion, TorsionState};
use crate::bone::cutting::lever_share;
use crate::bone::{Ball, BurrContact};
use crate::manipulator::{ManipulatorModel, ProxySphere, Wrench};

/// What of the motor and of the side force a scene models.
#[derive(Debug, Clone, Copy)]
pub(super) struct BurrDrive {
    /// Torque at which the motor stands, N m; `None`: any torque is borne.
    pub stall_torque_nm: Option<f64>,
    /// The key that says so.
    pub stall_key: &'static str,
    /// Torque of the drive shaft's friction against the tube, N m.
    pub friction_torque_nm: f64,
    /// A drive shaft that twists.
    pub torsion: Option<Torsion>,
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
    /// Torque of these forces about the burr's centre, world, N m: 0 for a ball, whose contacts push through
    /// its centre. A keyframe holds it beside this, and only for a longer cutter.
    #[serde(skip)]
    pub side_torque_nm: [f64; 3],
    /// Of a shaft that twists; a keyframe holds it beside this, and only there.
    #[serde(skip)]
    pub shaft: TorsionState,
}

/// At which distance from the spin axis contacts cut.
#[derive(Debug, Clone, Copy)]
enum Lever {
    /// A ball: by the direction of each contact.
    Ball { radius_m: f64 },
    /// A cutter of several balls: the mean over what it touches.
    Mean { lever_m: f64 },
}

impl BurrDrive {
    /// Whether there is anything to compute, and to save.
    pub fn is_modelled(&self) -> bool {
        self.side_force || self.stall_torque_nm.is_some() || self.torsion.is_some()
    }

    /// Torque that the last tick's contacts and the shaft's friction ask of the motor, N m.
    fn brake_nm(&self) -> f64 {
        self.state.torque_nm + self.friction_torque_nm
    }

    /// Speed under the last tick's torque, rad/s; of a burr on a shaft that twists, its mean over the tick.
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

    /// Takes the contacts of a tick on a burr that cuts with these levers, and has this spin axis and speed.
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
        // One that stands rubs, and that is friction of the contact.
        let sense = if speed_rad_per_s == 0.0 { 0.0 } else { speed_rad_per_s.signum() };
        let seen = |vector: Vector3<f64>| if self.side_force { (vector * sense).into() } else { [0.0; 3] };
        let is_long = matches!(lever, Lever::Mean { .. });
        (self.state.side_force_n, self.state.side_torque_nm) =
            (seen(side_n), if is_long { seen(moment_nm) } else { [0.0; 3] });
    }
}

impl Simulation<'_> {
    /// Lists the burr's balls, and their contacts with bone that carry force.
    pub(super) fn find_burr_contacts(&mut self) {
        self.burr_contacts.clear();
        self.balls_behind.clear();
        let spheres = self.manipulator.proxy_spheres();
        // The burr's spheres are the last ones, from its back to its front.
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

    /// Sets the burr's speed for the tick; a motor that comes to stand is told to whoever drives the burr.
    pub(super) fn turn_burr(&mut self) {
        let (before, stalled_before) = (self.burr_speed_rad_per_s, self.burr_drive.state.shaft.is_stalled);
        self.burr_speed_rad_per_s = self.burr_drive.turn(self.dt_s);
        let drive = &self.burr_drive;
        // A shaft that winds up holds the burr for a while; that is no stall.
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
                nm => format!(", the shaft's friction {}", nm * 1e3),
            };
            let key = drive.stall_key;
            let reason = format!(
                "burr: its motor stands: bone takes {torque_nmm:.3} N mm{friction}, `{key}` is {stall_nmm}"
            );
            self.tell_burr_driver(reason);
        }
        self.manipulator.set_burr_turns(self.burr_speed_rad_per_s != 0.0);
    }

    /// The force of the last tick's cutting on the tool's tip.
    pub(super) fn cutting_wrench(&self) -> Wrench {
        let BurrDriveState { side_force_n, side_torque_nm, .. } = self.burr_drive.state;
        Wrench { force_n: side_force_n.into(), torque_nm: side_torque_nm.into() }
    }

    /// Whether a tick's side force also has a torque that the next tick needs.
    pub(super) fn has_side_torque(&self) -> bool {
        self.burr_drive.side_force && self.manipulator.parameters().cutter.only_radius_m().is_none()
    }

    /// Takes the tick's contacts of the burr; `lever_m` is that of a cutter of several balls.
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
