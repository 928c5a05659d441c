//! Force below which the burr's edges plough without cutting, from the edge pressure times the area that the
//! burr touches.
//!
//! **Area.** A burr that fills its hole touches the hole's cross-section, regardless of voxel size. One
//! surface runs through a row of voxels, located where the cut fraction drops from 1 in the open to 0 in
//! whole bone: a voxel's area is the face's area times the drop of the cut fraction from the voxel in front
//! of it, toward the burr, to the one behind. In a row at the hole's rim, the wall that the burr has passed
//! keeps a part of each voxel, and the burr touches the other part. Treating a voxel behind partly cut bone
//! as covered would omit the rim: for a 6.5 mm burr, a tenth of the cross-section in 0.25 mm voxels and a
//! third in 1 mm voxels.
//!
//! **Projection.** A normal sees the part of the patch that faces it: the voxels from which the burr's centre
//! is on the normal's side. Their areas add up as vectors, so the steps of the voxel grid cancel. For a burr
//! in its hole and a normal at an angle t to the feed, this is (1 + cos t) / 2 of the cross-section, the half
//! of a ball as seen from that side.
//!
//! **Contacts on different sides.** A contact alone needs the force of its part of the patch, and loads that
//! part evenly. A voxel bears the sum of the loads of all contacts that see it, as shares of the edge
//! pressure; cutting begins where their mean over the patch, as the contacts see it, is 1. Contacts on one
//! side thus share one threshold, and the thresholds of contacts that see different bone, around a hole that
//! is widened or on both sides of a pinched burr, add up.

use nalgebra::Vector3;

use super::cutting::BurrContact;
use super::drilling::DrillTick;
use super::reach::BurrPress;

impl DrillTick<'_> {
    /// Returns the force on the burr below which nothing is cut, N: see the module. Without contacts the
    /// burr's direction is unknown, and each voxel counts with its whole area toward the burr.
    pub(super) fn edge_force_n(&mut self, hu: &[i16], press: &BurrPress, contacts: &[BurrContact]) -> f64 {
        let mut alone_n = core::mem::take(&mut self.scratch.edge_n);
        alone_n.clear();
        alone_n.resize(contacts.len(), 0.0);
        let (mut whole_n, to_world) = (0.0, self.edit.geometry().direction_world_grid);
        self.for_each_edge(hu, press, |to_burr, edge_n| {
            if contacts.is_empty() {
                whole_n += to_world.tr_mul(edge_n).abs().sum();
            }
            for (alone_n, contact) in alone_n.iter_mut().zip(contacts) {
                if contact.normal.dot(to_burr) > 0.0 {
                    *alone_n += contact.normal.dot(edge_n);
                }
            }
        });
        // A contact that faces no edge cuts with any force, and loads no voxel.
        let loads = || contacts.iter().zip(&alone_n).filter(|(_, alone_n)| **alone_n > 0.0);
        let force_n: f64 = loads().map(|(contact, _)| contact.normal_force_n).sum();
        let (mut share, mut seen_n2) = (0.0, 0.0);
        self.for_each_edge(hu, press, |to_burr, edge_n| {
            let (mut of_voxel, mut weight_n2) = (0.0, 0.0);
            for (contact, alone_n) in loads().filter(|(contact, _)| contact.normal.dot(to_burr) > 0.0) {
                of_voxel += contact.normal_force_n / alone_n;
                weight_n2 += contact.normal_force_n * contact.normal.dot(edge_n);
            }
            if weight_n2 > 0.0 {
                share += of_voxel * weight_n2;
                seen_n2 += weight_n2;
            }
        });
        self.scratch.edge_n = alone_n;
        match (contacts.is_empty(), share > 0.0) {
            (true, _) => whole_n,
            (false, true) => force_n * seen_n2 / share,
            // Nothing is visible of a patch that faces away from its contacts.
            (false, false) => 0.0,
        }
    }

    /// Calls `each` with the direction from a touched voxel to the burr and the voxel's edge pressure times
    /// area, N, a vector that points out of the bone; both in the world.
    fn for_each_edge(
        &self,
        hu: &[i16],
        press: &BurrPress,
        mut each: impl FnMut(&Vector3<f64>, &Vector3<f64>),
    ) {
        let to_world = self.edit.geometry().direction_world_grid;
        for voxel in (0..self.reached.index.len()).filter(|voxel| self.reached.depth[*voxel] > 0.0) {
            let to_burr = self.reached.offset(voxel, &self.reached.ball_in(voxel, press).centre);
            let area_m2 = to_world * self.facing_m2(voxel, &to_burr);
            let pressure_pa = self.edit.material().edge_pressure_pa(hu[self.reached.index[voxel].at()]);
            each(&(to_world * to_burr), &(area_m2 * pressure_pa));
        }
    }

    /// Returns the area of a touched voxel's surface in m^2, as a vector in the grid's frame that points out
    /// of the bone; `to_burr` points from the voxel to the burr.
    fn facing_m2(&self, voxel: usize, to_burr: &Vector3<f64>) -> Vector3<f64> {
        let [hx, hy, hz] = self.edit.geometry().spacing_m;
        let faces_m2 = [hy * hz, hz * hx, hx * hy];
        let own = self.reached.spent[voxel];
        Vector3::from([0, 1, 2].map(|axis| {
            let (step, sign) = if to_burr[axis] >= 0.0 { (1, 1.0) } else { (-1, -1.0) };
            let beside = |step: i64| {
                let mut at = self.reached.at[voxel];
                at[axis] += step;
                at
            };
            let (before, behind) = (self.cut_at(beside(step)), self.cut_at(beside(-step)));
            let after = match (before, behind) {
                // A shell of one voxel.
                (None, None) => 0.0,
                (_, Some(cut)) if !self.touches(beside(-step)) => cut,
                // The row continues, or this is its end beyond the burr's middle.
                _ => own,
            };
            sign * faces_m2[axis] * (before.unwrap_or(1.0) - after).max(0.0)
        }))
    }

    /// Returns the cut fraction of a voxel; `None` if there is no bone.
    fn cut_at(&self, at: [i64; 3]) -> Option<f64> {
        let [i, j, k] = at.map(|x| x as usize);
        self.edit.occupancy().is_solid_at(at).then(|| self.edit.pool().spent(i, j, k))
    }

    /// Returns whether the burr touches a voxel of the grid.
    fn touches(&self, at: [i64; 3]) -> bool {
        let index = self.edit.geometry().index(at.map(|x| x as usize));
        // The list is in grid order.
        self.reached.index.binary_search(&index).is_ok_and(|other| self.reached.depth[other] > 0.0)
    }
}
