//! The patch of bone that a cutter of several balls touches, and the lever arm at which it cuts there.
//!
//! A touched voxel represents the point of its ball that is nearest to it. Its area is that of its exposed
//! faces, projected onto the direction to the ball's centre: over a plane of any direction, these areas add
//! up to that of the plane.

use nalgebra::Vector3;

use super::cutting::TickLoads;
use super::drilling::DrillTick;
use super::reach::BurrPress;

/// Fraction of the reach below which the cutter's depth in bone is ignored: such bone, left over from a wall
/// that the cutter has passed, presses with a hundredth or less. It recedes ever more slowly, and a long wall
/// of it would count as much as the hole's bottom.
const LEAST_DEPTH: f64 = 0.01;

/// A touched voxel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patch {
    /// Direction to the ball, grid axes, unit length.
    toward: Vector3<f64>,
    area_m2: f64,
    /// Distance of the ball's nearest point from the spin axis.
    lever_m: f64,
}

impl DrillTick<'_> {
    /// Returns the mean lever arm in m of the contacts of a cutter of several balls, weighted by their
    /// forces. A cutter that touches nothing, or whose contacts are unknown, cuts with its end.
    pub(super) fn lever_m(&mut self, press: &BurrPress, work: &TickLoads) -> f64 {
        let end_m = work.widest_radius_m() * (2.0 / 3.0);
        self.collect_patch(press);
        let to_grid = self.edit.geometry().direction_world_grid.transpose();
        let (mut force_n, mut torque_nm) = (0.0, 0.0);
        for contact in work.contacts {
            let normal = to_grid * contact.normal;
            let (mut area_m2, mut moment_m3) = (0.0, 0.0);
            for Patch { toward, area_m2: own_m2, lever_m } in &self.scratch.patch {
                let seen_m2 = own_m2 * normal.dot(toward).max(0.0);
                area_m2 += seen_m2;
                moment_m3 += seen_m2 * lever_m;
            }
            let lever_m = if area_m2 > 0.0 { moment_m3 / area_m2 } else { end_m };
            force_n += contact.normal_force_n;
            torque_nm += contact.normal_force_n * lever_m;
        }
        if force_n > 0.0 { torque_nm / force_n } else { end_m }
    }

    fn collect_patch(&mut self, press: &BurrPress) {
        self.scratch.patch.clear();
        let [front, .., back] = press.balls else { return };
        let along = front.centre - back.centre;
        let axis = along / along.norm();
        let voxels = self.edit.parameters();
        let least_depth = LEAST_DEPTH * voxels.cutting.reach_m / self.edit.geometry().smallest_spacing_m();
        for voxel in (0..self.reached.index.len()).filter(|voxel| self.reached.depth[*voxel] > least_depth) {
            let ball = self.reached.ball_in(voxel, press);
            let offset = self.reached.offset(voxel, &ball.centre);
            // A voxel exactly at the centre of a ball has no direction.
            let toward = offset / offset.norm().max(f64::MIN_POSITIVE);
            let faces_m2 = self.bare_faces_m2(voxel, &offset);
            let area_m2 = (0..3).map(|axis| faces_m2[axis] * toward[axis].abs()).sum();
            let lever_m = ball.radius_m * (toward - axis * toward.dot(&axis)).norm();
            self.scratch.patch.push(Patch { toward, area_m2, lever_m });
        }
    }
}
