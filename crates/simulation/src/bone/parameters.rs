//! Parameters of the bone model.

use super::BoneError;
use super::cutting::CuttingLaw;
use super::material::MaterialLaw;
use super::query::ContactKind;
use super::removal::Removal;

/// A scene's bone parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoneParameters {
    /// A voxel of at least this value is bone.
    pub threshold_hu: i16,
    /// Density and specific cutting energy.
    pub material: MaterialLaw,
    /// Law by which a burr converts force and speed to cutting energy.
    pub cutting: CuttingLaw,
    /// Contact model of a voxel: part of a smoothed surface, unless an experiment selects the baseline.
    pub contact: ContactKind,
    /// Rule for removing voxels: by energy, unless an experiment selects a baseline.
    pub removal: Removal,
    /// Maximum number of blocks of 8 x 8 x 8 voxels (4 KiB each) for partly cut voxels; by default those of
    /// the grid. Once all are in use, voxels in further blocks cannot be cut; each tick's report counts them.
    pub pool_blocks: usize,
    /// Maximum voxels removed per tick, unlimited by default; the excess waits for the next tick.
    pub removed_per_tick: usize,
    /// Largest burr radius in metres; it determines the size of the drilling scratch memory.
    pub max_burr_radius_m: f64,
    /// Largest distance between the centres of a cutter's first and last ball in metres; also affects the
    /// size of the scratch memory. 0 if the burr is a ball.
    pub cutter_span_m: f64,
}

impl Default for BoneParameters {
    fn default() -> Self {
        Self {
            threshold_hu: 150,
            material: MaterialLaw::default(),
            cutting: CuttingLaw::default(),
            contact: ContactKind::Planes,
            removal: Removal::Energy,
            pool_blocks: usize::MAX,
            removed_per_tick: usize::MAX,
            max_burr_radius_m: 4.0e-3,
            cutter_span_m: 0.0,
        }
    }
}

impl BoneParameters {
    /// Checks everything that does not need the material; the cutting table checks the rest.
    pub(super) fn check(&self) -> Result<(), BoneError> {
        let value = self.max_burr_radius_m;
        if !(value.is_finite() && value > 0.0) {
            return Err(BoneError::Parameter {
                name: "max_burr_radius_m",
                value,
                expected: "a finite number above 0",
            });
        }
        let value = self.cutter_span_m;
        if !(value.is_finite() && value >= 0.0) {
            return Err(BoneError::Parameter {
                name: "cutter_span_m",
                value,
                expected: "a finite number of at least 0",
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
