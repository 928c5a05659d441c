//! The arm that X-ray frames show, from the mesh files that a scene names.

use std::sync::Arc;

use ipc_types::arm_meshes::{ArmMeshError, solids};
use ipc_types::scene::Arm;
use xray::arm_model::ArmModel;

/// Returns the X-ray model of a scene's arm; `None` if frames do not show it.
///
/// # Errors
/// If a mesh file is missing, differs from the run's, or is not closed.
pub fn arm_model(arm: &Arm) -> Result<Option<Arc<ArmModel>>, ArmMeshError> {
    Ok(ArmModel::new(arm, solids(arm)?).map(Arc::new))
}
