//! Errors of building a simulation and of computing a tick.

use structures::StructureError;
use thiserror::Error;

use super::{KeyframeError, LostTool, StateVectorError, TubeRefusal};
use crate::arm::ArmError;
use crate::bone::BoneError;
use crate::manipulator::ManipulatorError;
use crate::rigid::RigidError;

/// Errors of building a simulation and of computing a tick.
#[derive(Debug, Error)]
pub enum SimulationError {
    /// The scene has a volume, but the simulation was not given one.
    #[error("the scene has a `[volume]`, but no volume was given")]
    VolumeMissing,
    /// The manipulator rejected its parameters or input.
    #[error("manipulator: {0}")]
    Manipulator(#[from] ManipulatorError),
    /// The bone rejected its parameters or input.
    #[error("bone: {0}")]
    Bone(#[from] BoneError),
    /// The arm rejected its parameters or input.
    #[error("arm: {0}")]
    Arm(#[from] ArmError),
    /// The rigid bodies rejected their parameters or input.
    #[error("rigid bodies: {0}")]
    Rigid(#[from] RigidError),
    /// A critical structure has no shape.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// The tube drive could not plan a stop.
    #[error("tube: {0}")]
    Tube(#[from] TubeRefusal),
    /// The computed state is not physically possible.
    #[error(
        "the simulation has lost the tool: {0}; try a smaller `run.dt_ms` or less extreme tool parameters"
    )]
    Lost(#[from] LostTool),
    /// The bytes are not a keyframe of this scene.
    #[error("keyframe: {0}")]
    Keyframe(#[from] KeyframeError),
    /// The numbers are not a state of this scene.
    #[error(transparent)]
    StateVector(#[from] StateVectorError),
}

impl SimulationError {
    /// Returns whether the machine is the cause: with more memory, the same scene would run.
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self, SimulationError::Bone(BoneError::Memory { .. }))
    }
}
