//! The force below which the burr's edges plough and do not cut: edge pressure times the area that the burr touches, as seen along its
//! contacts' normals, weighted by their forces.
//!
//! **Area.** A burr that fills its hole touches the hole's cross-section, whatever the voxels' size. Through a row of voxels runs one surface,
//! and it lies where the share that is cut falls, from 1 in the open to 0 in whole bone: a voxel has the face's area times how much the share
//! falls from the voxel before it, toward the burr, to the one behind. In a row beside the hole's rim the wall that the burr has passed keeps
//! a part of each voxel; what the burr touches in such a row is the other part. Taking a voxel that has partly cut bone before it for covered
//! leaves the rim out: a tenth of the cross-section in voxels of 0.25 mm and a third in voxels of 1 mm, for a burr of 6.5 mm.
//!
//! **Seen along a normal** is the part of the patch that faces it: the voxels from which the burr's centre lies on the normal's side. Their
//! areas add up as vectors, so that steps of the voxels' grid cancel. For a burr in its hole and a normal at an angle t to the feed this is
//! (1 + cos t) / 2 of the cross-section, the half of a ball as seen from that side.

use nalgebra::Vector3;

use super::cutting::BurrContact;
use super::drilling::DrillTick;
use super::reach::Press;

/// A voxel beside another one.
#[derive(Debug, Clone, Copy)]
enum Beside {
    /// No bone.
    Open,
    /// Bone of which this share is cut, out of the burr's touch.
    Bone(f64),
    /// Bone that the burr touches.
    Touched(f64),
}

impl Beside {
    /// The share that is cut.
    fn cut(self) -> f64 {
        match self {
            Beside::Open => 1.0,
            Beside::Bone(cut) | Beside::Touched(cut) => cut,
        }
    }
}

impl DrillTick<'_> {
    /// Sum of edge pressure times area over the touched voxels, N. Without contacts the burr's own direction is unknown, and each voxel
    /// counts with all that it turns toward the burr.
    pub(super) fn edge_force_n(&self, hu: &[i16], press: &Press, contacts: &[BurrContact]) -> f64 {
        let to_grid = self.edit.geometry().direction_world_grid.transpose();
        let force_n: f64 = contacts.iter().map(|contact| contact.normal_force_n).sum();
        let mut edge_n = 0.0;
        for voxel in (0..self.reached.index.len()).filter(|voxel| self.reached.depth[*voxel] > 0.0) {
            let to_burr = self.reached.offset(voxel, &self.reached.ball_in(voxel, press).centre);
            let area_m2 = self.facing_m2(voxel, &to_burr);
            let seen_m2 = if contacts.is_empty() {
                area_m2.abs().sum()
            } else {
                let along = contacts.iter().map(|contact| (to_grid * contact.normal, contact.normal_force_n));
                let facing = along.filter(|(normal, _)| normal.dot(&to_burr) > 0.0);
                facing.fold(0.0, |sum, (normal, n)| sum + normal.dot(&area_m2) * (n / force_n))
            };
            let pressure_pa = self.edit.material().edge_pressure_pa(hu[self.reached.index[voxel].at()]);
            edge_n += pressure_pa * seen_m2;
        }
        // Of a patch that turns away from its contacts nothing is seen.
        edge_n.max(0.0)
    }

    /// Area of a touched voxel's surface in m^2, as a vector in the grid's frame that points out of the bone; `to_burr` runs from the voxel
    /// to the burr.
    fn facing_m2(&self, voxel: usize, to_burr: &Vector3<f64>) -> Vector3<f64> {
        let [hx, hy, hz] = self.edit.geometry().spacing_m;
        let faces_m2 = [hy * hz, hz * hx, hx * hy];
        let own = self.reached.spent[voxel];
        Vector3::from([0, 1, 2].map(|axis| {
            let (step, sign) = if to_burr[axis] >= 0.0 { (1, 1.0) } else { (-1, -1.0) };
            let before = self.beside(voxel, axis, step);
            let after = match (before, self.beside(voxel, axis, -step)) {
                // A shell of one voxel.
                (Beside::Open, Beside::Open) => 0.0,
                // The row goes on, or this is its end beyond the burr's middle.
                (_, Beside::Touched(_) | Beside::Open) => own,
                (_, Beside::Bone(cut)) => cut,
            };
            sign * faces_m2[axis] * (before.cut() - after).max(0.0)
        }))
    }

    fn beside(&self, voxel: usize, axis: usize, step: i64) -> Beside {
        let mut at = self.reached.at[voxel];
        at[axis] += step;
        if !self.edit.occupancy().is_solid_at(at) {
            return Beside::Open;
        }
        let inside = at.map(|x| x as usize);
        // The list is in grid order.
        match self.reached.index.binary_search(&self.edit.geometry().index(inside)) {
            Ok(other) if self.reached.depth[other] > 0.0 => Beside::Touched(self.reached.spent[other]),
            _ => Beside::Bone(self.edit.pool().spent_at(self.edit.pool().place(inside))),
        }
    }
}
