//! The controller interface, and the built-in controllers.
//!
//! A controller is anything that turns a [`State`] into a [`Command`] once per tick.
//!
//! **Boundary:** a controller sees what a client sees, and nothing of the simulation. This crate opens no files: its
//! caller passes in a function that reads a text. **Invariant:** the controllers here are deterministic, with no
//! clock and no randomness, so that a lockstep run repeats bit for bit.
//! ```
//! use controllers::Controller;
//! use messages::layout::Message;
//! use messages::{BurrMode, Command, State};
//!
//! /// Turns the burr at 8000 rpm from the second second on.
//! struct BurrOn;
//!
//! impl Controller for BurrOn {
//!     fn step(&mut self, state: &State, command: &mut Command) {
//!         command.burr_mode = BurrMode::Speed.code();
//!         command.burr_speed_rad_per_s = if state.sim_time_s > 1.0 { 8000.0 * std::f64::consts::TAU / 60.0 } else { 0.0 };
//!     }
//! }
//!
//! let (state, mut command) = (State::zeroed(), Command::zeroed());
//! BurrOn.step(&state, &mut command);
//! assert_eq!((command.burr_mode, command.burr_speed_rad_per_s), (BurrMode::Speed.code(), 0.0));
//! ```

mod calibration;
mod curved_drilling;
mod geometry;
mod hold;
mod reset;
mod skiving;
mod tension_sweep;
mod tip_finder;

pub use calibration::{Calibration, CalibrationError, CalibrationRow, ReadText};
pub use curved_drilling::CurvedDrillingController;
pub use hold::HoldController;
pub use skiving::{SkivingController, SkivingPoint};
pub use tension_sweep::TensionSweepController;
pub use tip_finder::{TipSighting, find_tip};

use messages::{Command, Frame, State};
use scene::Scene;

/// A controller: answers states with commands.
pub trait Controller {
    /// Answers a state. `command` arrives with `sequence` and `state_tick` filled in and every mode set to "none".
    fn step(&mut self, state: &State, command: &mut Command);

    /// Receives a frame (mono16, rows top to bottom). Called before the step of the tick at which the frame is available.
    fn frame(&mut self, _frame: &Frame, _pixels: &[u16]) {}

    /// A message for the log, if there is a new one since the last call.
    fn remark(&mut self) -> Option<String> {
        None
    }
}

/// The scene's built-in controller of this name; `None` if it is not built in. `read` returns the text of the
/// calibration file that it may need.
///
/// # Errors
/// Its calibration cannot be used.
pub fn built_in(
    scene: &Scene,
    name: &str,
    read: &ReadText,
) -> Result<Option<Box<dyn Controller>>, CalibrationError> {
    let Some(entry) = scene.controller.iter().find(|entry| entry.name == name) else { return Ok(None) };
    if let Some(plan) = &entry.curved_drilling {
        return Ok(Some(Box::new(CurvedDrillingController::new(plan, scene, read)?)));
    }
    if let Some(plan) = &entry.skiving {
        return Ok(Some(Box::new(SkivingController::new(plan))));
    }
    if let Some(plan) = &entry.tension_sweep {
        return Ok(Some(Box::new(TensionSweepController::new(plan, &entry.drives))));
    }
    let hold = entry.hold.as_ref();
    Ok(hold.map(|hold| Box::new(HoldController::new(hold.tension_n, &entry.drives)) as Box<dyn Controller>))
}
