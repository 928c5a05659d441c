//! Applies the latched commands to the actuators.

use messages::{
    ArmMode, BodyMode, BurrMode, Command, CommandSource, ControllerIndex, Latched, Pose, Refusal, TendonMode,
    TubeMode,
};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use super::tube_drive::TubeRefusal;
use super::{Driver, Simulation};
use crate::arm::ArmCommand;
use crate::manipulator::{MAX_TENDONS, ManipulatorModel, Wrench};
use crate::rigid::{BodyDrive, DriveError};

impl Simulation<'_> {
    /// Applies fresh and safe commands; a held command remains in effect.
    pub(super) fn apply(&mut self, latched: &Latched) {
        self.refusals.clear();
        for entry in latched.commands.iter().take(latched.controller_count as usize) {
            if !matches!(entry.source(), Ok(CommandSource::Fresh | CommandSource::Safe)) {
                continue;
            }
            let controller = ControllerIndex(entry.controller_index);
            let command = &entry.command;
            let outcomes = [
                self.apply_tendon(command),
                self.apply_arm(command),
                self.apply_tube(command),
                self.apply_body(controller, command),
            ];
            if entry.source() == Ok(CommandSource::Safe) {
                self.end_motion(controller);
            }
            if entry.command.arm_mode() != Ok(ArmMode::None) && outcomes[1].is_ok() {
                self.arm_driver = Driver { controller, sequence: entry.command.sequence };
            }
            if entry.command.tendon_mode() != Ok(TendonMode::None) {
                self.tendon_driver = Driver { controller, sequence: entry.command.sequence };
            }
            if entry.command.burr_mode() == Ok(BurrMode::Speed) {
                self.burr_drive.state.command_rad_per_s = entry.command.burr_speed_rad_per_s;
                self.burr_driver = Driver { controller, sequence: entry.command.sequence };
            }
            for reason in outcomes.into_iter().filter_map(Result::err) {
                self.refusals.push(Refusal {
                    controller,
                    sequence: entry.command.sequence,
                    reason,
                    stopped_later: false,
                });
            }
        }
    }

    /// Ends what a controller that is late or gone set in motion and its safe command cannot name: the
    /// rates of tendons and the wrench on a body. Tendons and a driven body stay where they are.
    fn end_motion(&mut self, controller: ControllerIndex) {
        if self.tendon_controller == Some(controller) {
            self.tendon.end_rates();
        }
        let body = self.driven_bodies.get(controller.slot()).copied().flatten();
        if let (Some(rigid), Some(body)) = (&mut self.rigid, body) {
            // A driven body refuses it, and goes on to its goal.
            let _ = rigid.drive(body, BodyDrive::Wrench(Wrench::zero()));
        }
    }

    fn apply_tendon(&mut self, command: &Command) -> Result<(), String> {
        // A command has room for more tendons than the tool has; the extra entries are ignored.
        let mine = |all: &[f64; MAX_TENDONS]| {
            core::array::from_fn(|t| if t < self.manipulator.tendon_count() { all[t] } else { 0.0 })
        };
        match command.tendon_mode() {
            Ok(TendonMode::ServoJf) => {
                let now_n = self.manipulator.tendon_tensions_n();
                self.tendon.servo_force(mine(&command.tendon_force_n), now_n);
            }
            Ok(TendonMode::ServoJp) => {
                let now_m = self.manipulator.tendon_displacements_m();
                self.tendon.servo_displacement(mine(&command.tendon_displacement_m), now_m);
            }
            Ok(TendonMode::MoveJp) => {
                let now_m = self.manipulator.tendon_displacements_m();
                let goal_m = mine(&command.tendon_displacement_m);
                self.tendon
                    .move_to(goal_m, now_m, self.dt_s)
                    .map_err(|cause| format!("tendon move_jp: {cause}"))?;
            }
            Ok(TendonMode::ServoJv) => {
                let now_m = self.manipulator.tendon_displacements_m();
                self.tendon.servo_velocity(mine(&command.tendon_velocity_m_per_s), now_m, self.dt_s);
            }
            Ok(TendonMode::None) => {}
            Err(unknown) => return Err(unknown.to_string()),
        }
        Ok(())
    }

    fn apply_tube(&mut self, command: &Command) -> Result<(), String> {
        let mode = command.tube_mode().map_err(|unknown| unknown.to_string())?;
        if mode == TubeMode::None {
            return Ok(());
        }
        let is_stopped = self.arm.state().protective_stop.is_stopped();
        let outcome = match &mut self.tube {
            None => Err(TubeRefusal::NoTube),
            Some(tube) if mode == TubeMode::Hold => tube.hold(),
            Some(_) if is_stopped => Err(TubeRefusal::ProtectiveStop),
            Some(tube) => {
                tube.move_to([command.tube_deployed_m, command.tube_roll_rad], command.tube_speed_m_per_s)
            }
        };
        outcome.map_err(|cause| format!("tube: {cause}"))
    }

    fn apply_body(&mut self, controller: ControllerIndex, command: &Command) -> Result<(), String> {
        let wanted = match command.body_mode().map_err(|unknown| unknown.to_string())? {
            BodyMode::None => return Ok(()),
            BodyMode::ServoCf => BodyDrive::Wrench(Wrench {
                force_n: command.body_wrench.force_n.into(),
                torque_nm: command.body_wrench.torque_nm.into(),
            }),
            BodyMode::ServoCp => BodyDrive::Pose(isometry(&command.t_world_body_goal)),
        };
        let body = self.driven_bodies.get(controller.slot()).copied().flatten();
        let driven = match (&mut self.rigid, body) {
            (Some(rigid), Some(body)) => rigid.drive(body, wanted),
            _ => Err(DriveError::NoBody),
        };
        driven.map_err(|cause| format!("body: {cause}"))
    }

    fn apply_arm(&mut self, command: &Command) -> Result<(), String> {
        let speed_m_per_s = (command.arm_speed_m_per_s > 0.0).then_some(command.arm_speed_m_per_s);
        let mode = command.arm_mode().map_err(|unknown| unknown.to_string())?;
        let wanted = match mode {
            ArmMode::None => return Ok(()),
            ArmMode::ServoJp => {
                ArmCommand::ServoJp { q_rad: command.arm_joint_position_rad, speed_fraction: 1.0 }
            }
            ArmMode::MoveJp => {
                ArmCommand::MoveJp { q_rad: command.arm_joint_position_rad, speed_fraction: 1.0 }
            }
            ArmMode::ServoCp => {
                ArmCommand::ServoCp { t_world_tool: isometry(&command.t_world_base), speed_fraction: 1.0 }
            }
            ArmMode::MoveCp => ArmCommand::MoveCp {
                t_world_tool: isometry(&command.t_world_base),
                max_speed_m_s: speed_m_per_s,
                max_angular_speed_rad_s: None,
            },
            ArmMode::Hold => ArmCommand::Hold,
            ArmMode::ServoJv => ArmCommand::ServoJv { qd_rad_s: command.arm_joint_velocity_rad_per_s },
            ArmMode::Insert => ArmCommand::Insert {
                axis_world: Vector3::from(command.arm_axis),
                depth_m: command.arm_depth_m,
                feed_m_s: command.arm_speed_m_per_s,
            },
            ArmMode::Rcm => ArmCommand::Rcm {
                t_world_tool: isometry(&command.t_world_base),
                pivot_world_m: Vector3::from(command.arm_pivot_m),
                max_speed_m_s: speed_m_per_s,
            },
        };
        self.arm.command(wanted).map_err(|cause| format!("arm: {cause}"))
    }
}

impl Simulation<'_> {
    /// Reports once, to the sender of the last arm command, why the arm aborted a motion or stopped a joint.
    pub(super) fn report_arm_fault(&mut self) {
        let fault = self.arm.state().fault;
        if fault == self.arm_fault {
            return;
        }
        self.arm_fault = fault;
        if let Some(cause) = fault {
            let Driver { controller, sequence } = self.arm_driver;
            let reason = format!("arm: motion aborted: {cause}");
            self.refusals.push(Refusal { controller, sequence, reason, stopped_later: true });
        }
    }
}

impl Simulation<'_> {
    /// Reports to the sender of the last tendon command that a fixture holds it back.
    pub(super) fn tell_tendon_driver(&mut self, reason: String) {
        let Driver { controller, sequence } = self.tendon_driver;
        self.refusals.push(Refusal { controller, sequence, reason, stopped_later: true });
    }

    /// Reports a problem to the sender of the last burr command.
    pub(super) fn tell_burr_driver(&mut self, reason: String) {
        let Driver { controller, sequence } = self.burr_driver;
        self.refusals.push(Refusal { controller, sequence, reason, stopped_later: true });
    }
}

/// Returns a message's pose as a transform; renormalises the quaternion to remove its rounding.
fn isometry(pose: &Pose) -> Isometry3<f64> {
    let [x, y, z, w] = pose.orientation_xyzw;
    let [px, py, pz] = pose.position_m;
    Isometry3::from_parts(
        Translation3::new(px, py, pz),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    )
}
