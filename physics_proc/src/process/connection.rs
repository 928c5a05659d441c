//! Receives the volume.

use ipc_types::messages::Volume;
use ipc_types::ports::Received;
use ipc_types::process::{EndRequest, VOLUME_LIMIT, await_volume};
use ipc_types::scene::Scene;
use ipc_types::services;
use ipc_types::session::Session;
use zerocopy::FromBytes;

use super::PhysicsError;

/// Receives the volume in shared memory; it stays mapped for as long as the return value lives.
pub(super) fn receive_volume(
    session: &Session,
    scene: &Scene,
    end: &EndRequest,
) -> Result<Option<Received<Volume>>, PhysicsError> {
    if scene.volume.is_none() {
        return Ok(None);
    }
    let subscriber = session.subscriber::<Volume>(&services::VOLUME)?;
    let volume = await_volume(&subscriber, end)?;
    volume.map(Some).ok_or(PhysicsError::NoVolume { limit_s: VOLUME_LIMIT.as_secs() })
}

/// The volume's voxels, in place.
pub(super) fn hounsfield_units(volume: &Received<Volume>) -> Result<&[i16], PhysicsError> {
    let message = volume.message();
    let expected = message.dimensions.iter().map(|n| *n as u64).product::<u64>();
    if expected != u64::from(message.hu_length) {
        let problem =
            format!("{} voxels, but the dimensions are {:?}", message.hu_length, message.dimensions);
        return Err(PhysicsError::BadVolume { problem });
    }
    <[i16]>::ref_from_bytes(volume.tail())
        .map_err(|cause| PhysicsError::BadVolume { problem: format!("the voxels are misaligned: {cause}") })
}
