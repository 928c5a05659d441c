//! The arm that X-ray frames show, from the mesh files that a scene names.

use std::sync::Arc;

use ipc_types::arm_meshes::{ArmMeshError, solids};
use ipc_types::scene::Arm;
use xray::arm_model::ArmModel;

/// The X-ray model of a scene's arm; `None` where frames show none of it.
///
/// # Errors
/// A mesh file is not there, is not that of the run, or is not closed.
pub fn arm_model(arm: &Arm) -> Result<Option<Arc<ArmModel>>, ArmMeshError> {
    Ok(ArmModel::new(arm, solids(arm)?).map(Arc::new))
}
