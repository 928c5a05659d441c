use messages::{ArmMode, BurrMode, Command, State, TendonMode, TubeMode};
use scene::Drives;

use crate::Controller;

/// Holds a tension, the positions of arm and tube, and the burr at rest, as far as it drives them.
#[derive(Debug, Clone)]
pub struct HoldController {
    tension_n: f64,
    drives: Vec<Drives>,
}

impl HoldController {
    /// Creates a controller that holds `tension_n` on tendon 0.
    pub fn new(tension_n: f64, drives: &[Drives]) -> HoldController {
        HoldController { tension_n, drives: drives.to_vec() }
    }
}

impl Controller for HoldController {
    fn step(&mut self, _state: &State, command: &mut Command) {
        for part in &self.drives {
            match part {
                Drives::Tendon => {
                    command.tendon_mode = TendonMode::ServoJf.code();
                    command.tendon_force_n[0] = self.tension_n;
                }
                Drives::Arm => command.arm_mode = ArmMode::Hold.code(),
                Drives::Burr => command.burr_mode = BurrMode::Speed.code(),
                Drives::Tube => command.tube_mode = TubeMode::Hold.code(),
                Drives::Body | Drives::CArm => {}
            }
        }
    }
}
