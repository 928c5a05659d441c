//! What a built-in controller remembers, as bytes: a simulation in another process continues with them.

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

use crate::BuiltIn;

/// The bytes are not the memory of such a controller.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the controller's memory is malformed or of another controller ({0})")]
pub struct MemoryError(String);

impl BuiltIn {
    /// Returns what the controller remembers of its steps, for [`BuiltIn::recall`] in another process with
    /// this build.
    ///
    /// # Errors
    /// None that is known: everything remembered can be written.
    pub fn memory(&self) -> Result<Vec<u8>, MemoryError> {
        match self {
            BuiltIn::CurvedDrilling(controller) => written(&controller.memory),
            BuiltIn::Skiving(controller) => written(&controller.memory),
            BuiltIn::TensionSweep(controller) => written(&controller.memory),
            BuiltIn::TubeDeployment(controller) => written(&controller.memory),
            BuiltIn::Hold(_) => written(&()),
            BuiltIn::Measuring(controller) => written(&(&controller.memory, controller.inner.memory()?)),
        }
    }

    /// Continues from the memory of a controller of the same scene.
    ///
    /// # Errors
    /// If the bytes are not the memory of such a controller; nothing has changed then.
    pub fn recall(&mut self, memory: &[u8]) -> Result<(), MemoryError> {
        match self {
            BuiltIn::CurvedDrilling(controller) => controller.memory = read(memory)?,
            BuiltIn::Skiving(controller) => controller.memory = read(memory)?,
            BuiltIn::TensionSweep(controller) => controller.memory = read(memory)?,
            BuiltIn::TubeDeployment(controller) => controller.memory = read(memory)?,
            BuiltIn::Hold(_) => read::<()>(memory)?,
            BuiltIn::Measuring(controller) => {
                let (own, inner): (_, Vec<u8>) = read(memory)?;
                controller.inner.recall(&inner)?;
                controller.memory = own;
            }
        }
        Ok(())
    }
}

fn written(memory: &impl Serialize) -> Result<Vec<u8>, MemoryError> {
    postcard::to_stdvec(memory).map_err(|cause| MemoryError(cause.to_string()))
}

/// Reads exactly these bytes.
fn read<T: DeserializeOwned>(memory: &[u8]) -> Result<T, MemoryError> {
    match postcard::take_from_bytes(memory) {
        Ok((read, [])) => Ok(read),
        Ok((_, rest)) => Err(MemoryError(format!("{} bytes too many", rest.len()))),
        Err(cause) => Err(MemoryError(cause.to_string())),
    }
}
