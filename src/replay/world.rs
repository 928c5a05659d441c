//! The physics as the log library wants it.

use ipc_types::messages::{Latched, State};
use ipc_types::services::MAX_KEYFRAME_BYTES;
use physics_proc::simulation::Simulation;

/// A simulation that can be compared with a log.
pub struct World<'v> {
    /// The physics.
    pub simulation: Simulation<'v>,
    buffer: Vec<u8>,
}

impl<'v> World<'v> {
    /// Wraps a simulation.
    pub fn new(simulation: Simulation<'v>) -> World<'v> {
        World { simulation, buffer: vec![0; MAX_KEYFRAME_BYTES] }
    }
}

impl recorder_proc::Simulation for World<'_> {
    fn state(&self) -> &State {
        self.simulation.state()
    }

    fn step(&mut self, latched: &Latched) -> Result<(), String> {
        self.simulation.step(latched).map_err(|cause| cause.to_string())
    }

    fn removed(&self) -> &[u32] {
        self.simulation.removed()
    }
}

impl recorder_proc::Resumable for World<'_> {
    fn save(&mut self) -> Result<Vec<u8>, String> {
        let length = self.simulation.write_keyframe(&mut self.buffer).map_err(|cause| cause.to_string())?;
        Ok(self.buffer[..length].to_vec())
    }

    fn resume(&mut self, keyframe: &[u8]) -> Result<(), String> {
        self.simulation.restore_keyframe(keyframe).map_err(|cause| cause.to_string())
    }
}
