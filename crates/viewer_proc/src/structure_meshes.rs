//! The critical structures as the page draws them.

use ipc_types::scene::{Scene, Structure};

use crate::board::Board;
use crate::channels::STRUCTURES;
use crate::surface::{smooth_mesh, structure_surface};

/// Most triangles of all structures of a scene, in equal shares. In software, a picture takes as long as it
/// has triangles; the bone's coarse surface has about 50 000.
const MOST_TRIANGLES: usize = 20_000;

/// Publishes a mesh of each structure with a surface of its own, also to clients that connect later. Its
/// block is the structure's index in the scene.
pub(crate) fn publish(scene: &Scene, board: &Board) {
    let is_drawn = |structure: &&Structure| structure.built_in.is_none();
    let most = MOST_TRIANGLES / scene.structure.iter().filter(is_drawn).count().max(1);
    for (index, structure) in scene.structure.iter().enumerate() {
        match structure_surface(scene, structure, most) {
            Ok(Some(triangles)) => {
                let mesh = smooth_mesh(index as u32, &triangles);
                board.publish(STRUCTURES, board.time_ns(), mesh.block, mesh.bytes());
            }
            Ok(None) => {}
            Err(error) => board.notice("warning", &format!("a structure is not drawn: {error}")),
        }
    }
}
