//! Receives the volume.

use ipc_types::messages::Volume;
use ipc_types::messages::services;
use ipc_types::ports::ReceivedMessage;
use ipc_types::process::{EndRequest, await_volume};
use ipc_types::scene::Scene;
use ipc_types::session::Session;
use simulation::CtView;
use zerocopy::FromBytes;

use super::PhysicsError;

/// Receives the volume in shared memory; it stays mapped for as long as the return value lives.
pub(super) fn receive_volume(
    session: &Session,
    scene: &Scene,
    end: &EndRequest,
) -> Result<Option<ReceivedMessage<Volume>>, PhysicsError> {
    if scene.volume.is_none() {
        return Ok(None);
    }
    let subscriber = session.subscriber::<Volume>(&services::VOLUME)?;
    Ok(Some(await_volume(&subscriber, end)?))
}

/// Returns a view of the CT, without copying.
pub(super) fn ct(volume: &ReceivedMessage<Volume>) -> Result<CtView<'_>, PhysicsError> {
    let bad = |problem: String| PhysicsError::BadVolume { problem };
    let grid = volume.message().grid().map_err(|cause| bad(cause.to_string()))?;
    let hu = <[i16]>::ref_from_bytes(volume.tail())
        .map_err(|cause| bad(format!("the voxels are misaligned: {cause}")))?;
    if hu.len() != grid.voxel_count() {
        return Err(bad(format!("{} voxels, but the dimensions are {:?}", hu.len(), grid.dims())));
    }
    Ok(CtView::new(&grid, hu))
}
