//! Pilot holes: bone removed before the run.
//!
//! A pilot hole is the trace of a ball of its radius that cuts everything in its way: a voxel at the hole's
//! wall keeps the part beyond the wall, as seen from the hole's axis. With whole voxels instead, the path of
//! a tool that leans on the wall depends on the grid: 4 mm tunnels ended up to 1 mm apart, but within a tenth
//! of that with partial voxels (`tests/physics/grid_phase.rs`). The baseline removal rules and ball contacts
//! do not support partial voxels, so with them the hole consists of whole voxels.

use nalgebra::Vector3;

use super::Voxels;
use crate::bone::drilling::GONE;
use crate::bone::grid::VoxelIndex;
use crate::bone::query::ContactKind;
use crate::bone::removal::Removal;

/// A hole in the grid's metric frame: all points within `radius_m` of a segment.
struct Capsule {
    from: Vector3<f64>,
    along: Vector3<f64>,
    per_length2: f64,
    radius_m: f64,
}

impl Capsule {
    /// Returns the offset of a point from the nearest point of the segment.
    fn offset(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let t = ((point - self.from).dot(&self.along) * self.per_length2).clamp(0.0, 1.0);
        point - self.from - self.along * t
    }

    /// Returns the fraction of a voxel that a ball of the hole's radius cuts: the remaining surface lies on
    /// the hole's wall, as seen from its axis.
    fn spent(&self, centre: &Vector3<f64>, spacing: &[f64; 3]) -> f64 {
        let offset = self.offset(centre);
        let distance = offset.norm();
        let across = (0..3).map(|axis| offset[axis].abs() * spacing[axis]).sum::<f64>();
        // A voxel on the axis is cut like its neighbours.
        let width = if distance > 0.0 { across / distance } else { spacing[0] };
        (0.5 + (self.radius_m - distance) / width).clamp(0.0, 1.0)
    }
}

impl Voxels {
    /// Removes the bone within `radius_m` of the segment `from`-`to` (world, metres) and returns the numbers
    /// of the voxels that are gone, of which less than half is left, in ascending order. These voxels are
    /// part of the scene: a reset does not restore them. Use before the run; allocates. Removes nothing for
    /// non-finite values or a radius that is not positive.
    pub(in crate::bone) fn predrill_capsule(
        &mut self,
        from_world_m: &Vector3<f64>,
        to_world_m: &Vector3<f64>,
        radius_m: f64,
    ) -> Vec<VoxelIndex> {
        let from = self.geometry.point_to_grid(from_world_m);
        let along = self.geometry.point_to_grid(to_world_m) - from;
        let length = along.norm();
        if !(length.is_finite() && radius_m.is_finite() && radius_m > 0.0) {
            return Vec::new();
        }
        let per_length2 = if length > 0.0 { 1.0 / (length * length) } else { 0.0 };
        let capsule = Capsule { from, along, per_length2, radius_m };
        let (middle, spacing) = (from + along * 0.5, self.geometry.spacing_m);
        // A corner of a cut voxel may lie slightly outside the hole.
        let edge_m = radius_m + spacing.into_iter().fold(0.0, f64::max);
        let reach_m = [0, 1, 2].map(|axis| 0.5 * along[axis].abs() + edge_m);
        let Some(around) = self.occupancy.voxels_in_box(middle.into(), reach_m, spacing) else {
            return Vec::new();
        };
        let whole_voxels =
            self.parameters.removal != Removal::Energy || self.parameters.contact == ContactKind::VoxelBalls;
        let mut gone = Vec::new();
        for k in around.low[2]..=around.high[2] {
            for j in around.low[1]..=around.high[1] {
                for i in around.low[0]..=around.high[0] {
                    if !self.occupancy.is_solid_at([i, j, k]) {
                        continue;
                    }
                    let spent = capsule.spent(&self.geometry.voxel_position([i, j, k]).into(), &spacing);
                    let spent = if whole_voxels { f64::from(u8::from(spent > GONE)) } else { spent };
                    if spent <= 0.0 {
                        continue;
                    }
                    let voxel = [i, j, k].map(|x| x as usize);
                    let was_gone = !self.is_mostly_solid([i, j, k]);
                    // Without memory for a partial voxel, the whole voxel stays or goes.
                    if !self.take_out(voxel, spent) && spent > GONE {
                        self.take_out(voxel, 1.0);
                    }
                    if !was_gone && !self.is_mostly_solid([i, j, k]) {
                        gone.push(self.geometry.index(voxel));
                    }
                }
            }
        }
        self.end_taking_out();
        gone
    }
}
