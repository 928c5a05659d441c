//! What a scene says about its bone.

use super::BoneError;
use super::drilling::CuttingLaw;
use super::material::MaterialLaw;
use super::query::ContactKind;
use super::removal::Removal;

/// What a scene says about its bone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoneParameters {
    /// A voxel of at least this value is bone.
    pub threshold_hu: i16,
    /// Density and specific cutting energy.
    pub material: MaterialLaw,
    /// How a burr turns force and speed into cutting energy.
    pub cutting: CuttingLaw,
    /// What a voxel is to a sphere: a part of a smoothed surface unless an experiment asks for the baseline.
    pub contact: ContactKind,
    /// How voxels end: by energy unless an experiment asks for a baseline.
    pub removal: Removal,
    /// Blocks of 8 x 8 x 8 voxels (4 KiB each) that may hold partly cut voxels. When all are taken, voxels in further blocks
    /// cannot be cut; each tick's report counts them.
    pub pool_blocks: usize,
    /// Voxels that can be removed in one tick; what exceeds it waits for the next tick.
    pub removed_per_tick: usize,
    /// Largest burr radius in metres; it sizes the drilling scratch.
    pub max_burr_radius_m: f64,
}

impl Default for BoneParameters {
    fn default() -> Self {
        Self {
            threshold_hu: 150,
            material: MaterialLaw::default(),
            cutting: CuttingLaw::default(),
            contact: ContactKind::Planes,
            removal: Removal::Energy,
            pool_blocks: 4096,
            removed_per_tick: 4096,
            max_burr_radius_m: 4.0e-3,
        }
    }
}

impl BoneParameters {
    /// Whatever the cutting table does not check: that needs the material.
    pub(super) fn check(&self) -> Result<(), BoneError> {
        let value = self.max_burr_radius_m;
        if !(value.is_finite() && value > 0.0) {
            return Err(BoneError::Parameter {
                name: "max_burr_radius_m",
                value,
                expected: "a finite number above 0",
            });
        }
        if self.removed_per_tick == 0 {
            return Err(BoneError::Parameter {
                name: "removed_per_tick",
                value: 0.0,
                expected: "at least 1",
            });
        }
        Ok(())
    }
}
