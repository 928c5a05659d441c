//! The contact cache, which speeds up queries for spheres that move little between ticks.
//!
//! Which voxels can be nearest to a sphere depends only on the bone around it and on the voxel that contains
//! its centre. For each sphere the cache stores the voxels that [`Voxels::gather`] finds within a slightly
//! wider reach ([`SLACK_VOXELS`]). The stored voxels contain all that matter, in the order of a new search,
//! while three conditions hold: the centre stays in its voxel, the query's reach lies within the stored one,
//! and no voxel in it is removed or cut for the first time. Distances are always recomputed. The planes equal
//! those of [`Voxels::contact_planes`] bit for bit, so the cache is not part of the state.
//!
//! Most spheres of a tool in a hole touch nothing. For such a sphere, the cache also stores the distance of
//! the nearest surface, and queries again only once the sphere has moved far enough that it may touch
//! ([`Clear`]).

use nalgebra::Vector3;
use pulp::Arch;

use super::gather::{Sphere, outside, widening};
use super::grid::GridGeometry;
use super::near::{NearVoxels, most_near};
use super::occupancy::VoxelBox;
use super::query::ContactBuffer;
use super::remembered::RememberedCells;
use super::voxels::Voxels;

/// Number of cached spheres; those with a higher index are searched every time.
const TRACKED_SPHERES: usize = 64;

const _: () = assert!(
    TRACKED_SPHERES >= crate::manipulator::MAX_SPHERES,
    "every sphere of the planar tool has a track"
);

/// Extra reach of the cached search, in voxels of the smallest spacing. A tool fed at 1.5 mm/s through 0.5 mm
/// voxels needs a new search every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;
/// The same for a sphere that touched nothing: it is seldom examined, so a longer list costs little.
const CLEAR_SLACK_VOXELS: f64 = 0.4;

/// A sphere that touched nothing.
///
/// A voxel's surface is at `max(distance to its box, |d| - (f - 1/2) w(d))`, where d points from its centre
/// to the sphere's. The first term grows by at most the sphere's motion, and so does `|d|`; w depends only on
/// the direction of d, and changes with the motion across d by at most the voxel's diagonal over `|d|`. With
/// `|d|` at least half the diagonal, the distance thus changes by at most sqrt(2) times the motion. Drilling
/// moves every surface away, and a voxel that was hidden is no closer than what hid it.
#[derive(Debug, Clone, Copy)]
struct Clear {
    /// Position of the sphere, in the grid's frame.
    centre: Vector3<f64>,
    /// Distance from there to the nearest surface, m.
    distance_m: f64,
}

impl Clear {
    /// Maximum change of a distance relative to the motion: sqrt(2), with a margin.
    const MOST_CHANGE: f64 = 1.5;
    /// Margin far above the rounding of distances, m.
    const ROUNDING_M: f64 = 1e-9;

    /// Returns true if the sphere still touches nothing. A reach of one diagonal keeps |d| above half of it.
    #[inline]
    fn holds(&self, sphere: &Sphere, spacing: [f64; 3]) -> bool {
        let [hx, hy, hz] = spacing;
        let room_m = (self.distance_m - sphere.reach - Self::ROUNDING_M) / Self::MOST_CHANGE;
        room_m > 0.0
            && sphere.reach * sphere.reach >= hx * hx + hy * hy + hz * hz
            && (sphere.centre - self.centre).norm_squared() <= room_m * room_m
    }
}

/// Cache entry of one sphere.
#[derive(Debug, Clone)]
struct Track {
    /// The sphere of the search, with its widened reach; `None` if the entry is empty.
    sphere: Option<Sphere>,
    /// The voxels searched.
    box_searched: VoxelBox,
    near: NearVoxels,
    /// Number of changed regions when the voxels' spent fractions were loaded; `None` if they were not.
    spent_seen: Option<u64>,
    /// The smoothed surface at the nearest voxels.
    cells: RememberedCells,
    /// Set if the sphere touched nothing when last examined.
    clear: Option<Clear>,
}

impl Track {
    fn holds(&self, sphere: &Sphere) -> bool {
        let Some(searched) = &self.sphere else { return false };
        let room = searched.reach - sphere.reach;
        searched.voxel == sphere.voxel
            && room >= 0.0
            && (sphere.centre - searched.centre).norm_squared() <= room * room
    }

    /// Returns the distance from the sphere within which all voxels are stored, for a sphere that
    /// [`Self::holds`], m.
    fn searched_m(&self, sphere: &Sphere) -> f64 {
        let rest_m =
            self.sphere.map_or(0.0, |searched| searched.reach - (sphere.centre - searched.centre).norm());
        rest_m.max(sphere.reach)
    }

    /// Invalidates the entry near a voxel that is gone or cut for the first time. That exposes only voxels
    /// that are no closer to a sphere than this one, so a sphere that does not reach it sees no change.
    fn forget_near(&mut self, position: [f64; 3], spacing: [f64; 3]) {
        let reached = self.sphere.is_some_and(|sphere| {
            let to_box = [0, 1, 2].map(|a| outside(sphere.centre[a] - position[a], spacing[a]));
            let distance2 = to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2];
            // Twice the margin of the search itself.
            let reach = sphere.reach + 2.0 * widening(spacing);
            distance2 <= reach * reach
        });
        if reached {
            self.sphere = None;
        }
    }

    /// Invalidates the entry near a box of voxels, some of which were cut for the first time.
    fn forget_near_box(&mut self, voxels: &VoxelBox, spacing: [f64; 3]) {
        let reached = self.sphere.is_some_and(|sphere| {
            let mut distance2 = 0.0;
            for (axis, spacing) in spacing.into_iter().enumerate() {
                let low = (voxels.low[axis] as f64 - 0.5) * spacing - sphere.centre[axis];
                let high = sphere.centre[axis] - (voxels.high[axis] as f64 + 0.5) * spacing;
                let beyond = low.max(high).max(0.0);
                distance2 += beyond * beyond;
            }
            let reach = sphere.reach + 2.0 * widening(spacing);
            distance2 <= reach * reach
        });
        if reached {
            self.sphere = None;
        }
    }

    /// Returns the track with the voxels near a sphere; `None` if there is no room for them (scattered voxels
    /// have a lot of surface).
    fn bring(&mut self, voxels: &Voxels, sphere: &Sphere) -> Option<&mut Self> {
        if self.holds(sphere) {
            self.load_spent(voxels);
            return Some(self);
        }
        let slacks =
            if self.clear.is_some() { &[CLEAR_SLACK_VOXELS, SLACK_VOXELS][..] } else { &[SLACK_VOXELS] };
        let fits = slacks.iter().any(|slack| self.search(voxels, sphere, *slack));
        fits.then_some(self)
    }

    /// Stores the voxels near a sphere; returns false if there is no room for them.
    fn search(&mut self, voxels: &Voxels, sphere: &Sphere, slack_voxels: f64) -> bool {
        let slack_m = slack_voxels * voxels.geometry().smallest_spacing_m();
        let widened = Sphere { reach: sphere.reach + slack_m, ..*sphere };
        let near = &mut self.near;
        near.clear();
        let mut fits = true;
        let searched = voxels.gather(&widened, |voxel| {
            let place = voxels.pool().place(voxel.map(|x| x as usize));
            fits &= near.push(voxels.geometry().voxel_position(voxel), place);
        });
        // Nothing ever changes outside the grid.
        self.box_searched = searched.unwrap_or(VoxelBox::NOTHING);
        self.sphere = fits.then_some(widened);
        self.spent_seen = None;
        self.load_spent(voxels);
        fits
    }

    /// Loads the spent fractions unless they are loaded and unchanged.
    fn load_spent(&mut self, voxels: &Voxels) {
        let journal = voxels.journal();
        if !self.spent_seen.is_some_and(|seen| journal.is_unchanged(seen, &self.box_searched)) {
            self.near.load_spent(voxels);
        }
        self.spent_seen = Some(journal.regions());
    }
}

/// The nearby voxels of every sphere. All memory is reserved at construction.
#[derive(Debug)]
pub(super) struct ContactCache {
    tracks: Vec<Track>,
    /// Number of voxel edits that the tracks have seen.
    seen: u64,
}

impl ContactCache {
    /// Creates an empty cache for these voxels.
    pub fn new(voxels: &Voxels) -> Self {
        let most = most_near(voxels.geometry());
        let empty = || Track {
            sphere: None,
            box_searched: VoxelBox::NOTHING,
            near: NearVoxels::new(most),
            spent_seen: None,
            cells: RememberedCells::new(),
            clear: None,
        };
        Self { tracks: (0..TRACKED_SPHERES).map(|_| empty()).collect(), seen: voxels.journal().edits() }
    }

    /// Adds the sphere's planes: those of [`Voxels::contact_planes`], bit for bit.
    pub fn planes(&mut self, voxels: &Voxels, arch: Arch, sphere: &Sphere, out: &mut ContactBuffer) {
        self.forget_what_changed(voxels);
        let spacing = voxels.geometry().spacing_m;
        let clear = self.tracks.get(sphere.index).and_then(|track| track.clear);
        if clear.is_some_and(|clear| clear.holds(sphere, spacing)) || voxels.lead_out(sphere, out) {
            return;
        }
        match self.tracks.get_mut(sphere.index).and_then(|track| track.bring(voxels, sphere)) {
            Some(track) => arch.dispatch(PlanesOfTrack { voxels, sphere, track, out }),
            None => voxels.planes_of_search(sphere, out),
        }
    }

    /// Drops entries that edits since the last query may have invalidated.
    #[inline]
    fn forget_what_changed(&mut self, voxels: &Voxels) {
        let edits = voxels.journal().edits();
        if edits != self.seen {
            if edits == self.seen + 1 {
                self.forget_last_tick(voxels);
            } else {
                for track in &mut self.tracks {
                    (track.sphere, track.clear) = (None, None);
                }
            }
            self.seen = edits;
        }
    }

    /// Drops the entries that one tick of drilling invalidates.
    fn forget_last_tick(&mut self, voxels: &Voxels) {
        // The spent fractions of these voxels have moved to another place.
        for block in voxels.pool().blocks_since(voxels.journal().blocks_before()) {
            for track in &mut self.tracks {
                if track.box_searched.meets(&block) {
                    track.sphere = None;
                }
            }
        }
        let geometry = voxels.geometry();
        // Voxels that these voxels hid.
        match voxels.journal().first_cuts() {
            Ok(cut) => cut.iter().for_each(|voxel| self.forget_near(geometry, *voxel)),
            Err(cut) => {
                for track in self.tracks.iter_mut().filter(|track| track.box_searched.meets(cut)) {
                    track.forget_near_box(cut, geometry.spacing_m);
                }
            }
        }
        for emptied in voxels.emptied_this_tick() {
            self.forget_near(geometry, geometry.voxel(*emptied).map(|x| x as i64));
        }
    }

    /// Drops the entries invalidated by a voxel that hides less than before.
    fn forget_near(&mut self, geometry: &GridGeometry, voxel: [i64; 3]) {
        let (position, own) = (geometry.voxel_position(voxel), VoxelBox { low: voxel, high: voxel });
        for track in self.tracks.iter_mut().filter(|track| track.box_searched.meets(&own)) {
            track.forget_near(position, geometry.spacing_m);
        }
    }
}

/// Finds the planes among a track's voxels, compiled for each instruction set. No operation is reordered or
/// fused, so the result is bit-identical.
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
        let clear_m = voxels.see(&track.near, sphere, track.searched_m(sphere), &mut out.candidates);
        track.clear = clear_m.map(|distance_m| Clear { centre: sphere.centre, distance_m });
        if clear_m.is_none() {
            voxels.cluster(sphere, out, Some(&mut track.cells));
        }
    }
}
