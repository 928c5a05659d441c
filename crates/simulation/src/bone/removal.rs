//! Rules for removing voxels: by the absorbed cutting energy, or by one of three published baseline rules,
//! for comparison.
//!
//! The baselines act on the voxels that the energy rule would cut: those within the burr's reach while it
//! turns and presses. The baselines ignore force, energy and tick length, so their result depends on voxel
//! size and dt.

use super::drilling::DrillTick;
use super::grid::VoxelIndex;

/// A removal rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Removal {
    /// Cutting energy, shared by pressure and area: see [`super::drilling`].
    #[default]
    Energy,
    /// Removes every touched voxel in the same tick.
    Naive,
    /// At most [`CAP_PER_TICK`] voxels per tick at [`RULE_SPEED_RAD_S`], in proportion to the burr's speed,
    /// deepest first. The cap follows Munawar et al. 2022 (volumetric drilling): 1, 3, 6, 10 for burrs of 1,
    /// 2, 4, 6 mm.
    Capped,
    /// Phalen et al. 2023: each voxel has a strength proportional to its density. Each tick of contact
    /// subtracts an amount proportional to the burr's speed; a voxel collides as a whole until its strength
    /// is used up.
    Decrement,
}

/// Voxels removed per tick by [`Removal::Capped`], for a 6 mm burr.
pub const CAP_PER_TICK: f64 = 10.0;
/// Ticks of contact that a voxel of the material law's reference density survives under
/// [`Removal::Decrement`]: the published 1/150 per step.
pub const DECREMENT_TICKS: f64 = 150.0;
/// Burr speed for the two values above: 2250 rpm.
pub const RULE_SPEED_RAD_S: f64 = 235.619_449_019_234_5;

/// Scale of the dose in the pool of spent fractions. Contact interprets the pool as a receded surface; with
/// this scale, a voxel recedes by less than a nanometre before it is removed.
const DOSE_SCALE: f64 = 1.0 / (1u64 << 30) as f64;

impl Removal {
    /// Returns the remaining fraction of a voxel's strength, from its entry in the pool.
    pub(super) fn strength_left(self, spent: f64) -> f64 {
        let dose = self == Removal::Decrement && spent < 1.0;
        if dose { (1.0 - spent / DOSE_SCALE).max(0.0) } else { 1.0 - spent }
    }
}

impl DrillTick<'_> {
    /// Removes or weakens the voxels in reach that the burr touches; all of them have a place in the pool.
    pub(super) fn remove_by_rule(&mut self, rule: Removal, hu: &[i16], speed_rad_s: f64) {
        let speed = speed_rad_s / RULE_SPEED_RAD_S;
        self.scratch.kept.clear();
        let touched = self.reached.depth.iter().enumerate().filter(|(_, depth)| **depth > 0.0);
        self.scratch.kept.extend(touched.map(|(voxel, _)| voxel as u32));
        match rule {
            Removal::Energy => {}
            Removal::Naive => self.end_first(usize::MAX),
            Removal::Capped => {
                // Break ties in depth in an order that follows no axis: grid order would push the burr
                // sideways.
                let mixed = |index: VoxelIndex| {
                    let number = index.number();
                    number.wrapping_mul(0x9e37_79b1).rotate_left(15).wrapping_mul(0x85eb_ca6b)
                };
                let (depth, index) = (&self.reached.depth, &self.reached.index);
                self.scratch.kept.sort_unstable_by(|a, b| {
                    let [a, b] = [*a, *b].map(|voxel| voxel as usize);
                    depth[b].total_cmp(&depth[a]).then(mixed(index[a]).cmp(&mixed(index[b])))
                });
                self.end_first((CAP_PER_TICK * speed + 0.5) as usize);
            }
            Removal::Decrement => self.weaken(hu, speed),
        }
    }

    /// Removes the first `count` of the listed voxels.
    fn end_first(&mut self, count: usize) {
        for place in 0..self.scratch.kept.len().min(count) {
            let voxel = self.scratch.kept[place] as usize;
            if !self.edit.has_room() {
                return;
            }
            self.set_spent(voxel, 1.0);
            self.report.cut_count += 1;
        }
    }

    /// Applies one tick's dose to each listed voxel.
    fn weaken(&mut self, hu: &[i16], speed: f64) {
        let law = self.edit.parameters().material;
        for place in 0..self.scratch.kept.len() {
            let voxel = self.scratch.kept[place] as usize;
            let index = self.reached.index[voxel];
            let strength = law.density_kg_m3(hu[index.at()]) / law.density_ref_kg_m3;
            let dose = self.reached.spent[voxel] + DOSE_SCALE * speed / (DECREMENT_TICKS * strength);
            // The tolerance covers the rounding of a sum of equal doses.
            let ended = dose >= DOSE_SCALE * (1.0 - 1e-9) && self.edit.has_room();
            self.set_spent(voxel, if ended { 1.0 } else { dose });
            self.report.cut_count += 1;
        }
    }
}
