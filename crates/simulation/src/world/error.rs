//! Why a simulation cannot be built or a tick cannot be computed.

use thiserror::Error;

use super::{KeyframeError, LostTool, TubeRefusal};
use crate::arm::ArmError;
use crate::bone::BoneError;
use crate::manipulator::ManipulatorError;
use crate::rigid::RigidError;

/// Why a simulation cannot be built or a tick cannot be computed.
#[derive(Debug, Error)]
pub enum SimulationError {
    /// The scene has a volume, but the simulation was not given one.
    #[error("the scene has a `[volume]`, but no volume was given")]
    VolumeMissing,
    /// The manipulator refused its parameters or input.
    #[error("manipulator: {0}")]
    Manipulator(#[from] ManipulatorError),
    /// The bone did.
    #[error("bone: {0}")]
    Bone(#[from] BoneError),
    /// The arm did.
    #[error("arm: {0}")]
    Arm(#[from] ArmError),
    /// The rigid bodies did.
    #[error("rigid bodies: {0}")]
    Rigid(#[from] RigidError),
    /// The drive of a tube found no way to stop.
    #[error("tube: {0}")]
    Tube(#[from] TubeRefusal),
    /// The computed state is none of the tool.
    #[error(
        "the simulation has lost the tool: {0}; a smaller `run.dt_ms` or less extreme parameters of the tool may hold it"
    )]
    Lost(#[from] LostTool),
    /// The bytes are not a keyframe of this scene.
    #[error("keyframe: {0}")]
    Keyframe(#[from] KeyframeError),
}

impl SimulationError {
    /// Whether it is the machine's fault: with more memory the same scene works.
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self, SimulationError::Bone(BoneError::Memory { .. }))
    }
}
