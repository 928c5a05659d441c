//! The controller trait, the reference controllers, and their process.
//!
//! A controller is anything that turns a [`State`] into a [`Command`] once a tick. Those here are deterministic: no
//! clock, no randomness, so that a lockstep run repeats bit for bit.

mod curved_drilling;
mod geometry;
mod hold;
pub mod process;
mod tip_finder;

pub use curved_drilling::CurvedDrillingController;
pub use hold::HoldController;
pub use tip_finder::{TipSighting, find_tip};

use ipc_types::messages::{Command, Frame, State};

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
