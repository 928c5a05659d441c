//! The contact planes of a sphere against the voxels.
//!
//! **Where the surface is.** A whole voxel is its box. A voxel of which the fraction f is left ends at the distance
//! `|c - x| - (f - 1/2) w` from the sphere's centre c, x being its centre and w its width along that direction: the box cut
//! by a plane that leaves the fraction f. The distance to a voxel is the larger of that and the distance to its box. So a
//! sphere on a flat wall of whole voxels has gap 0 exactly at the wall.
//!
//! **Staircases.** The corners of a slanted voxel wall stand out from the plane they approximate. The gap is widened by what
//! the nearest point stands out from the smoothed surface (see `surface.rs`), at most half a voxel; it is never narrowed.
//!
//! **Which planes.** A voxel can be nearest only if no neighbour lies between it and the centre, which word operations find;
//! one remains on a flat wall and a few dozen in a tunnel. The nearest of them gives the first plane, the nearest of those
//! more than 60 degrees away the second, and so on up to four.

use nalgebra::{Unit, Vector3};

use crate::contact_plane::ContactPlane;

use super::field::BoneField;
use super::grid::floor_to_i64;
use super::occupancy::{VoxelBox, WINDOW_VOXELS};

/// Most planes a sphere can get.
pub const MAX_PLANES: usize = 4;
/// Candidates kept a sphere; beyond it the farthest are dropped.
const MAX_CANDIDATES: usize = 96;
/// Voxels of a row examined at once: a window less one on either side for the neighbours along x.
const COLUMNS: i64 = WINDOW_VOXELS - 2;
/// Seeds nearer than this angle (its cosine) to a plane or its seed belong to that plane: 60 degrees.
const SAME_PLANE_COSINE: f64 = 0.5;
/// Planes whose smoothed normals are nearer than this (cosine, 37 degrees) are one.
const DUPLICATE_COSINE: f64 = 0.8;
/// A smoothed normal farther than this (cosine) from the seed's direction is not trusted: thin sheets, single voxels.
const NORMAL_AGREEMENT_COSINE: f64 = 0.3;

/// Contact planes of one tick and the query's working memory, reserved once.
#[derive(Debug, Clone)]
pub struct ContactBuffer {
    planes: Vec<ContactPlane>,
    capacity: usize,
    dropped: usize,
    candidates: Candidates,
}

impl ContactBuffer {
    /// Room for `capacity` planes.
    pub fn with_capacity(capacity: usize) -> Self {
        Self { planes: Vec::with_capacity(capacity), capacity, dropped: 0, candidates: Candidates::new() }
    }

    /// Empties the buffer for the next tick.
    pub fn clear(&mut self) {
        self.planes.clear();
        self.dropped = 0;
    }

    /// The planes found so far, in the order of the queries, nearest first within a sphere.
    pub fn planes(&self) -> &[ContactPlane] {
        &self.planes
    }

    /// Planes that found no room since the last [`Self::clear`].
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Adds a plane, or counts it as dropped when the buffer is full.
    pub fn push(&mut self, plane: ContactPlane) {
        if self.planes.len() < self.capacity {
            self.planes.push(plane);
        } else {
            self.dropped += 1;
        }
    }
}

/// A sphere in the grid's metric frame.
struct Sphere {
    centre: Vector3<f64>,
    /// The voxel that holds the centre, possibly outside the grid.
    voxel: [i64; 3],
    /// Radius plus margin in metres.
    reach: f64,
}

/// The columns of voxels that a window shows. Bit 0 of the window is the voxel before the first wanted one.
struct Columns {
    /// The wanted voxels before the centre's column; their neighbour towards the centre is the next one.
    before: u64,
    /// The centre's own column.
    own: u64,
    /// The wanted voxels behind it.
    behind: u64,
}

impl Columns {
    fn new(start: i64, count: i64, centre: i64) -> Self {
        let wanted = ((1u64 << count) - 1) << 1;
        let column = centre - (start - 1);
        let below = |bit: i64| if bit <= 0 { 0 } else { u64::MAX >> (64 - bit.min(64)) };
        Self {
            before: wanted & below(column),
            own: wanted & below(column + 1) & !below(column),
            behind: wanted & !below(column + 1),
        }
    }

    /// The wanted bone voxels without bone beside them towards the centre.
    #[inline]
    fn exposed(&self, row: u64) -> u64 {
        row & ((self.before & !(row >> 1)) | self.own | (self.behind & !(row << 1)))
    }
}

/// A voxel that may be nearest to the sphere. Squares, because few candidates need their root.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    /// From the voxel to the sphere's centre, grid frame, metres.
    offset: [f64; 3],
    /// Square of the offset's length.
    length2: f64,
    /// Square of the distance from the sphere's centre to the voxel's surface.
    distance2: f64,
}

/// Where a voxel ends, seen from a point.
#[derive(Clone, Copy)]
pub(super) struct VoxelSurface {
    /// From the point to the surface in metres.
    pub distance: f64,
    /// From the voxel's centre to the point.
    pub from_centre: Vector3<f64>,
    /// Whether the receded surface lies behind the box's own.
    pub cut: bool,
}

/// The candidates of one sphere, in memory reserved once.
#[derive(Debug, Clone)]
struct Candidates {
    items: Vec<Candidate>,
}

impl Candidates {
    fn new() -> Self {
        Self { items: Vec::with_capacity(MAX_CANDIDATES) }
    }

    fn push(&mut self, candidate: Candidate) {
        if self.items.len() < MAX_CANDIDATES {
            self.items.push(candidate);
            return;
        }
        let mut farthest = 0;
        for place in 1..self.items.len() {
            if self.items[place].distance2 > self.items[farthest].distance2 {
                farthest = place;
            }
        }
        if candidate.distance2 < self.items[farthest].distance2 {
            self.items[farthest] = candidate;
        }
    }

    /// Drops the candidates that lie within 60 degrees of either direction.
    fn drop_near(&mut self, first: &Vector3<f64>, second: &Vector3<f64>) {
        let limit = SAME_PLANE_COSINE * SAME_PLANE_COSINE;
        let mut kept = 0;
        for place in 0..self.items.len() {
            let candidate = self.items[place];
            let [x, y, z] = candidate.offset;
            let along_first = x * first.x + y * first.y + z * first.z;
            let along_second = x * second.x + y * second.y + z * second.z;
            let along = along_first.max(along_second);
            self.items[kept] = candidate;
            // Without a branch: half of them stay, unpredictably.
            kept += usize::from(along * along.abs() <= limit * candidate.length2);
        }
        self.items.truncate(kept);
    }

    fn nearest(&self) -> Option<Candidate> {
        let mut best = *self.items.first()?;
        for candidate in &self.items[1..] {
            if candidate.distance2 < best.distance2 {
                best = *candidate;
            }
        }
        Some(best)
    }
}

impl BoneField {
    /// Adds up to four planes that the sphere (world centre, radius) touches or is nearer to than `margin_m`. A sphere whose
    /// centre is inside bone gets the one plane that leads out. Nothing is added for values that are not finite or a radius
    /// that is not above 0.
    pub fn contact_planes(
        &self,
        sphere_index: usize,
        centre_world_m: &Vector3<f64>,
        radius_m: f64,
        margin_m: f64,
        out: &mut ContactBuffer,
    ) {
        let reach = radius_m + margin_m;
        let finite = reach.is_finite() && centre_world_m.iter().all(|x| x.is_finite());
        if !finite || radius_m <= 0.0 || margin_m < 0.0 {
            return;
        }
        let centre = self.geometry.point_to_grid(centre_world_m);
        let spacing = self.geometry.spacing_m;
        let Some(voxels) = self.occupancy.voxels_around(centre.into(), reach, spacing) else {
            return;
        };
        if !self.occupancy.any_in(&voxels) {
            return;
        }
        let centre_voxel = [0, 1, 2].map(|a| floor_to_i64(centre[a] / spacing[a] + 0.5));
        if self.is_mostly_solid(centre_voxel) {
            let (point, normal, gap_m) = self.way_out(&centre, centre_voxel, radius_m);
            out.push(self.world_plane(sphere_index, &point, &normal, gap_m));
            return;
        }
        out.candidates.items.clear();
        self.gather(&Sphere { centre, voxel: centre_voxel, reach }, &voxels, &mut out.candidates);
        self.cluster(sphere_index, &centre, radius_m, out);
    }

    /// Whether a voxel is bone and at least half of it is left.
    #[inline]
    pub(super) fn is_mostly_solid(&self, voxel: [i64; 3]) -> bool {
        self.occupancy.is_solid_at(voxel)
            && self.pool.spent(voxel[0] as usize, voxel[1] as usize, voxel[2] as usize) <= 0.5
    }

    fn world_plane(
        &self,
        sphere_index: usize,
        point: &Vector3<f64>,
        normal: &Vector3<f64>,
        gap_m: f64,
    ) -> ContactPlane {
        ContactPlane {
            sphere_index,
            point_m: self.geometry.point_to_world(point),
            normal: Unit::new_normalize(self.geometry.direction_world_grid * normal),
            gap_m,
        }
    }

    /// Collects the voxels within reach that have no neighbour between themselves and the centre.
    fn gather(&self, sphere: &Sphere, voxels: &VoxelBox, candidates: &mut Candidates) {
        let [_, hy, hz] = self.geometry.spacing_m;
        let [_, ny, nz] = self.geometry.dims;
        let (row_stride, slice_stride) = (self.occupancy.row_stride(), self.occupancy.slice_stride());
        let per_hy = 1.0 / hy;
        let reach2 = sphere.reach * sphere.reach;
        for start in (voxels.low[0]..=voxels.high[0]).step_by(COLUMNS as usize) {
            let count = (voxels.high[0] - start + 1).min(COLUMNS);
            let columns = Columns::new(start, count, sphere.voxel[0]);
            let place = self.occupancy.window_place(start - 1);
            for k in voxels.low[2]..=voxels.high[2] {
                let to_z = outside(sphere.centre.z - k as f64 * hz, hz);
                let room_z = reach2 - to_z * to_z;
                if room_z < 0.0 {
                    continue;
                }
                let half = room_z.sqrt();
                let low = floor_to_i64((sphere.centre.y - half) * per_hy + 0.5).max(voxels.low[1]);
                let high = floor_to_i64((sphere.centre.y + half) * per_hy + 0.5).min(voxels.high[1]);
                let (next_k, mask_z) = towards(k, sphere.voxel[2], nz);
                let (slice, next_slice) = (k as usize * slice_stride, next_k * slice_stride);
                for j in low..high + 1 {
                    let row = j as usize * row_stride;
                    let (next_j, mask_y) = towards(j, sphere.voxel[1], ny);
                    let own = self.occupancy.window_at(place, slice + row);
                    let above = self.occupancy.window_at(place, next_slice + row);
                    let beside = self.occupancy.window_at(place, slice + next_j * row_stride);
                    // Without branches up to here: which of the three empties a row is unpredictable.
                    let mut bits = columns.exposed(own) & !(above & mask_z) & !(beside & mask_y);
                    while bits != 0 {
                        let i = start - 1 + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let to_y = outside(sphere.centre.y - j as f64 * hy, hy);
                        self.admit(sphere, [i, j, k], [to_y, to_z], room_z, candidates);
                    }
                }
            }
        }
    }

    /// Adds a voxel to the candidates if its surface is within reach.
    #[inline]
    fn admit(
        &self,
        sphere: &Sphere,
        voxel: [i64; 3],
        to_box_yz: [f64; 2],
        room_z: f64,
        candidates: &mut Candidates,
    ) {
        let hx = self.geometry.spacing_m[0];
        let to_x = outside(sphere.centre.x - voxel[0] as f64 * hx, hx);
        if to_x * to_x + to_box_yz[0] * to_box_yz[0] >= room_z {
            return;
        }
        let spent = self.pool.spent(voxel[0] as usize, voxel[1] as usize, voxel[2] as usize);
        let box_distance2 = to_x * to_x + to_box_yz[0] * to_box_yz[0] + to_box_yz[1] * to_box_yz[1];
        if spent <= 0.0 && box_distance2 > 0.0 {
            let offset = [to_x, to_box_yz[0], to_box_yz[1]];
            candidates.push(Candidate { offset, length2: box_distance2, distance2: box_distance2 });
            return;
        }
        let to_box = [to_x, to_box_yz[0], to_box_yz[1]];
        let surface = self.voxel_surface(&sphere.centre, voxel, to_box, spent);
        if surface.distance >= sphere.reach {
            return;
        }
        let offset = if surface.cut {
            surface.from_centre
        } else if surface.distance > 0.0 {
            Vector3::from(to_box)
        } else {
            // The centre lies exactly on the voxel's boundary: out through the face it lies on.
            self.face_direction(&surface.from_centre)
        };
        let length2 = offset.norm_squared();
        // A voxel that is more than half cut and holds the centre at its middle has no direction to push in.
        if length2 > 0.0 {
            let distance2 = surface.distance * surface.distance;
            candidates.push(Candidate { offset: offset.into(), length2, distance2 });
        }
    }

    /// Unit vector along the axis on which an offset from a voxel's centre is largest in voxels.
    fn face_direction(&self, from_centre: &Vector3<f64>) -> Vector3<f64> {
        let in_voxels = [0, 1, 2].map(|a| (from_centre[a] / self.geometry.spacing_m[a]).abs());
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

    /// Where a voxel with the given spent fraction ends, seen from a point: see the module. `to_box` is the offset of the
    /// point from the voxel's box ([`outside`] along each axis).
    #[inline]
    pub(super) fn voxel_surface(
        &self,
        point: &Vector3<f64>,
        voxel: [i64; 3],
        to_box: [f64; 3],
        spent: f64,
    ) -> VoxelSurface {
        let box_distance = (to_box[0] * to_box[0] + to_box[1] * to_box[1] + to_box[2] * to_box[2]).sqrt();
        let [hx, hy, hz] = self.geometry.spacing_m;
        let from_centre =
            point - Vector3::new(voxel[0] as f64 * hx, voxel[1] as f64 * hy, voxel[2] as f64 * hz);
        if spent <= 0.0 {
            return VoxelSurface { distance: box_distance, from_centre, cut: false };
        }
        let length = from_centre.norm().max(1e-300);
        let cut_distance = length - (0.5 - spent) * self.width_along(&from_centre, length);
        let cut = cut_distance > box_distance;
        VoxelSurface { distance: if cut { cut_distance } else { box_distance }, from_centre, cut }
    }

    /// Width of a voxel along a direction of the given length.
    #[inline]
    pub(super) fn width_along(&self, direction: &Vector3<f64>, length: f64) -> f64 {
        let [hx, hy, hz] = self.geometry.spacing_m;
        (direction.x.abs() * hx + direction.y.abs() * hy + direction.z.abs() * hz) / length
    }

    /// Turns candidates into planes, nearest first.
    fn cluster(&self, sphere_index: usize, centre: &Vector3<f64>, radius_m: f64, out: &mut ContactBuffer) {
        let smallest = self.geometry.spacing_m.iter().fold(f64::INFINITY, |low, h| low.min(*h));
        let mut normals = [Vector3::zeros(); MAX_PLANES];
        let mut count = 0;
        // Each round drops at least its own seed; twice the planes bounds the rounds that end in a duplicate.
        for _ in 0..2 * MAX_PLANES {
            let Some(seed) = out.candidates.nearest() else { break };
            let direction = Vector3::from(seed.offset) / seed.length2.sqrt();
            let seed_distance = seed.distance2.sqrt();
            let point = centre - direction * seed_distance;
            let sample = self.sample_surface(&point, radius_m);
            let steepness = sample.outward_per_m.norm();
            let smooth = sample.outward_per_m / steepness.max(1e-300);
            let trusted = steepness > 0.0 && smooth.dot(&direction) > NORMAL_AGREEMENT_COSINE;
            let normal = if trusted { smooth } else { direction };
            let stands_out =
                if trusted { ((0.5 - sample.level) / steepness).clamp(0.0, 0.5 * smallest) } else { 0.0 };
            out.candidates.drop_near(&direction, &normal);
            if normals[..count].iter().any(|other| other.dot(&normal) > DUPLICATE_COSINE) {
                continue;
            }
            normals[count] = normal;
            count += 1;
            let distance = seed_distance + stands_out;
            let point = centre - normal * distance;
            out.push(self.world_plane(sphere_index, &point, &normal, distance - radius_m));
            if count == MAX_PLANES {
                break;
            }
        }
    }
}

/// Signed distance along one axis from a voxel's slab to a point whose offset from the slab's middle is `offset`; 0 inside.
#[inline]
pub(super) fn outside(offset: f64, width: f64) -> f64 {
    let half = 0.5 * width;
    if offset > half {
        offset - half
    } else if offset < -half {
        offset + half
    } else {
        0.0
    }
}

/// The index next to `from`, which is in `0..count`, towards `to`, and all ones; or `from` and 0 if there is no such index.
#[inline]
fn towards(from: i64, to: i64, count: usize) -> (usize, u64) {
    let next = (from + i64::from(to > from) - i64::from(to < from)).clamp(0, count as i64 - 1);
    (next as usize, if next == from { 0 } else { u64::MAX })
}
