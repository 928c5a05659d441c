//! What the voxels that a run drilled are compared with.

use ipc_types::scene::Scene;
use simulation::bone::OuterSurface;
use simulation::outer_surface;
use structures::Regions;
use voxel_grid::Volume;

/// The bone of a scene with its structures, before anything is drilled.
#[derive(Debug, Clone, PartialEq)]
pub struct Anatomy {
    /// Where the critical structures are; `None` without a structure.
    pub regions: Option<Regions>,
    /// The outer surface of the bone; `None` with a tool that cannot be used.
    pub surface: Option<OuterSurface>,
}

impl Anatomy {
    /// Finds both in a volume; `None` without one.
    pub fn of(scene: &Scene, volume: Option<&Volume>) -> Option<Anatomy> {
        let volume = volume?;
        Some(Anatomy { regions: Regions::of(scene, Some(volume)), surface: outer_surface(scene, volume) })
    }
}
