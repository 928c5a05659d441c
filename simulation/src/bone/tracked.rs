//! The contact cache: makes queries fast for spheres that move little between ticks.
//!
//! Which voxels can be nearest to a sphere depends only on the bone around it and on the voxel that contains its centre. So the
//! cache stores for each sphere the voxels that [`Voxels::gather`] finds within a reach that is a little wider
//! ([`SLACK_VOXELS`]). As long as the centre stays in its voxel and the query's reach about it lies within the remembered one,
//! and no voxel within it is removed, the remembered voxels contain all that count, in the order of a fresh search; their
//! distances are always computed afresh. The planes are those of [`Voxels::contact_planes`] bit for bit, so what is
//! remembered is no part of the state.

use pulp::Arch;

use super::gather::{Sphere, outside, widening};
use super::near::NearVoxels;
use super::occupancy::VoxelBox;
use super::query::ContactBuffer;
use super::remembered::RememberedCells;
use super::voxels::Voxels;

/// Spheres with a memory; those of a higher index are searched afresh.
const TRACKED_SPHERES: usize = 64;

const _: () = assert!(
    TRACKED_SPHERES >= crate::manipulator::MAX_SPHERES,
    "every sphere of the planar tool has a track"
);

/// How much wider the remembered reach is, in voxels of the smallest spacing. A tool fed at 1.5 mm/s in voxels of 0.5 mm is
/// searched every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;

/// What is remembered for one sphere.
#[derive(Debug, Clone)]
struct Track {
    /// The sphere of the search; its reach is the widened one. `None`: nothing is remembered.
    sphere: Option<Sphere>,
    /// The voxels looked at.
    box_searched: VoxelBox,
    near: NearVoxels,
    /// The smoothed surface where the nearest voxels are.
    cells: RememberedCells,
}

impl Track {
    fn holds(&self, sphere: &Sphere) -> bool {
        let Some(searched) = &self.sphere else { return false };
        let room = searched.reach - sphere.reach;
        searched.voxel == sphere.voxel
            && room >= 0.0
            && (sphere.centre - searched.centre).norm_squared() <= room * room
    }

    /// For a voxel that is removed. It uncovers only voxels that are no nearer to a sphere than itself, so a sphere that does
    /// not reach it sees no change.
    fn forget_near(&mut self, position: [f64; 3], spacing: [f64; 3]) {
        let reached = self.sphere.is_some_and(|sphere| {
            let to_box = [0, 1, 2].map(|a| outside(sphere.centre[a] - position[a], spacing[a]));
            let distance2 = to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2];
            // Twice what the search itself is widened by.
            let reach = sphere.reach + 2.0 * widening(spacing);
            distance2 <= reach * reach
        });
        if reached {
            self.sphere = None;
        }
    }

    /// The track with the voxels near a sphere; `None` if there is no room for them (scattered voxels have much surface).
    fn bring(&mut self, voxels: &Voxels, sphere: &Sphere) -> Option<&mut Self> {
        if self.holds(sphere) {
            return Some(self);
        }
        let slack_m = SLACK_VOXELS * voxels.geometry().smallest_spacing_m();
        let widened = Sphere { reach: sphere.reach + slack_m, ..*sphere };
        let near = &mut self.near;
        near.clear();
        let mut fits = true;
        let searched = voxels.gather(&widened, |voxel| {
            let place = voxels.pool().place(voxel.map(|x| x as usize));
            fits &= near.push(voxels.geometry().voxel_position(voxel), place);
        });
        // Outside the grid nothing ever changes.
        self.box_searched = searched.unwrap_or(VoxelBox::NOTHING);
        self.sphere = fits.then_some(widened);
        fits.then_some(self)
    }
}

/// The nearby voxels of every sphere. All memory is reserved at construction.
#[derive(Debug)]
pub(super) struct ContactCache {
    tracks: Vec<Track>,
    /// Number of edits of the voxels that the tracks have seen.
    seen: u64,
}

impl ContactCache {
    /// An empty cache of these voxels.
    pub fn new(voxels: &Voxels) -> Self {
        let empty = || Track {
            sphere: None,
            box_searched: VoxelBox::NOTHING,
            near: NearVoxels::new(),
            cells: RememberedCells::new(),
        };
        Self { tracks: (0..TRACKED_SPHERES).map(|_| empty()).collect(), seen: voxels.journal().edits() }
    }

    /// Adds the sphere's planes: those of [`Voxels::contact_planes`], bit for bit.
    pub fn planes(&mut self, voxels: &Voxels, arch: Arch, sphere: &Sphere, out: &mut ContactBuffer) {
        if voxels.lead_out(sphere, out) {
            return;
        }
        self.forget_what_changed(voxels);
        match self.tracks.get_mut(sphere.index).and_then(|track| track.bring(voxels, sphere)) {
            Some(track) => arch.dispatch(PlanesOfTrack { voxels, sphere, track, out }),
            None => voxels.planes_of_search(sphere, out),
        }
    }

    /// Forgets what the voxels' edits since the last query may have made wrong.
    #[inline]
    fn forget_what_changed(&mut self, voxels: &Voxels) {
        let edits = voxels.journal().edits();
        if edits != self.seen {
            if edits == self.seen + 1 {
                self.forget_last_tick(voxels);
            } else {
                self.tracks.iter_mut().for_each(|track| track.sphere = None);
            }
            self.seen = edits;
        }
    }

    /// For one tick of drilling.
    fn forget_last_tick(&mut self, voxels: &Voxels) {
        // Voxels whose spent fractions are now kept elsewhere.
        for block in voxels.pool().blocks_since(voxels.journal().blocks_before()) {
            for track in &mut self.tracks {
                if track.box_searched.meets(&block) {
                    track.sphere = None;
                }
            }
        }
        let geometry = voxels.geometry();
        for removed in voxels.removed_this_tick() {
            let position = geometry.voxel_position(geometry.voxel(*removed).map(|x| x as i64));
            self.tracks.iter_mut().for_each(|track| track.forget_near(position, geometry.spacing_m));
        }
    }
}

/// The planes among a track's voxels, compiled for each instruction set; no bit depends on it, as no operation is reordered or fused.
struct PlanesOfTrack<'a> {
    voxels: &'a Voxels,
    sphere: &'a Sphere,
    track: &'a mut Track,
    out: &'a mut ContactBuffer,
}

impl pulp::WithSimd for PlanesOfTrack<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Self { voxels, sphere, track, out } = self;
        voxels.see(&track.near, sphere, &mut out.candidates);
        voxels.cluster(sphere, out, Some(&mut track.cells));
    }
}
