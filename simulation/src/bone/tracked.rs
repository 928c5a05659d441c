//! Contact queries of spheres that move little between ticks.
//!
//! Which voxels can be nearest to a sphere depends only on the bone about it and on the voxel that holds its centre. So the
//! field remembers for each sphere the voxels that [`BoneField::gather`] finds within a reach that is a little wider
//! ([`SLACK_VOXELS`]). As long as the centre stays in its voxel and the query's reach about it lies within the remembered one,
//! and no voxel within it is removed, the remembered voxels contain all that count, in the order of a fresh search; their
//! distances are always computed afresh. The planes are those of [`BoneField::contact_planes`] bit for bit, so what is
//! remembered is no part of the state.

use nalgebra::Vector3;

use super::field::BoneField;
use super::gather::{Sphere, outside, widening};
use super::near::NearVoxels;
use super::occupancy::VoxelBox;
use super::query::ContactBuffer;
use super::remembered::RememberedCells;

/// Spheres with a memory; those of a higher index are searched afresh.
const TRACKED_SPHERES: usize = 64;
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
}

/// The memory of all spheres, reserved once.
#[derive(Debug, Clone, Default)]
pub(super) struct Tracks {
    items: Vec<Track>,
}

impl Tracks {
    pub fn new() -> Self {
        let empty = || Track {
            sphere: None,
            box_searched: VoxelBox::NOTHING,
            near: NearVoxels::new(),
            cells: RememberedCells::new(),
        };
        Self { items: (0..TRACKED_SPHERES).map(|_| empty()).collect() }
    }

    /// For any change of the bone.
    pub fn forget_all(&mut self) {
        self.items.iter_mut().for_each(|track| track.sphere = None);
    }

    /// For a voxel that is removed. It uncovers only voxels that are no nearer to a sphere than itself, so a sphere that does
    /// not reach it sees no change.
    pub fn forget_near(&mut self, position: [f64; 3], spacing: [f64; 3]) {
        for track in &mut self.items {
            let reached = track.sphere.is_some_and(|sphere| {
                let to_box = [0, 1, 2].map(|a| outside(sphere.centre[a] - position[a], spacing[a]));
                let distance2 = to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2];
                // Twice what the search itself is widened by.
                let reach = sphere.reach + 2.0 * widening(spacing);
                distance2 <= reach * reach
            });
            if reached {
                track.sphere = None;
            }
        }
    }

    /// For voxels whose spent fractions are now kept elsewhere.
    pub fn forget_box(&mut self, voxels: &VoxelBox) {
        for track in &mut self.items {
            if track.box_searched.meets(voxels) {
                track.sphere = None;
            }
        }
    }
}

/// The planes among a track's voxels, compiled for each instruction set; no bit depends on it, as no operation is reordered or fused.
struct PlanesOfTrack<'a> {
    field: &'a BoneField,
    sphere_index: usize,
    sphere: &'a Sphere,
    radius_m: f64,
    track: &'a mut Track,
    out: &'a mut ContactBuffer,
}

impl pulp::WithSimd for PlanesOfTrack<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Self { field, sphere_index, sphere, radius_m, track, out } = self;
        field.see(&track.near, sphere, &mut out.candidates);
        field.cluster(sphere_index, &sphere.centre, radius_m, out, Some(&mut track.cells));
    }
}

impl BoneField {
    /// The planes of [`BoneField::contact_planes`], bit for bit, in a fraction of the time for a sphere of the same index
    /// that has moved little since its last query.
    pub fn contact_planes_tracked(
        &mut self,
        sphere_index: usize,
        centre_world_m: &Vector3<f64>,
        radius_m: f64,
        margin_m: f64,
        out: &mut ContactBuffer,
    ) {
        let Some(sphere) = self.sphere(centre_world_m, radius_m, margin_m) else { return };
        if self.lead_out(sphere_index, &sphere, radius_m, out) {
            return;
        }
        let mut tracks = core::mem::take(&mut self.tracks);
        let track = tracks.items.get_mut(sphere_index);
        if let Some(track) = track.and_then(|track| self.bring(track, &sphere)) {
            self.arch.dispatch(PlanesOfTrack {
                field: self,
                sphere_index,
                sphere: &sphere,
                radius_m,
                track,
                out,
            });
        } else {
            self.planes_of_search(sphere_index, &sphere, radius_m, out);
        }
        self.tracks = tracks;
    }

    /// The track with the voxels near a sphere; `None` if there is no room for them (scattered voxels have much surface).
    fn bring<'t>(&self, track: &'t mut Track, sphere: &Sphere) -> Option<&'t mut Track> {
        if track.holds(sphere) {
            return Some(track);
        }
        let slack_m = SLACK_VOXELS * self.geometry.smallest_spacing_m();
        let widened = Sphere { reach: sphere.reach + slack_m, ..*sphere };
        let near = &mut track.near;
        near.clear();
        let mut fits = true;
        let searched = self.gather(&widened, |voxel| {
            let place = self.pool.place(voxel.map(|x| x as usize));
            fits &= near.push(self.voxel_position(voxel), place);
        });
        // Outside the grid nothing ever changes.
        track.box_searched = searched.unwrap_or(VoxelBox::NOTHING);
        track.sphere = fits.then_some(widened);
        fits.then_some(track)
    }
}
