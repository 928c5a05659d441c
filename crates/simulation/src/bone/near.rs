//! Stores the voxels that may be nearest to a sphere, and their distances, as arrays for branch-free SIMD
//! loops.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use nalgebra::Vector3;

use super::gather::{Sphere, outside};
use super::grid::GridGeometry;
use super::query::{ContactKind, SurfaceSource, VoxelEnd};
use super::strength::PoolIndex;
use super::voxels::Voxels;

/// Minimum capacity of a search, in voxels.
const LEAST_NEAR: usize = 768;
/// Minimum surface area that a search can store if its voxels are finer than 0.25 mm, counted in voxel faces:
/// 48 mm².
const NEAR_AREA_M2: f64 = 48.0e-6;

/// Returns the maximum number of voxels that a search stores in this grid. If more are within reach, as
/// around a burr in its own tunnel, the nearest are kept. The limit is an area, not a count: with fine
/// voxels, a fixed count would see only one side of a surrounding wall.
pub(super) fn most_near(geometry: &GridGeometry) -> usize {
    let edge_m = geometry.smallest_spacing_m();
    LEAST_NEAR.max((NEAR_AREA_M2 / (edge_m * edge_m)) as usize).next_multiple_of(LANES)
}

/// Number of values compared at a time.
const LANES: usize = 4;

/// Maximum number of voxels examined for one plane besides the nearest. With 16, the gap in a tunnel of 0.5
/// mm voxels still jumped by 0.012 mm; with 32 by 0.008 mm, the same as with all.
const MOST_TRIED: usize = 32;
/// Marks a voxel whose surface was not examined.
const UNSEEN: u16 = u16::MAX;

const _: () = assert!(LEAST_NEAR.is_multiple_of(LANES), "the lanes' padding fits");

/// A stored voxel and the squared distance of its box from the sphere's centre. The greatest is the farthest;
/// ties go to the first one.
#[derive(Debug, Clone, Copy)]
struct Far {
    distance2: f64,
    voxel: usize,
}

impl Ord for Far {
    fn cmp(&self, other: &Self) -> Ordering {
        self.distance2.total_cmp(&other.distance2).then(other.voxel.cmp(&self.voxel))
    }
}

impl PartialOrd for Far {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Far {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Far {}

/// Voxels, in the order found.
#[derive(Debug, Clone)]
pub(super) struct NearVoxels {
    count: usize,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    /// Where the pool stores each voxel's spent fraction.
    place: Vec<PoolIndex>,
    any_place: bool,
    /// The spent fractions, once loaded.
    spent: Vec<f64>,
    /// The voxels by distance; used once the capacity is exceeded.
    by_distance: BinaryHeap<Far>,
}

impl NearVoxels {
    /// Creates room for `most` voxels.
    pub fn new(most: usize) -> Self {
        let numbers = || vec![0.0; most];
        Self {
            count: 0,
            position: [numbers(), numbers(), numbers()],
            place: vec![PoolIndex::NONE; most],
            any_place: false,
            spent: numbers(),
            by_distance: BinaryHeap::with_capacity(most),
        }
    }

    /// Returns the capacity.
    pub fn most(&self) -> usize {
        self.place.len()
    }

    pub fn clear(&mut self) {
        self.count = 0;
        self.any_place = false;
        self.by_distance.clear();
    }

    /// Adds a voxel; returns false if there is no room.
    #[inline]
    pub fn push(&mut self, position: [f64; 3], place: PoolIndex) -> bool {
        let room = self.count < self.most();
        if room {
            self.put(self.count, position, place);
            self.count += 1;
        }
        room
    }

    /// Adds a voxel; if there is no room, replaces the voxel whose box is farthest.
    pub fn push_nearest(
        &mut self,
        sphere: &Sphere,
        spacing: &[f64; 3],
        position: [f64; 3],
        place: PoolIndex,
    ) {
        if self.push(position, place) {
            return;
        }
        let far = |voxel: usize, position: [f64; 3]| {
            let to_box = [0, 1, 2].map(|a| outside(sphere.centre[a] - position[a], spacing[a]));
            let distance2 = to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2];
            Far { distance2, voxel }
        };
        if self.by_distance.is_empty() {
            let stored = 0..self.count;
            self.by_distance
                .extend(stored.map(|voxel| far(voxel, [0, 1, 2].map(|a| self.position[a][voxel]))));
        }
        let Some(mut farthest) = self.by_distance.peek_mut() else { return };
        let new = far(farthest.voxel, position);
        if new.distance2 < farthest.distance2 {
            *farthest = new;
            drop(farthest);
            self.put(new.voxel, position, place);
        }
    }

    /// Loads the spent fractions, for [`Voxels::see`].
    #[inline]
    pub fn load_spent(&mut self, voxels: &Voxels) {
        if self.any_place {
            for (spent, place) in self.spent.iter_mut().zip(&self.place[..self.count]) {
                *spent = voxels.pool().spent_at(*place);
            }
        }
    }

    #[inline]
    fn put(&mut self, voxel: usize, position: [f64; 3], place: PoolIndex) {
        for (along, position) in self.position.iter_mut().zip(position) {
            along[voxel] = position;
        }
        self.place[voxel] = place;
        self.any_place |= place != PoolIndex::NONE;
    }
}

/// The voxel nearest to a sphere.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seed {
    /// Vector from the voxel to the sphere's centre, grid frame, metres.
    pub offset: Vector3<f64>,
    /// Square of the offset's length.
    pub length2: f64,
    /// Square of the distance from the sphere's centre to the voxel's surface.
    pub distance2: f64,
}

/// The smoothed surface at a voxel, seen from the sphere's centre.
#[derive(Debug, Clone, Copy)]
pub(super) struct Surface {
    /// Direction from the voxel to the centre, unit length.
    pub direction: Vector3<f64>,
    /// Outward normal of the bone.
    pub normal: Vector3<f64>,
    /// Distance from the centre, m.
    pub distance_m: f64,
}

impl Surface {
    /// Placeholder for a surface not found yet.
    pub const NONE: Self =
        Self { direction: Vector3::new(0.0, 0.0, 0.0), normal: Vector3::new(0.0, 0.0, 0.0), distance_m: 0.0 };
}

/// Distances of the voxels from the sphere, stored squared because only a few need the root.
#[derive(Debug, Clone)]
pub(super) struct Candidates {
    count: usize,
    offset: [Vec<f64>; 3],
    length2: Vec<f64>,
    /// Squared distances; infinite for voxels out of reach or dropped, and as padding from `count` up to a
    /// multiple of `LANES`.
    distance2: Vec<f64>,
    /// The examined surfaces, for the planes after the first, and the index of each voxel's surface;
    /// [`UNSEEN`] if it has none.
    surfaces: Vec<Surface>,
    surface_of: Vec<u16>,
    /// Working memory of [`Self::nearest_surface`]: distance2 and voxel.
    order: Vec<(f64, usize)>,
    /// The distances before any was dropped.
    saved: Vec<f64>,
}

impl Candidates {
    pub fn new() -> Self {
        Self {
            count: 0,
            offset: Default::default(),
            length2: Vec::new(),
            distance2: Vec::new(),
            surfaces: Vec::new(),
            surface_of: Vec::new(),
            order: Vec::new(),
            saved: Vec::new(),
        }
    }

    /// Makes room for `most` voxels.
    pub fn make_room(&mut self, most: usize) {
        if self.length2.len() < most {
            let Self { offset: [x, y, z], length2, distance2, .. } = self;
            [x, y, z, length2, distance2].into_iter().for_each(|list| list.resize(most, f64::INFINITY));
            self.surface_of.resize(most, UNSEEN);
            self.surfaces.reserve(most);
            self.order.reserve(MOST_TRIED);
            self.saved.reserve(most);
        }
    }

    /// Computes the distances to the voxels' surfaces; those at `reach_m` or beyond do not count. Returns
    /// true if the centre lies on a surface or behind it. Without `CUT`, all voxels are whole, and the
    /// compiler drops the code for cut ones.
    #[inline(always)]
    fn see_surfaces<const CUT: bool>(
        &mut self,
        near: &NearVoxels,
        sphere: &Sphere,
        reach_m: f64,
        spacing: [f64; 3],
    ) -> bool {
        let count = near.count;
        self.count = count;
        let [x, y, z] = [0, 1, 2].map(|a| &near.position[a][..count]);
        let [to_x, to_y, to_z] = &mut self.offset;
        let (to_x, to_y, to_z) = (&mut to_x[..count], &mut to_y[..count], &mut to_z[..count]);
        let (length2, distance2) = (&mut self.length2[..count], &mut self.distance2[..count]);
        let spent = &near.spent[..count];
        let reach2 = reach_m * reach_m;
        let mut touching = 0_u64;
        for voxel in 0..count {
            let from = [sphere.centre.x - x[voxel], sphere.centre.y - y[voxel], sphere.centre.z - z[voxel]];
            let end = VoxelEnd::seen(from, spacing, if CUT { spent[voxel] } else { 0.0 });
            let cut2 = end.cut_distance * end.cut_distance;
            let cut = (end.cut_distance > 0.0) & (cut2 > end.box2);
            to_x[voxel] = if cut { from[0] } else { end.to_box[0] };
            to_y[voxel] = if cut { from[1] } else { end.to_box[1] };
            to_z[voxel] = if cut { from[2] } else { end.to_box[2] };
            length2[voxel] = if cut { end.length2 } else { end.box2 };
            let surface2 = if cut { cut2 } else { end.box2 };
            distance2[voxel] = if surface2 < reach2 { surface2 } else { f64::INFINITY };
            touching |= u64::from(surface2 <= 0.0);
        }
        self.end_lanes();
        touching != 0
    }

    #[inline(always)]
    fn end_lanes(&mut self) {
        self.distance2[self.count..self.count.next_multiple_of(LANES)].fill(f64::INFINITY);
    }

    /// Computes the distances to voxels as balls of the given radius, reduced on both sides by the spent
    /// fraction.
    fn see_balls(
        &mut self,
        near: &NearVoxels,
        sphere: &Sphere,
        radius_m: f64,
        spent: impl Fn(PoolIndex) -> f64,
    ) {
        self.count = near.count;
        for voxel in 0..near.count {
            let offset = sphere.centre - Vector3::from([0, 1, 2].map(|a| near.position[a][voxel]));
            let length2 = offset.norm_squared();
            let distance = length2.sqrt() - (1.0 - 2.0 * spent(near.place[voxel])) * radius_m;
            let counts = distance < sphere.reach && length2 > 0.0;
            let distance = distance.max(0.0);
            let distance2 = if counts { distance * distance } else { f64::INFINITY };
            self.put(voxel, &Seed { offset, length2, distance2 });
        }
        self.end_lanes();
    }

    fn put(&mut self, voxel: usize, seed: &Seed) {
        for axis in 0..3 {
            self.offset[axis][voxel] = seed.offset[axis];
        }
        self.length2[voxel] = seed.length2;
        self.distance2[voxel] = seed.distance2;
    }

    /// Keeps the voxels that are closer than `reach_m`, in their order. Most are not: the surface of a cut
    /// voxel is farther than its box.
    #[inline(always)]
    fn compact(&mut self, reach_m: f64) {
        let reach2 = reach_m * reach_m;
        let count = self.count;
        let [x, y, z] = &mut self.offset;
        let (x, y, z) = (&mut x[..count], &mut y[..count], &mut z[..count]);
        let (length2, distance2) = (&mut self.length2[..count], &mut self.distance2[..count]);
        let mut kept = 0;
        for voxel in 0..count {
            if distance2[voxel] < reach2 && kept < count {
                (x[kept], y[kept], z[kept]) = (x[voxel], y[voxel], z[voxel]);
                (length2[kept], distance2[kept]) = (length2[voxel], distance2[voxel]);
                kept += 1;
            }
        }
        self.count = kept;
        self.surface_of[..kept].fill(UNSEEN);
        self.surfaces.clear();
        self.end_lanes();
    }

    /// Saves the present candidates for [`Self::bring_back`].
    #[inline(always)]
    pub fn save(&mut self) {
        self.saved.clear();
        self.saved.extend_from_slice(&self.distance2[..self.count]);
    }

    /// Restores the candidates that were dropped since [`Self::save`].
    #[inline(always)]
    pub fn bring_back(&mut self) {
        self.distance2[..self.count].copy_from_slice(&self.saved);
    }

    /// Drops the candidates whose angle to either direction has a cosine larger than `cosine`, which must be
    /// positive.
    #[inline(always)]
    pub fn drop_near(&mut self, [first, second]: [&Vector3<f64>; 2], cosine: f64) {
        let limit = cosine * cosine;
        let count = self.count;
        let [x, y, z] = [0, 1, 2].map(|a| &self.offset[a][..count]);
        let (length2, distance2) = (&self.length2[..count], &mut self.distance2[..count]);
        for voxel in 0..count {
            let along_first = x[voxel] * first.x + y[voxel] * first.y + z[voxel] * first.z;
            let along_second = x[voxel] * second.x + y[voxel] * second.y + z[voxel] * second.z;
            let along = if along_first > along_second { along_first } else { along_second };
            let near = along * along.abs() > limit * length2[voxel];
            distance2[voxel] = if near { f64::INFINITY } else { distance2[voxel] };
        }
    }

    /// Returns the nearest surface among the candidates; the first one in case of a tie. `look` finds the
    /// surface at a voxel, which is never closer than the voxel itself.
    #[inline(always)]
    pub fn nearest_surface(&mut self, look: &mut impl SurfaceSource) -> Option<Surface> {
        let nearest = self.nearest()?;
        let mut best: Option<Surface> = None;
        let (mut voxel, mut place) = (nearest, 0);
        loop {
            let surface = self.surface_at(voxel, look);
            let nearer = match &best {
                Some(best) if surface.distance_m >= best.distance_m => *best,
                Some(_) => surface,
                None => {
                    let reach2 = surface.distance_m * surface.distance_m;
                    if reach2 <= self.distance2[nearest] {
                        return Some(surface);
                    }
                    self.list_nearer_than(reach2, nearest);
                    surface
                }
            };
            best = Some(nearer);
            match self.order.get(place) {
                Some((distance2, next)) if *distance2 < nearer.distance_m * nearer.distance_m => {
                    voxel = *next
                }
                _ => return best,
            }
            place += 1;
        }
    }

    /// Lists the candidates closer than `reach2` except `but`, nearest first, at most [`MOST_TRIED`].
    #[inline(always)]
    fn list_nearer_than(&mut self, reach2: f64, but: usize) {
        self.order.clear();
        let mut limit2 = reach2;
        for (voxel, distance2) in self.distance2[..self.count].iter().enumerate() {
            if *distance2 < limit2 && voxel != but {
                self.order.truncate(MOST_TRIED - 1);
                let place = self.order.partition_point(|(other2, _)| other2 <= distance2);
                self.order.insert(place, (*distance2, voxel));
                if let (MOST_TRIED, Some((last2, _))) = (self.order.len(), self.order.last()) {
                    limit2 = *last2;
                }
            }
        }
    }

    #[inline(always)]
    fn surface_at(&mut self, voxel: usize, look: &mut impl SurfaceSource) -> Surface {
        if let Some(surface) = self.surfaces.get(usize::from(self.surface_of[voxel])) {
            return *surface;
        }
        let surface = look.surface(&self.seed(voxel));
        if self.surfaces.len() < usize::from(UNSEEN) {
            self.surface_of[voxel] = self.surfaces.len() as u16;
            self.surfaces.push(surface);
        }
        surface
    }

    /// Returns the square of the distance to the nearest surface, m²; infinite if none counts.
    #[inline(always)]
    fn least_distance2(&self) -> f64 {
        let padded = &self.distance2[..self.count.next_multiple_of(LANES)];
        let mut low = [f64::INFINITY; LANES];
        for lanes in padded.chunks_exact(LANES) {
            for (low, distance2) in low.iter_mut().zip(lanes) {
                *low = if *distance2 < *low { *distance2 } else { *low };
            }
        }
        low.iter().fold(f64::INFINITY, |low, x| if *x < low { *x } else { low })
    }

    /// Returns the nearest candidate; the first one in case of a tie.
    #[inline(always)]
    fn nearest(&self) -> Option<usize> {
        let distance2 = self.least_distance2();
        if distance2 == f64::INFINITY {
            return None;
        }
        self.distance2[..self.count].iter().position(|x| *x == distance2)
    }

    #[inline(always)]
    fn seed(&self, voxel: usize) -> Seed {
        let offset = Vector3::from([0, 1, 2].map(|a| self.offset[a][voxel]));
        Seed { offset, length2: self.length2[voxel], distance2: self.distance2[voxel] }
    }
}

impl Voxels {
    /// Computes the distances of the near voxels' surfaces from a sphere; those out of its reach do not
    /// count. The spent fractions must be loaded, and the voxels must be all those whose boxes are within
    /// `searched_m`. If the nearest surface is out of the sphere's reach, returns its distance, at most
    /// `searched_m`: the sphere then has no plane.
    #[inline(always)]
    pub(super) fn see(
        &self,
        near: &NearVoxels,
        sphere: &Sphere,
        searched_m: f64,
        candidates: &mut Candidates,
    ) -> Option<f64> {
        let spacing = self.geometry().spacing_m;
        candidates.make_room(near.most());
        if self.parameters().contact == ContactKind::VoxelBalls {
            let radius_m = 0.5 * self.geometry().smallest_spacing_m();
            candidates.see_balls(near, sphere, radius_m, |place| self.pool().spent_at(place));
            candidates.compact(f64::INFINITY);
            return None;
        }
        let touching = if near.any_place {
            candidates.see_surfaces::<true>(near, sphere, searched_m, spacing)
        } else {
            candidates.see_surfaces::<false>(near, sphere, searched_m, spacing)
        };
        if touching {
            self.see_touching(near, sphere, candidates);
        } else {
            let least2 = candidates.least_distance2();
            if least2 >= sphere.reach * sphere.reach {
                return Some(least2.sqrt().min(searched_m));
            }
        }
        candidates.compact(sphere.reach);
        None
    }

    /// Handles voxels with the centre exactly on their boundary: the direction is outward through that face.
    fn see_touching(&self, near: &NearVoxels, sphere: &Sphere, candidates: &mut Candidates) {
        for voxel in 0..near.count {
            if candidates.length2[voxel] <= 0.0 {
                let position = Vector3::from([0, 1, 2].map(|a| near.position[a][voxel]));
                let offset = self.face_direction(&(sphere.centre - position));
                // A voxel that is more than half cut and has the sphere's centre at its middle has no
                // direction to push in.
                let pushes = self.pool().spent_at(near.place[voxel]) <= 0.5;
                let distance2 = if pushes { 0.0 } else { f64::INFINITY };
                candidates.put(voxel, &Seed { offset, length2: 1.0, distance2 });
            }
        }
    }

    /// Returns the unit vector along the axis on which an offset from a voxel's centre is largest in units of
    /// voxels.
    fn face_direction(&self, from_centre: &Vector3<f64>) -> Vector3<f64> {
        let in_voxels = [0, 1, 2].map(|a| (from_centre[a] / self.geometry().spacing_m[a]).abs());
        let mut axis = 0;
        for other in 1..3 {
            if in_voxels[other] > in_voxels[axis] {
                axis = other;
            }
        }
        let mut direction = Vector3::zeros();
        direction[axis] = if from_centre[axis] < 0.0 { -1.0 } else { 1.0 };
        direction
    }
}
