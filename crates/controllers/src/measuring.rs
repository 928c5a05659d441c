//! A built-in controller that sees sensor measurements instead of the exact state.

use messages::{Command, Frame, SensorReading, State};
use scene::Scene;
use sensors::MeasuredState;
use serde::{Deserialize, Serialize};

use crate::reset::ResetWatch;
use crate::{BuiltIn, Controller};

/// Passes the measured state to a controller. Sends empty commands until each of its sensors has measured.
#[derive(Debug, Clone)]
pub struct MeasuringController {
    pub(crate) inner: BuiltIn,
    pub(crate) memory: Memory,
}

/// Everything that its steps change, besides what the inner controller remembers.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Memory {
    measured: MeasuredState,
    reset: ResetWatch,
}

impl MeasuringController {
    /// Wraps a controller that sees the sensors of these names.
    pub fn new(inner: BuiltIn, scene: &Scene, sensors: &[String]) -> MeasuringController {
        let measured = MeasuredState::new(scene, sensors);
        MeasuringController { inner, memory: Memory { measured, reset: ResetWatch::default() } }
    }
}

impl Controller for MeasuringController {
    fn step(&mut self, state: &State, command: &mut Command) {
        if self.memory.reset.was_reset(state) {
            self.memory.measured.forget_before(state.tick);
        }
        if self.memory.measured.is_complete() {
            self.inner.step(&self.memory.measured.of(state), command);
        }
    }

    fn frame(&mut self, frame: &Frame, pixels: &[u16]) {
        self.inner.frame(frame, pixels);
    }

    fn reading(&mut self, reading: &SensorReading) {
        self.memory.measured.see(reading);
    }

    fn remark(&mut self) -> Option<String> {
        self.inner.remark()
    }
}
