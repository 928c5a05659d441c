//! The voxels together with their caches.

use nalgebra::Vector3;
use pulp::Arch;

use super::BoneError;
use super::cutting::{BurrState, TickLoads};
use super::drilling::{DrillCache, GrindReport};
use super::grid::{GridGeometry, VoxelIndex};
use super::parameters::BoneParameters;
use super::query::ContactBuffer;
use super::tracked::ContactCache;
use super::voxels::{BoneSnapshot, Voxels};
use super::yielding::{BoneVoxel, FIRST_NEAR, FindStrengths, MOST_PLANES, Pressing};

/// The bone of one CT, for contact queries and drilling: the [`Voxels`] and one cache for each of the two.
///
/// The caches are built from the voxels alone and check the voxels' journal before use. They affect only the
/// speed of a query, never its result.
#[derive(Debug)]
pub struct BoneField {
    voxels: Voxels,
    contact_cache: ContactCache,
    drill_cache: DrillCache,
    /// Working memory of [`Self::strengths_n`].
    near: Vec<BoneVoxel>,
    /// SIMD support of this CPU.
    arch: Arch,
}

impl BoneField {
    /// Builds the field from `hu`, which has `geometry.voxel_count()` values, x fastest. Reserves the memory
    /// that drilling initially needs.
    ///
    /// # Errors
    /// An invalid grid, a CT of the wrong size, or a parameter out of range.
    pub fn new(geometry: GridGeometry, hu: &[i16], parameters: BoneParameters) -> Result<Self, BoneError> {
        let voxels = Voxels::new(geometry, hu, parameters)?;
        let (contact_cache, drill_cache) = (ContactCache::new(&voxels), DrillCache::new(&voxels));
        let near = Vec::with_capacity(FIRST_NEAR);
        Ok(Self { voxels, contact_cache, drill_cache, near, arch: Arch::new() })
    }

    /// Returns the current bone.
    pub fn voxels(&self) -> &Voxels {
        &self.voxels
    }

    /// Replaces both caches by empty ones. Results do not change (tested).
    pub fn rebuild_caches(&mut self) {
        self.contact_cache = ContactCache::new(&self.voxels);
        self.drill_cache = DrillCache::new(&self.voxels);
    }

    /// Disables vector instructions: slower, with the same bits.
    pub fn use_plain_instructions(&mut self) {
        self.arch = Arch::Scalar;
    }

    /// Appends the planes of [`Voxels::contact_planes`], bit for bit, but much faster for a sphere (by index)
    /// that has moved little since its last query.
    pub fn contact_planes_tracked(
        &mut self,
        sphere_index: usize,
        centre_world_m: &Vector3<f64>,
        radius_m: f64,
        margin_m: f64,
        out: &mut ContactBuffer,
    ) {
        if let Some(sphere) = self.voxels.sphere(sphere_index, centre_world_m, radius_m, margin_m) {
            self.contact_cache.planes(&self.voxels, self.arch, &sphere, out);
        }
    }

    /// Returns the strength of each of a sphere's contacts, N (see [`super::yielding`]). `hu` is the CT that
    /// the field was built from.
    pub fn strengths_n(&mut self, hu: &[i16], pressing: &Pressing) -> [f64; MOST_PLANES] {
        let Self { voxels, near, .. } = self;
        self.arch.dispatch(FindStrengths { voxels, hu, pressing, near })
    }

    /// Returns the number of voxels that the last [`Self::strengths_n`] listed around the sphere.
    pub(crate) fn listed(&self) -> usize {
        self.near.len()
    }

    /// Drills for one tick of `dt_s` with the burr's end. `hu` is the CT that the field was built from.
    /// [`Voxels::removed_this_tick`] then lists the removed voxels.
    ///
    /// # Errors
    /// A CT of the wrong size, or a burr that is not finite or too large; nothing has changed then.
    pub fn grind(&mut self, hu: &[i16], burr: &BurrState, dt_s: f64) -> Result<GrindReport, BoneError> {
        self.wear(hu, TickLoads { burr, behind: &[], contacts: &[], indentations: &[] }, dt_s)
    }

    /// Drills and crushes for one tick: [`Self::grind`] after the bone under each indentation has receded
    /// (see [`super::yielding`]).
    ///
    /// # Errors
    /// Same as [`Self::grind`].
    pub fn wear(&mut self, hu: &[i16], work: TickLoads, dt_s: f64) -> Result<GrindReport, BoneError> {
        self.drill_cache.wear(&mut self.voxels, self.arch, hu, work, dt_s)
    }

    /// Reserves memory for the partly cut voxels of the next tick; when called between ticks, the tick does
    /// not allocate. Results do not change. Returns false if memory runs out: voxels without memory are not
    /// cut, and the tick's report counts them.
    pub fn make_room(&mut self) -> bool {
        self.voxels.make_room()
    }

    /// Removes the bone whose voxel centres lie within `radius_m` of the segment `from`-`to` (world, metres)
    /// and returns the voxel numbers in ascending order. These voxels are part of the scene: a reset does not
    /// restore them. Use before the run; allocates. Removes nothing for non-finite values or a radius that is
    /// not positive.
    pub fn predrill_capsule(
        &mut self,
        from_world_m: &Vector3<f64>,
        to_world_m: &Vector3<f64>,
        radius_m: f64,
    ) -> Vec<VoxelIndex> {
        self.voxels.predrill_capsule(from_world_m, to_world_m, radius_m)
    }

    /// Returns the number of ticks so far that have changed a voxel, and of restored states.
    pub fn changes(&self) -> u64 {
        self.voxels.journal().regions()
    }

    /// Undoes all drilling: voxels and their strength, back to the start of the run. Pilot holes
    /// ([`Self::predrill_capsule`]) stay.
    pub fn reset(&mut self) {
        self.voxels.reset();
    }

    /// Restores a snapshot, earlier or later, of a field with the same CT, parameters and pilot holes;
    /// continues bit for bit.
    ///
    /// # Errors
    /// The snapshot is from another field.
    pub fn restore(&mut self, snapshot: &BoneSnapshot) -> Result<(), BoneError> {
        self.voxels.restore(snapshot)
    }
}
