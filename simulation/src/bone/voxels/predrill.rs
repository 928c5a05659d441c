//! Pilot holes: voxels removed before the run.

use nalgebra::Vector3;

use super::Voxels;
use crate::bone::grid::VoxelIndex;

impl Voxels {
    /// Removes the bone whose voxel centres lie within `radius_m` of the segment `from`-`to` (world, metres) and returns the voxel
    /// numbers in ascending order. These voxels are part of the scene: a reset does not restore them. Use before the run; allocates.
    /// Removes nothing for non-finite values or a radius that is not positive.
    pub(in crate::bone) fn predrill_capsule(
        &mut self,
        from_world_m: &Vector3<f64>,
        to_world_m: &Vector3<f64>,
        radius_m: f64,
    ) -> Vec<VoxelIndex> {
        let from = self.geometry.point_to_grid(from_world_m);
        let to = self.geometry.point_to_grid(to_world_m);
        let along = to - from;
        let length = along.norm();
        if !(length.is_finite() && radius_m.is_finite() && radius_m > 0.0) {
            return Vec::new();
        }
        let middle = from + along * 0.5;
        let spacing = self.geometry.spacing_m;
        let Some(voxels) = self.occupancy.voxels_around(middle.into(), 0.5 * length + radius_m, spacing)
        else {
            return Vec::new();
        };
        let inverse_square = if length > 0.0 { 1.0 / (length * length) } else { 0.0 };
        let mut removed = Vec::new();
        for k in voxels.low[2] as usize..=voxels.high[2] as usize {
            for j in voxels.low[1] as usize..=voxels.high[1] as usize {
                for i in voxels.low[0] as usize..=voxels.high[0] as usize {
                    let centre =
                        Vector3::new(i as f64 * spacing[0], j as f64 * spacing[1], k as f64 * spacing[2]);
                    let t = ((centre - from).dot(&along) * inverse_square).clamp(0.0, 1.0);
                    let inside = (centre - from - along * t).norm_squared() <= radius_m * radius_m;
                    if inside && self.occupancy.is_solid(i, j, k) {
                        removed.push([i, j, k]);
                    }
                }
            }
        }
        self.take_out(&removed);
        removed.into_iter().map(|voxel| self.geometry.index(voxel)).collect()
    }
}
