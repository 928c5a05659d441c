//! The controller interface, and the built-in controllers.
//!
//! A controller is anything that turns a [`State`] into a [`Command`] once per tick.
//!
//! **Boundary:** a controller sees what a client sees, and nothing of the simulation. This crate opens no
//! files: its caller passes in a function that reads a text. **Invariant:** the controllers here are
//! deterministic, with no clock and no randomness, so that a lockstep run repeats bit for bit.
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
mod measuring;
mod memory;
mod reset;
mod skiving;
mod tension_sweep;
mod tip_finder;
mod tube_deployment;

pub use calibration::{Calibration, CalibrationError, CalibrationRow, ReadText};
pub use curved_drilling::CurvedDrillingController;
pub use hold::HoldController;
pub use measuring::MeasuringController;
pub use memory::MemoryError;
pub use skiving::{SkivingController, SkivingPoint};
pub use tension_sweep::TensionSweepController;
pub use tip_finder::{TipSighting, find_tip};
pub use tube_deployment::TubeDeploymentController;

use messages::{Command, Frame, SensorReading, State};
use scene::Scene;

/// A controller: answers states with commands.
pub trait Controller {
    /// Answers a state. `command` arrives with `sequence` and `state_tick` filled in and every mode set to
    /// "none".
    fn step(&mut self, state: &State, command: &mut Command);

    /// Receives a frame (mono16, rows top to bottom). Called before the step of the tick at which the frame
    /// is available.
    fn frame(&mut self, _frame: &Frame, _pixels: &[u16]) {}

    /// Receives a reading of a sensor. Called before the step of the state with which the reading arrives.
    fn reading(&mut self, _reading: &SensorReading) {}

    /// Returns a message for the log, if there is a new one since the last call.
    fn remark(&mut self) -> Option<String> {
        None
    }
}

/// A built-in controller. A copy continues from the original's state.
#[derive(Debug, Clone)]
pub enum BuiltIn {
    /// Drills a curve.
    CurvedDrilling(Box<CurvedDrillingController>),
    /// Skives, measuring the burr's drift.
    Skiving(Box<SkivingController>),
    /// Sweeps the tension.
    TensionSweep(Box<TensionSweepController>),
    /// Slides a tube out of its outer tube.
    TubeDeployment(Box<TubeDeploymentController>),
    /// Holds still.
    Hold(Box<HoldController>),
    /// A built-in controller that sees sensor measurements instead of the exact state.
    Measuring(Box<MeasuringController>),
}

impl BuiltIn {
    /// Creates the scene's built-in controller of this name; `None` if it is not built in. `read` returns the
    /// text of its calibration file, if it needs one.
    ///
    /// # Errors
    /// If its calibration cannot be used.
    pub fn of(scene: &Scene, name: &str, read: &ReadText) -> Result<Option<BuiltIn>, CalibrationError> {
        let Some(entry) = scene.controller.iter().find(|entry| entry.name == name) else { return Ok(None) };
        let exact = BuiltIn::on_states(scene, entry, read)?;
        if entry.sensors.is_empty() {
            return Ok(exact);
        }
        let measuring =
            |inner| BuiltIn::Measuring(Box::new(MeasuringController::new(inner, scene, &entry.sensors)));
        Ok(exact.map(measuring))
    }

    /// Creates the controller without its sensors.
    fn on_states(
        scene: &Scene,
        entry: &scene::Controller,
        read: &ReadText,
    ) -> Result<Option<BuiltIn>, CalibrationError> {
        if let Some(plan) = &entry.curved_drilling {
            let controller = CurvedDrillingController::new(plan, scene, read)?;
            return Ok(Some(BuiltIn::CurvedDrilling(Box::new(controller))));
        }
        if let Some(plan) = &entry.skiving {
            return Ok(Some(BuiltIn::Skiving(Box::new(SkivingController::new(plan)))));
        }
        if let Some(plan) = &entry.tension_sweep {
            let controller = TensionSweepController::new(plan, &entry.drives);
            return Ok(Some(BuiltIn::TensionSweep(Box::new(controller))));
        }
        if let Some(plan) = &entry.tube_deployment {
            let controller = TubeDeploymentController::new(plan, &entry.drives);
            return Ok(Some(BuiltIn::TubeDeployment(Box::new(controller))));
        }
        let hold = entry.hold.as_ref();
        Ok(hold.map(|hold| BuiltIn::Hold(Box::new(HoldController::new(hold.tension_n, &entry.drives)))))
    }

    fn inner(&mut self) -> &mut dyn Controller {
        match self {
            BuiltIn::CurvedDrilling(controller) => controller.as_mut(),
            BuiltIn::Skiving(controller) => controller.as_mut(),
            BuiltIn::TensionSweep(controller) => controller.as_mut(),
            BuiltIn::TubeDeployment(controller) => controller.as_mut(),
            BuiltIn::Hold(controller) => controller.as_mut(),
            BuiltIn::Measuring(controller) => controller.as_mut(),
        }
    }
}

impl Controller for BuiltIn {
    fn step(&mut self, state: &State, command: &mut Command) {
        self.inner().step(state, command);
    }

    fn frame(&mut self, frame: &Frame, pixels: &[u16]) {
        self.inner().frame(frame, pixels);
    }

    fn reading(&mut self, reading: &SensorReading) {
        self.inner().reading(reading);
    }

    fn remark(&mut self) -> Option<String> {
        self.inner().remark()
    }
}

/// As [`BuiltIn::of`], as a trait object.
///
/// # Errors
/// If its calibration cannot be used.
pub fn built_in(
    scene: &Scene,
    name: &str,
    read: &ReadText,
) -> Result<Option<Box<dyn Controller>>, CalibrationError> {
    Ok(BuiltIn::of(scene, name, read)?.map(|controller| Box::new(controller) as Box<dyn Controller>))
}
