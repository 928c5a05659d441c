//! Drilling with a tool that slides out of its outer tube: turns it, slides it out with the burr on, and
//! retracts it.

use messages::{ArmMode, BurrMode, Command, State, TubeMode};
use scene::{Drives, TubeDeployment};
use serde::{Deserialize, Serialize};

use crate::Controller;
use crate::reset::ResetWatch;

/// A goal closer than this counts as reached, m and rad: the drive ends its motion there, up to rounding.
const REACHED: f64 = 1e-9;

/// Phase of the procedure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
enum Phase {
    #[default]
    Turning,
    Deploying,
    Retracting,
    Done,
}

/// Turns the tube, slides it out and retracts it; holds the arm if it drives that.
#[derive(Debug, Clone)]
pub struct TubeDeploymentController {
    deployed_m: f64,
    end_m: f64,
    roll_rad: f64,
    feed_m_per_s: f64,
    burr_speed_rad_per_s: f64,
    drives: Vec<Drives>,
    pub(crate) memory: Memory,
}

/// Everything that its steps change.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Memory {
    phase: Phase,
    reset: ResetWatch,
    remark: Option<String>,
}

impl TubeDeploymentController {
    /// Creates a controller for this plan.
    pub fn new(plan: &TubeDeployment, drives: &[Drives]) -> TubeDeploymentController {
        TubeDeploymentController {
            deployed_m: plan.deployed_mm * 1e-3,
            end_m: (plan.deployed_mm - plan.retraction_mm) * 1e-3,
            roll_rad: plan.roll_deg.to_radians(),
            feed_m_per_s: plan.feed_mm_per_s * 1e-3,
            burr_speed_rad_per_s: plan.burr_speed_rpm * core::f64::consts::TAU / 60.0,
            drives: drives.to_vec(),
            memory: Memory::default(),
        }
    }

    /// Moves on to the next phase once this one's goal is reached.
    fn advance(&mut self, state: &State) {
        let is_at = |goal_m: f64| (state.tube_deployed_m - goal_m).abs() < REACHED;
        let is_turned = (state.tube_roll_rad - self.roll_rad).abs() < REACHED;
        self.memory.phase = match self.memory.phase {
            Phase::Turning if is_turned => Phase::Deploying,
            Phase::Deploying if is_at(self.deployed_m) => Phase::Retracting,
            Phase::Retracting if is_at(self.end_m) => Phase::Done,
            _ => return,
        };
        self.memory.remark = Some(format!(
            "tube: {:.2} mm out, roll {:.1} deg, bend {:+.2} deg, force {:.2} N",
            state.tube_deployed_m * 1e3,
            state.tube_roll_rad.to_degrees(),
            state.bend_rad.to_degrees(),
            state.burr_force_n
        ));
    }
}

impl Controller for TubeDeploymentController {
    fn step(&mut self, state: &State, command: &mut Command) {
        if self.memory.reset.was_reset(state) {
            self.memory.phase = Phase::Turning;
        }
        self.advance(state);
        if self.drives.contains(&Drives::Tube) {
            command.tube_mode = TubeMode::MoveJp.code();
            command.tube_roll_rad = self.roll_rad;
            command.tube_speed_m_per_s = self.feed_m_per_s;
            command.tube_deployed_m = match self.memory.phase {
                Phase::Turning => 0.0,
                Phase::Deploying => self.deployed_m,
                Phase::Retracting | Phase::Done => self.end_m,
            };
        }
        if self.drives.contains(&Drives::Burr) {
            command.burr_mode = BurrMode::Speed.code();
            if matches!(self.memory.phase, Phase::Deploying | Phase::Retracting) {
                command.burr_speed_rad_per_s = self.burr_speed_rad_per_s;
            }
        }
        if self.drives.contains(&Drives::Arm) {
            command.arm_mode = ArmMode::Hold.code();
        }
    }

    fn remark(&mut self) -> Option<String> {
        self.memory.remark.take()
    }
}
