//! The controller trait, the reference controllers, and their process.
//!
//! A controller is anything that turns a [`State`] into a [`Command`] once a tick.
//!
//! **Boundary:** a controller sees what a client sees, and nothing of the simulation. **Invariant:** those here are deterministic: no
//! clock, no randomness, so that a lockstep run repeats bit for bit.

mod bone_seen;
mod calibration;
mod curved_drilling;
mod geometry;
mod hold;
pub mod process;
mod skiving;
mod tension_sweep;
mod tip_finder;

pub use calibration::{Calibration, CalibrationError, CalibrationRow};
pub use curved_drilling::CurvedDrillingController;
pub use hold::HoldController;
pub use skiving::{SkivingController, SkivingPoint};
pub use tension_sweep::TensionSweepController;
pub use tip_finder::{TipSighting, find_tip};

use ipc_types::messages::{Command, Frame, State};
use ipc_types::scene::Scene;

/// What a controller does.
pub trait Controller {
    /// Answers a state. `command` comes with `sequence` and `state_tick` filled in and every mode at "none".
    fn step(&mut self, state: &State, command: &mut Command);

    /// Sees a frame (mono16, rows top to bottom). Called before the step of the tick at which it is there.
    fn frame(&mut self, _frame: &Frame, _pixels: &[u16]) {}

    /// A message for the log since the last call, if any.
    fn remark(&mut self) -> Option<String> {
        None
    }
}

/// The built-in controller that a scene names so; `None` if it is not a built-in one.
///
/// # Errors
/// Its calibration cannot be used.
pub fn built_in(scene: &Scene, name: &str) -> Result<Option<Box<dyn Controller>>, CalibrationError> {
    let Some(entry) = scene.controller.iter().find(|entry| entry.name == name) else { return Ok(None) };
    if let Some(plan) = &entry.curved_drilling {
        return Ok(Some(Box::new(CurvedDrillingController::new(plan, scene)?)));
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
