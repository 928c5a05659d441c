//! Contact planes between a sphere and the voxels.
//!
//! **Where the surface is.** A whole voxel is its box. A voxel with the fraction f left ends at the distance
//! `|c - x| - (f - 1/2) w` from the sphere's centre c, where x is the voxel's centre and w its width along
//! that direction: the box, cut by a plane that leaves the fraction f. The distance to a voxel is the larger
//! of this and the distance to its box. A sphere on a flat wall of whole voxels therefore has gap 0 exactly
//! at the wall.
//!
//! **Staircases.** The corners of a slanted voxel wall protrude from the plane they approximate. The gap is
//! widened by the nearest point's protrusion from the smoothed surface (see `surface.rs`), by at most half a
//! voxel; it is never narrowed. Where the smoothed normal leans far from the direction to the voxel (thin
//! sheets, single voxels), both fade out.
//!
//! **Which planes.** A voxel can be nearest only if no whole neighbour lies between it and the centre, which
//! bitwise operations find. On a flat wall one candidate remains, in a tunnel a few dozen. The candidate with
//! the smallest distance *plus* widening gives the first plane: the minimum of continuous functions is
//! continuous, so the gap changes no faster than the sphere moves (`tests/physics/gap.rs`). The nearest
//! candidate more than 60 degrees away from it gives the second, and so on, up to four, or up to eight where
//! the gap is small, so that no side is missed; then the nearest ones that are more than 10 degrees away from
//! all others follow, up to fourteen in total.
//!
//! All of this describes [`ContactKind::Planes`]; [`ContactKind::VoxelBalls`] exists for comparison.

use nalgebra::{Unit, Vector3};

use crate::contact_plane::ContactPlane;

use super::gather::{Sphere, outside};
use super::grid::floor_to_i64;
use super::near::{Candidates, NearVoxels, Seed, Surface, most_near};
use super::remembered::RememberedCells;
use super::surface::TentSizes;
use super::voxels::Voxels;

/// Contact model of a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ContactKind {
    /// Part of the smoothed surface: see the [module](self).
    #[default]
    Planes,
    /// A ball at the voxel's centre with half the smallest edge as radius and no smoothing, as in published
    /// simulators (Phalen et al. 2023). Normals change from voxel to voxel, so a wall acts like a bed of
    /// balls.
    VoxelBalls,
}

/// Maximum number of planes on different sides of a sphere, regardless of their gap.
const FAR_PLANES: usize = 4;
/// Maximum number of these planes including those with a small gap: as many sides as a hole can have around
/// the burr. With four, a burr in a hole of its own size saw one wall at a time and was thrown back and
/// forth.
const MOST_FAR_PLANES: usize = 8;
/// Their minimum angle from one another (cosine; 60 degrees).
const FAR_APART_COSINE: f64 = 0.5;
/// Maximum planes per sphere. In a groove or at the end of a hole, bone touches a sphere all around.
pub const MAX_PLANES: usize = MOST_FAR_PLANES + 6;
/// Minimum angle between any two planes (cosine; 10 degrees). With 60 degrees, only one of a groove's two
/// sides was seen at a time, and the burr was thrown back and forth; with 5 degrees, the planes of one small
/// patch use up the capacity.
const NEAR_APART_COSINE: f64 = 0.985;
/// Maximum gap, m, of planes closer together than [`FAR_APART_COSINE`]: the motion of a sphere in a few
/// ticks.
const NEAR_GAP_M: f64 = 1.0e-4;

/// Cosine between the smoothed normal and the seed's direction below which the normal is not trusted, as on
/// thin sheets and single voxels.
const NORMAL_AGREEMENT_COSINE: f64 = 0.3;

/// Contact planes of one tick and the query's working memory, allocated once.
#[derive(Debug, Clone)]
pub struct ContactBuffer {
    planes: Vec<ContactPlane>,
    capacity: usize,
    dropped: usize,
    /// Working memory of a search.
    near: Box<NearVoxels>,
    pub(super) candidates: Box<Candidates>,
}

impl ContactBuffer {
    /// Creates a buffer for `capacity` planes.
    pub fn with_capacity(capacity: usize) -> Self {
        Self {
            planes: Vec::with_capacity(capacity),
            capacity,
            dropped: 0,
            near: Box::new(NearVoxels::new(0)),
            candidates: Box::new(Candidates::new()),
        }
    }

    /// Reserves the memory for a search of these voxels; otherwise, the first query does so.
    pub fn make_room(&mut self, voxels: &Voxels) {
        let most = most_near(voxels.geometry());
        if self.near.most() < most {
            *self.near = NearVoxels::new(most);
            self.candidates.make_room(most);
        }
    }

    /// Empties the buffer for the next tick.
    pub fn clear(&mut self) {
        self.planes.clear();
        self.dropped = 0;
    }

    /// Returns the planes found so far, in query order, nearest first within a sphere.
    pub fn planes(&self) -> &[ContactPlane] {
        &self.planes
    }

    /// Returns [`Self::planes`], to change them.
    pub fn planes_mut(&mut self) -> &mut [ContactPlane] {
        &mut self.planes
    }

    /// Drops the planes from index `first` on for which `keep`, given the retained planes before it, returns
    /// false.
    pub fn keep_from(&mut self, first: usize, keep: impl Fn(&[ContactPlane], &ContactPlane) -> bool) {
        let mut kept = first;
        for place in first..self.planes.len() {
            let plane = self.planes[place];
            if keep(&self.planes[..kept], &plane) {
                self.planes[kept] = plane;
                kept += 1;
            }
        }
        self.planes.truncate(kept);
    }

    /// Returns the number of planes dropped because the buffer was full since the last [`Self::clear`].
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Adds a plane, or counts it as dropped if the buffer is full.
    pub fn push(&mut self, plane: ContactPlane) {
        if self.planes.len() < self.capacity {
            self.planes.push(plane);
        } else {
            self.dropped += 1;
        }
    }
}

/// Surface of a voxel seen from a point: see the [module](self).
#[derive(Clone, Copy)]
pub(super) struct VoxelEnd {
    /// Vector from the box to the point, metres; 0 along an axis on which the point lies between the faces.
    pub to_box: [f64; 3],
    /// Its squared length, m².
    pub box2: f64,
    /// Square of the distance from the voxel's centre to the point, m².
    pub length2: f64,
    /// The voxel's width along the direction to the point, metres; 0 if undefined.
    pub width: f64,
    /// Distance from the point to the cutting plane, metres; 0 for a whole voxel.
    pub cut_distance: f64,
}

impl VoxelEnd {
    /// Computes the surface; `from_centre` points from the voxel's centre to the point, `spacing` holds the
    /// voxel's edges.
    #[inline(always)]
    pub fn seen(from_centre: [f64; 3], spacing: [f64; 3], spent: f64) -> Self {
        let [[dx, dy, dz], [hx, hy, hz]] = [from_centre, spacing];
        let to_box = [outside(dx, hx), outside(dy, hy), outside(dz, hz)];
        let box2 = to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2];
        let length2 = dx * dx + dy * dy + dz * dz;
        let length = length2.sqrt();
        let length = if length > 1e-300 { length } else { 1e-300 };
        let width = (dx.abs() * hx + dy.abs() * hy + dz.abs() * hz) / length;
        let cut_distance = if spent > 0.0 { length - (0.5 - spent) * width } else { 0.0 };
        Self { to_box, box2, length2, width, cut_distance }
    }
}

impl Voxels {
    /// Adds the planes that the sphere (world centre, radius) touches or that are closer than `margin_m`. A
    /// sphere whose centre is inside bone gets the single plane that leads out. Adds nothing for non-finite
    /// values or a radius that is not positive.
    pub fn contact_planes(
        &self,
        sphere_index: usize,
        centre_world_m: &Vector3<f64>,
        radius_m: f64,
        margin_m: f64,
        out: &mut ContactBuffer,
    ) {
        if let Some(sphere) = self.sphere(sphere_index, centre_world_m, radius_m, margin_m)
            && !self.lead_out(&sphere, out)
        {
            self.planes_of_search(&sphere, out);
        }
    }

    /// Returns the sphere in the grid's frame, or `None` for invalid values.
    #[inline]
    pub(super) fn sphere(
        &self,
        index: usize,
        centre_world_m: &Vector3<f64>,
        radius_m: f64,
        margin_m: f64,
    ) -> Option<Sphere> {
        let reach = radius_m + margin_m;
        let finite = reach.is_finite() && centre_world_m.iter().all(|x| x.is_finite());
        if !finite || radius_m <= 0.0 || margin_m < 0.0 {
            return None;
        }
        let centre = self.geometry().point_to_grid(centre_world_m);
        let voxel = [0, 1, 2].map(|a| floor_to_i64(centre[a] / self.geometry().spacing_m[a] + 0.5));
        Some(Sphere { index, centre, radius_m, voxel, reach })
    }

    /// Returns true if the centre is inside bone; adds the single plane that leads out.
    #[inline]
    pub(super) fn lead_out(&self, sphere: &Sphere, out: &mut ContactBuffer) -> bool {
        let inside = self.is_mostly_solid(sphere.voxel);
        if inside {
            let (point, normal, gap_m) = self.way_out(sphere);
            out.push(self.world_plane(sphere.index, &point, &normal, gap_m));
        }
        inside
    }

    /// Adds the planes of a sphere whose centre is outside bone, by a search of all voxels in reach.
    pub(super) fn planes_of_search(&self, sphere: &Sphere, out: &mut ContactBuffer) {
        out.make_room(self);
        let ContactBuffer { near, candidates, .. } = out;
        near.clear();
        self.gather(sphere, |voxel| {
            let place = self.pool().place(voxel.map(|x| x as usize));
            let position = self.geometry().voxel_position(voxel);
            near.push_nearest(sphere, &self.geometry().spacing_m, position, place);
        });
        near.load_spent(self);
        if self.see(near, sphere, sphere.reach, candidates).is_none() {
            self.cluster(sphere, out, None);
        }
    }

    #[inline(always)]
    fn world_plane(
        &self,
        sphere_index: usize,
        point: &Vector3<f64>,
        normal: &Vector3<f64>,
        gap_m: f64,
    ) -> ContactPlane {
        // A rotated unit vector keeps its length.
        let normal = Unit::new_unchecked(self.geometry().direction_world_grid * normal);
        ContactPlane::hard(sphere_index, self.geometry().point_to_world(point), normal, gap_m)
    }

    /// Converts candidates to planes, nearest first; `cells` caches the smoothed surface for the same sphere.
    #[inline(always)]
    pub(super) fn cluster(
        &self,
        sphere: &Sphere,
        out: &mut ContactBuffer,
        cells: Option<&mut RememberedCells>,
    ) {
        let Sphere { index: sphere_index, centre, radius_m, .. } = *sphere;
        let mut look = LookAt { voxels: self, sphere, tent: self.tent_sizes(radius_m), cells };
        let mut found = [Surface::NONE; MAX_PLANES];
        let mut count = 0;
        out.candidates.save();
        for (most, apart_cosine) in [(MOST_FAR_PLANES, FAR_APART_COSINE), (MAX_PLANES, NEAR_APART_COSINE)] {
            if count > 0 {
                out.candidates.bring_back();
                for Surface { direction, normal, .. } in &found[..count] {
                    out.candidates.drop_near([direction, normal], apart_cosine);
                }
            }
            for _ in 0..2 * most {
                if count == most {
                    break;
                }
                let Some(surface) = out.candidates.nearest_surface(&mut look) else { break };
                let Surface { direction, normal, distance_m } = surface;
                if (most == MAX_PLANES || count >= FAR_PLANES) && distance_m > radius_m + NEAR_GAP_M {
                    break;
                }
                out.candidates.drop_near([&direction, &normal], apart_cosine);
                if found[..count].iter().all(|other| other.normal.dot(&normal) <= apart_cosine) {
                    found[count] = surface;
                    count += 1;
                }
            }
        }
        let found = &mut found[..count];
        found.sort_unstable_by(|a, b| a.distance_m.total_cmp(&b.distance_m));
        for Surface { normal, distance_m, .. } in found {
            let point = centre - *normal * *distance_m;
            out.push(self.world_plane(sphere_index, &point, normal, *distance_m - radius_m));
        }
    }

    /// Returns the normal of the smoothed surface at a point, or `direction` if it is not trusted, and the
    /// point's protrusion from that surface.
    #[inline(always)]
    fn smoothed(
        &self,
        point: &Vector3<f64>,
        direction: &Vector3<f64>,
        tent: &TentSizes,
        remembered: Option<&mut RememberedCells>,
    ) -> (Vector3<f64>, f64) {
        let sample = self.sample_surface(point, tent, remembered);
        let steepness = sample.outward_per_m.norm();
        let smooth = sample.outward_per_m * (1.0 / steepness.max(1e-300));
        let cosine = smooth.dot(direction);
        if steepness > 0.0 && cosine > NORMAL_AGREEMENT_COSINE {
            let most = 0.5 * self.geometry().smallest_spacing_m();
            let t = ((cosine - NORMAL_AGREEMENT_COSINE) / NORMAL_AGREEMENT_COSINE).min(1.0);
            let trust = t * t * (3.0 - 2.0 * t);
            let mixed = smooth * trust + direction * (1.0 - trust);
            (mixed.normalize(), trust * ((0.5 - sample.level) / steepness).clamp(0.0, most))
        } else {
            (*direction, 0.0)
        }
    }
}

/// Finds the smoothed surface at a voxel. A trait instead of a closure, because a closure would be compiled
/// once, without the vector instructions of its caller.
pub(super) trait SurfaceSource {
    /// Returns the surface at a voxel, which is never closer than the voxel itself.
    fn surface(&mut self, seed: &Seed) -> Surface;
}

/// The smoothed surface as a sphere sees it; `cells` caches it for that sphere.
struct LookAt<'a> {
    voxels: &'a Voxels,
    sphere: &'a Sphere,
    tent: TentSizes,
    cells: Option<&'a mut RememberedCells>,
}

impl SurfaceSource for LookAt<'_> {
    #[inline(always)]
    fn surface(&mut self, seed: &Seed) -> Surface {
        let direction = seed.offset * (1.0 / seed.length2.sqrt());
        let distance_m = seed.distance2.sqrt();
        let (normal, stands_out_m) = match self.voxels.parameters().contact {
            ContactKind::Planes => {
                let point = self.sphere.centre - direction * distance_m;
                self.voxels.smoothed(&point, &direction, &self.tent, self.cells.as_deref_mut())
            }
            ContactKind::VoxelBalls => (direction, 0.0),
        };
        Surface { direction, normal, distance_m: distance_m + stands_out_m }
    }
}
