//! The bone field itself: construction, look-ups, reset and snapshots.

use super::BoneError;
use super::drilling::{CuttingLaw, DrillScratch};
use super::grid::GridGeometry;
use super::material::{CuttingTable, MaterialLaw};
use super::occupancy::Occupancy;
use super::query::ContactKind;
use super::reach::ReachedVoxels;
use super::remembered::Changes;
use super::removal::Removal;
use super::strength::SpentPool;
use super::tracked::Tracks;

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
    fn check_burr_radius(&self) -> Result<(), BoneError> {
        let value = self.max_burr_radius_m;
        if value.is_finite() && value > 0.0 {
            Ok(())
        } else {
            Err(BoneError::Parameter {
                name: "max_burr_radius_m",
                value,
                expected: "a finite number above 0",
            })
        }
    }
}

/// Bone of one CT: occupancy and strength that is left. See the [module](super).
#[derive(Debug, Clone)]
pub struct BoneField {
    pub(super) geometry: GridGeometry,
    pub(super) parameters: BoneParameters,
    pub(super) occupancy: Occupancy,
    pub(super) pool: SpentPool,
    pub(super) cutting_table: CuttingTable,
    pub(super) scratch: DrillScratch,
    /// What drilling remembers of the burr's surroundings; changes no result.
    pub(super) reached: ReachedVoxels,
    /// Voxels removed before the run, in no state of the run.
    pub(super) predrilled_count: u64,
    /// Voxels removed in this tick.
    pub(super) removed: Vec<u32>,
    /// Voxels spent but not yet removed, first in, first out.
    pub(super) waiting: Vec<u32>,
    pub(super) removed_total: u64,
    /// What contact queries remember; changes no result.
    pub(super) tracks: Tracks,
    /// Where drilling has changed bone of late.
    pub(super) changes: Changes,
    /// The machine's vector instructions.
    pub(super) arch: pulp::Arch,
}

/// What drilling has changed in a field: enough to continue bit for bit in a field of the same CT and scene.
#[derive(Debug, Clone, PartialEq)]
pub struct BoneSnapshot {
    pub(super) voxel_count: usize,
    pub(super) predrilled_count: u64,
    pub(super) blocks: Vec<u32>,
    pub(super) spent: Vec<f64>,
    pub(super) removed: Vec<u32>,
    pub(super) waiting: Vec<u32>,
    pub(super) removed_total: u64,
}

impl BoneField {
    /// Builds the field of `hu`, which has `geometry.voxel_count()` values, x fastest. All memory that drilling needs is
    /// reserved here.
    pub fn new(geometry: GridGeometry, hu: &[i16], parameters: BoneParameters) -> Result<Self, BoneError> {
        let geometry = geometry.validated()?;
        check_volume(&geometry, hu)?;
        parameters.cutting.check()?;
        let cutting_table = CuttingTable::new(&parameters.material, parameters.threshold_hu)?;
        parameters.check_burr_radius()?;
        if parameters.removed_per_tick == 0 {
            return Err(BoneError::Parameter {
                name: "removed_per_tick",
                value: 0.0,
                expected: "at least 1",
            });
        }
        let reached = ReachedVoxels::new(&geometry, parameters.max_burr_radius_m, &parameters.cutting);
        Ok(Self {
            geometry,
            parameters,
            occupancy: Occupancy::from_threshold(geometry.dims, hu, parameters.threshold_hu),
            pool: SpentPool::new(geometry.dims, parameters.pool_blocks),
            cutting_table,
            scratch: DrillScratch::new(reached.capacity()),
            waiting: Vec::with_capacity(reached.capacity()),
            reached,
            predrilled_count: 0,
            removed: Vec::with_capacity(parameters.removed_per_tick),
            removed_total: 0,
            tracks: Tracks::new(),
            changes: Changes::new(),
            arch: pulp::Arch::new(),
        })
    }

    /// The grid, its axes perpendicular.
    pub fn geometry(&self) -> &GridGeometry {
        &self.geometry
    }

    /// The parameters the field was built with.
    pub fn parameters(&self) -> &BoneParameters {
        &self.parameters
    }

    /// Whether voxel (i, j, k) is bone; outside the grid nothing is.
    pub fn is_solid(&self, i: usize, j: usize, k: usize) -> bool {
        self.occupancy.is_solid_at([i as i64, j as i64, k as i64])
    }

    /// Whether the voxel of this linear index is bone.
    pub fn is_solid_index(&self, index: usize) -> bool {
        let [i, j, k] = self.voxel_of_index(index);
        self.is_solid(i, j, k)
    }

    /// Voxels that are bone.
    pub fn solid_count(&self) -> usize {
        self.occupancy.solid_count()
    }

    /// Fraction of the voxel's strength that is left: 1 whole bone, 0 removed or no bone.
    pub fn remaining_strength(&self, i: usize, j: usize, k: usize) -> f64 {
        if self.is_solid(i, j, k) { self.strength_left(self.pool.spent(i, j, k)) } else { 0.0 }
    }

    /// Linear indices of the voxels that the last [`BoneField::grind`] removed, in no particular order.
    pub fn removed_this_tick(&self) -> &[u32] {
        &self.removed
    }

    /// Voxels removed by drilling since construction or reset.
    pub fn removed_total(&self) -> u64 {
        self.removed_total
    }

    /// Pool blocks in use and in all.
    pub fn pool_usage(&self) -> (usize, usize) {
        (self.pool.used(), self.pool.capacity())
    }

    /// Energy in J that drilling has put into bone so far (removed and partly cut voxels), summed afresh over the pool.
    /// What was shed as slivers ([`CuttingLaw::sliver_fraction`]) counts as absorbed.
    pub fn absorbed_energy_j(&self, hu: &[i16]) -> Result<f64, BoneError> {
        check_volume(&self.geometry, hu)?;
        let volume = self.geometry.voxel_volume_m3();
        Ok(self.touched().fold(0.0, |sum, (voxel, spent)| {
            let hu = hu[self.geometry.linear_index(voxel[0], voxel[1], voxel[2])];
            sum + spent * volume * self.cutting_table.specific_energy_j_m3(hu)
        }))
    }

    /// Every voxel that absorbed energy, with its spent fraction, in a fixed order.
    fn touched(&self) -> impl Iterator<Item = ([usize; 3], f64)> + '_ {
        let (_, spent) = self.pool.contents();
        spent.iter().enumerate().filter(|(_, s)| **s > 0.0).filter_map(|(place, s)| {
            let (slot, offset) =
                (place / super::strength::BLOCK_VOXELS, place % super::strength::BLOCK_VOXELS);
            self.pool.voxel_of(slot, offset).map(|voxel| (voxel, *s))
        })
    }

    /// Undoes all drilling: voxels and their strength, back to the start of the run. Pilot holes
    /// ([`BoneField::predrill_capsule`]) stay.
    pub fn reset(&mut self) {
        for slot in 0..self.pool.used() {
            for offset in 0..super::strength::BLOCK_VOXELS {
                if let Some([i, j, k]) = self.pool.voxel_of(slot, offset)
                    && self.pool.spent(i, j, k) > 0.0
                {
                    // Only bone absorbs energy, so whatever did was bone.
                    self.occupancy.set(i, j, k, true);
                }
            }
        }
        self.forget_searches();
        self.pool.clear();
        self.removed.clear();
        self.waiting.clear();
        self.removed_total = 0;
    }

    /// What drilling has changed so far. Allocates; not for the 1 kHz step.
    pub fn snapshot(&self) -> BoneSnapshot {
        let (blocks, spent) = self.pool.contents();
        BoneSnapshot {
            voxel_count: self.geometry.voxel_count(),
            predrilled_count: self.predrilled_count,
            blocks: blocks.to_vec(),
            spent: spent.to_vec(),
            removed: self.removed.clone(),
            waiting: self.waiting.clone(),
            removed_total: self.removed_total,
        }
    }

    /// Goes back, or forward, to a snapshot of a field of the same CT, parameters and pilot holes; continues bit for bit.
    pub fn restore(&mut self, snapshot: &BoneSnapshot) -> Result<(), BoneError> {
        if snapshot.voxel_count != self.geometry.voxel_count() {
            return Err(BoneError::Snapshot { reason: "it has another number of voxels" });
        }
        if snapshot.predrilled_count != self.predrilled_count {
            return Err(BoneError::Snapshot { reason: "it has other pilot holes" });
        }
        if snapshot.removed.len() > self.removed.capacity()
            || snapshot.waiting.len() > self.waiting.capacity()
        {
            return Err(BoneError::Snapshot { reason: "its removed voxels exceed this field's capacity" });
        }
        self.reset();
        if !self.pool.load(&snapshot.blocks, &snapshot.spent) {
            return Err(BoneError::Snapshot { reason: "its partly cut blocks exceed this field's pool" });
        }
        self.removed.extend_from_slice(&snapshot.removed);
        self.waiting.extend_from_slice(&snapshot.waiting);
        self.removed_total = snapshot.removed_total;
        for slot in 0..self.pool.used() {
            for offset in 0..super::strength::BLOCK_VOXELS {
                if let Some([i, j, k]) = self.pool.voxel_of(slot, offset)
                    && self.pool.spent(i, j, k) >= 1.0
                {
                    self.occupancy.set(i, j, k, false);
                }
            }
        }
        for place in 0..self.waiting.len() {
            let [i, j, k] = self.voxel_of_index(self.waiting[place] as usize);
            self.occupancy.set(i, j, k, true);
        }
        Ok(())
    }

    /// Goes on without vector instructions: slower, and the same bits.
    pub fn use_plain_instructions(&mut self) {
        self.arch = pulp::Arch::Scalar;
    }

    /// For any change of the bone but drilling.
    pub(super) fn forget_searches(&mut self) {
        self.tracks.forget_all();
        self.changes.forget_all();
        self.reached.forget();
    }

    pub(super) fn voxel_of_index(&self, index: usize) -> [usize; 3] {
        let [nx, ny, _] = self.geometry.dims;
        [index % nx, (index / nx) % ny, index / (nx * ny)]
    }
}

/// Refuses a CT that is not the grid's.
pub(super) fn check_volume(geometry: &GridGeometry, hu: &[i16]) -> Result<(), BoneError> {
    if hu.len() == geometry.voxel_count() {
        Ok(())
    } else {
        Err(BoneError::VolumeSize { given: hu.len(), expected: geometry.voxel_count() })
    }
}
