//! The voxels themselves: all bone state that affects results or belongs in a keyframe.
//!
//! Voxels change only through the functions in `edit.rs`, which record every change in the journal. The
//! caches ([`super::tracked`], [`super::reach`]) only read the voxels and the journal.

mod edit;
mod journal;
mod predrill;
mod saved;

use super::BoneError;
use super::drilling::GONE;
use super::grid::{GridGeometry, VoxelIndex};
use super::material::MaterialTable;
use super::occupancy::Occupancy;
use super::parameters::BoneParameters;
use super::reach;
use super::strength::{BLOCK_EDGE, ChangedBlock, SpentPool};

pub(super) use edit::Drilling;
pub(super) use journal::Journal;

/// The bone of one CT: which voxels are bone, and how much of each remains.
#[derive(Debug)]
pub struct Voxels {
    geometry: GridGeometry,
    parameters: BoneParameters,
    material: MaterialTable,
    /// Bone of which anything is left.
    occupancy: Occupancy,
    /// Bone of which nothing is spent.
    whole: Occupancy,
    pool: SpentPool,
    /// Voxels as left by the pilot holes: the fractions that a reset restores.
    pilot: SpentPool,
    /// Voxels that pilot holes have cut, wholly or partly; a reset does not restore them.
    pilot_count: u64,
    /// Volume that pilot holes have removed, in voxels.
    pilot_voxels: f64,
    /// Voxels that became gone in this tick, and those that became fully spent.
    removed: Vec<VoxelIndex>,
    emptied: Vec<VoxelIndex>,
    /// Voxels that are gone but not yet listed as removed, in FIFO order; at most `waiting_limit`.
    waiting: Vec<VoxelIndex>,
    waiting_limit: usize,
    removed_total: u64,
    journal: Journal,
}

/// The changes that drilling made to a field, sufficient to continue bit for bit in a field with the same CT
/// and scene.
#[derive(Debug, Clone, PartialEq)]
pub struct BoneSnapshot {
    voxel_count: usize,
    pilot_count: u64,
    /// Fractions that differ from those of the start.
    blocks: Vec<ChangedBlock>,
    removed: Vec<VoxelIndex>,
    waiting: Vec<VoxelIndex>,
    removed_total: u64,
}

impl Voxels {
    pub(super) fn new(
        geometry: GridGeometry,
        hu: &[i16],
        parameters: BoneParameters,
    ) -> Result<Self, BoneError> {
        let geometry = geometry.validated()?;
        check_volume(&geometry, hu)?;
        parameters.cutting.check()?;
        let material = MaterialTable::new(&parameters.material, parameters.threshold_hu)?;
        parameters.check()?;
        let waiting_limit = reach::most_voxels(&geometry, &parameters);
        let blocks_per_tick = reach::most_blocks(&geometry, &parameters, BLOCK_EDGE);
        let occupancy = Occupancy::from_threshold(geometry.dims, hu, parameters.threshold_hu);
        Ok(Self {
            geometry,
            parameters,
            material,
            whole: occupancy.clone(),
            occupancy,
            pool: SpentPool::new(geometry.dims, parameters.pool_blocks, blocks_per_tick)?,
            pilot: SpentPool::empty(geometry.dims, parameters.pool_blocks),
            pilot_count: 0,
            pilot_voxels: 0.0,
            removed: Vec::with_capacity(parameters.removed_per_tick.min(waiting_limit)),
            emptied: Vec::with_capacity(waiting_limit),
            waiting: Vec::with_capacity(waiting_limit),
            waiting_limit,
            removed_total: 0,
            journal: Journal::new(),
        })
    }

    /// Returns the grid, with perpendicular axes.
    #[inline]
    pub fn geometry(&self) -> &GridGeometry {
        &self.geometry
    }

    /// Returns the parameters the field was built with.
    #[inline]
    pub fn parameters(&self) -> &BoneParameters {
        &self.parameters
    }

    #[inline]
    pub(super) fn occupancy(&self) -> &Occupancy {
        &self.occupancy
    }

    /// Bone of which nothing is spent.
    #[inline]
    pub(super) fn whole(&self) -> &Occupancy {
        &self.whole
    }

    #[inline]
    pub(super) fn pool(&self) -> &SpentPool {
        &self.pool
    }

    #[inline]
    pub(super) fn journal(&self) -> &Journal {
        &self.journal
    }

    /// Returns true if voxel (i, j, k) is bone in an image: at least half of it is left. False outside the
    /// grid.
    pub fn is_solid(&self, i: usize, j: usize, k: usize) -> bool {
        self.is_mostly_solid([i as i64, j as i64, k as i64])
    }

    /// Returns true if the voxel is bone in an image, or not yet listed as removed. Searches the waiting
    /// voxels.
    pub fn is_listed_solid(&self, voxel: VoxelIndex) -> bool {
        self.is_solid_index(voxel) || self.waiting.contains(&voxel)
    }

    /// Returns [`Self::is_solid`] for the voxel with this index.
    pub fn is_solid_index(&self, voxel: VoxelIndex) -> bool {
        let [i, j, k] = self.geometry.voxel(voxel);
        self.is_solid(i, j, k)
    }

    /// Returns true if a voxel is bone and at least half of it remains.
    #[inline]
    pub(super) fn is_mostly_solid(&self, voxel: [i64; 3]) -> bool {
        self.occupancy.is_solid_at(voxel)
            && self.pool.spent(voxel[0] as usize, voxel[1] as usize, voxel[2] as usize) <= GONE
    }

    /// Returns the number of voxels of which any bone is left.
    pub fn solid_count(&self) -> usize {
        self.occupancy.solid_count()
    }

    /// Returns the fraction of the voxel's strength that remains: 1 for whole bone, 0 for removed or no bone.
    pub fn remaining_strength(&self, i: usize, j: usize, k: usize) -> f64 {
        if self.occupancy.is_solid_at([i as i64, j as i64, k as i64]) {
            self.parameters.removal.strength_left(self.pool.spent(i, j, k))
        } else {
            0.0
        }
    }

    /// Returns the voxels that are gone since the last tick of drilling: less than half of each is left. The
    /// order is unspecified.
    pub fn removed_this_tick(&self) -> &[VoxelIndex] {
        &self.removed
    }

    /// Returns the voxels that became fully spent in the last tick.
    pub(super) fn emptied_this_tick(&self) -> &[VoxelIndex] {
        &self.emptied
    }

    /// Returns the number of voxels that are gone and wait for the list of removed ones.
    pub(super) fn waiting_count(&self) -> usize {
        self.waiting.len()
    }

    /// Returns the number of voxels listed as removed since construction or reset.
    pub fn removed_total(&self) -> u64 {
        self.removed_total
    }

    /// Returns the number of blocks of partly cut voxels in use, and the maximum.
    pub fn pool_usage(&self) -> (usize, usize) {
        (self.pool.used(), self.pool.capacity())
    }

    /// Returns the memory used by partly cut voxels, bytes.
    pub fn pool_bytes(&self) -> usize {
        self.pool.bytes()
    }

    /// Returns the energy in J to cut a whole voxel of the CT.
    #[inline]
    pub(super) fn full_energy_j(&self, hu: i16) -> f64 {
        self.material.specific_energy_j_m3(hu) * self.geometry.voxel_volume_m3()
    }

    #[inline]
    pub(super) fn material(&self) -> &MaterialTable {
        &self.material
    }

    /// Returns the volume in m³ that drilling has removed so far, of whole and of partly cut voxels,
    /// recomputed from the pool.
    pub fn removed_m3(&self) -> f64 {
        let mut sum = 0.0;
        self.pool.for_each(|[i, j, k], spent| sum += spent - self.pilot.spent(i, j, k));
        sum * self.geometry.voxel_volume_m3()
    }

    /// Returns the volume in m³ that pilot holes have removed.
    pub fn pilot_m3(&self) -> f64 {
        self.pilot_voxels * self.geometry.voxel_volume_m3()
    }

    /// Returns the energy in J that bone has absorbed from drilling so far (removed and partly cut voxels),
    /// recomputed from the pool.
    ///
    /// # Errors
    /// `hu` does not have one value per voxel.
    pub fn absorbed_energy_j(&self, hu: &[i16]) -> Result<f64, BoneError> {
        check_volume(&self.geometry, hu)?;
        let volume = self.geometry.voxel_volume_m3();
        let mut sum_j = 0.0;
        self.pool.for_each(|[i, j, k], spent| {
            if spent > 0.0 {
                let hu = hu[self.geometry.linear_index(i, j, k)];
                let spent = spent - self.pilot.spent(i, j, k);
                sum_j += spent * volume * self.material.specific_energy_j_m3(hu);
            }
        });
        Ok(sum_j)
    }

    /// Returns the changes made by drilling so far. Allocates; not for the real-time loop.
    pub fn snapshot(&self) -> BoneSnapshot {
        BoneSnapshot {
            voxel_count: self.geometry.voxel_count(),
            pilot_count: self.pilot_count,
            blocks: self.pool.changes(&self.pilot).map(|change| change.to_owned()).collect(),
            removed: self.removed.clone(),
            waiting: self.waiting.clone(),
            removed_total: self.removed_total,
        }
    }
}

/// Rejects a CT whose size does not match the grid.
pub(super) fn check_volume(geometry: &GridGeometry, hu: &[i16]) -> Result<(), BoneError> {
    if hu.len() == geometry.voxel_count() {
        Ok(())
    } else {
        Err(BoneError::VolumeSize { given: hu.len(), expected: geometry.voxel_count() })
    }
}
