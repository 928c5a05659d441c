//! The outer surface of a scene's bone, with the entry of its tool.

use nalgebra::Vector3;
use scene::Scene;
use voxel_grid::Volume;

use super::setup::manipulator_parameters;
use crate::bone::{Entry, GridGeometry, OuterSurface, Outside};

/// How much wider than the tool's widest part the entry is, m, besides a voxel: what the burr cuts beyond its
/// surface, and the play of a burr that touches down on a slanting surface.
const ENTRY_PLAY_M: f64 = 1e-3;

/// Returns the outer surface of the bone of a scene with its volume; `None` without bone or with a tool that
/// cannot be used.
pub fn outer_surface(scene: &Scene, volume: &Volume) -> Option<OuterSurface> {
    let tool = manipulator_parameters(scene).ok()?;
    let geometry = GridGeometry::from(&volume.grid);
    let outside = Outside::new(geometry, &volume.hu, scene.volume.as_ref()?.bone_threshold_hu);
    let voxel_m = geometry.spacing_m.into_iter().fold(0.0, f64::max);
    let entry = Entry {
        at_m: Vector3::from(scene.tool.burr_start_mm) * 1e-3,
        along: Vector3::from(scene.tool.direction).try_normalize(0.0)?,
        radius_m: tool.cutter.widest_radius_m().max(tool.widest_tube_m()) + ENTRY_PLAY_M + voxel_m,
    };
    Some(OuterSurface::new(outside, entry))
}
