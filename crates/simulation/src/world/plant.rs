//! Implements the hub's [`Plant`] for the simulation.

use messages::{
    Approach, ArmEntry, Breach, Latched, PastStop, Plant, Refusal, SensorReading, State, TipJacobian,
};

use super::{Simulation, SimulationError};

impl Plant for Simulation<'_> {
    type Error = SimulationError;

    fn state(&self) -> &State {
        self.state()
    }

    fn step(&mut self, latched: &Latched) -> Result<(), SimulationError> {
        self.step(latched)
    }

    fn removed(&self) -> &[u32] {
        self.removed()
    }

    fn predrilled(&self) -> &[u32] {
        self.predrilled()
    }

    fn readings(&self) -> &[SensorReading] {
        self.readings()
    }

    fn tip_jacobian(&self) -> Option<TipJacobian> {
        Some(self.tip_jacobian())
    }

    fn refusals(&self) -> &[Refusal] {
        self.refusals()
    }

    fn uncut_voxels(&self) -> usize {
        self.uncut_voxels()
    }

    fn left_out_contacts(&self) -> usize {
        self.left_out_contacts
    }

    fn arm_entry(&self) -> Option<&ArmEntry> {
        self.arm_entry()
    }

    fn breach(&self) -> Option<&Breach> {
        self.breach()
    }

    fn approaches(&self) -> &[Approach] {
        self.approaches()
    }

    fn invalid_flexure(&self) -> Option<PastStop> {
        self.invalid_flexure()
    }

    fn make_room(&mut self) {
        self.make_room();
    }

    fn write_keyframe(&self, buffer: &mut [u8]) -> Result<usize, SimulationError> {
        Ok(self.write_keyframe(buffer)?)
    }

    fn restore_keyframe(&mut self, keyframe: &[u8]) -> Result<(), SimulationError> {
        self.restore_keyframe(keyframe)
    }
}
