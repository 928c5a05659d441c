//! Finds the voxels that a burr can reach, once for a burr that moves little between ticks.
//!
//! A voxel matters to a tick of drilling if its surface lies within the burr's reach, or if it is a sliver that the burr has left behind
//! (see [`super::drilling`]). The list holds the voxels of both kinds about a burr with a slightly wider reach ([`SLACK_VOXELS`]). While
//! the burr stays within that slack of the search position, the list contains all voxels that matter: bone never comes back in a tick,
//! and a voxel that is out of reach and no sliver yet cannot become one. Distances are always recomputed, drilling updates the list's
//! spent fractions together with the field's, and the list follows grid order wherever the burr is. The results are therefore those of a
//! new search, bit for bit, and the list is not part of the state.

use nalgebra::Vector3;
use pulp::Arch;

use super::cutting::{BurrState, CuttingLaw};
use super::gather::{outside, widening};
use super::grid::{GridGeometry, VoxelIndex, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::parameters::BoneParameters;
use super::query::VoxelEnd;
use super::strength::Place;
use super::voxels::{Ball, Voxels};

/// Extra reach of the cached search, in voxels of the smallest spacing. A burr fed at 1.5 mm/s through voxels of 0.5 mm needs a new
/// search every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;

/// The radii about a burr's centre that decide which voxels count, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reach {
    /// Cutting radius: the burr's radius plus the cutting law's reach.
    pub cut_m: f64,
    /// A surface beyond this has been left behind.
    pub left_m: f64,
    /// Voxels with centres beyond this are ignored.
    pub outer_m: f64,
}

impl Reach {
    /// The radii for a burr of the given radius.
    pub fn of_burr(radius_m: f64, geometry: &GridGeometry, cutting: &CuttingLaw) -> Self {
        let [hx, hy, hz] = geometry.spacing_m;
        let cut_m = radius_m + cutting.reach_m;
        let left_m = cut_m + cutting.reach_m;
        // A sliver's centre is at most half a diagonal inside its receded surface.
        let outer_m = left_m + 0.5 * (hx * hx + hy * hy + hz * hz).sqrt();
        Self { cut_m, left_m, outer_m }
    }
}

/// The inputs that determine how deep the burr is in a voxel and how much energy the voxel can absorb in a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Press {
    /// The burr's centre in the grid's metric frame.
    pub centre: Vector3<f64>,
    pub reach: Reach,
    /// Maximum recession of a surface in the tick, metres.
    pub recession_m: f64,
}

impl Press {
    /// The inputs of one burr and tick.
    pub fn new(voxels: &Voxels, burr: &BurrState, dt_s: f64) -> Self {
        let cutting = &voxels.parameters().cutting;
        Self {
            centre: voxels.geometry().point_to_grid(&burr.centre_m),
            reach: Reach::of_burr(burr.radius_m, voxels.geometry(), cutting),
            recession_m: cutting.feed_per_revolution_max_m * burr.speed_rad_s.abs() * dt_s
                / core::f64::consts::TAU,
        }
    }

    /// The ball in which the burr cuts: a surface in reach belongs to a box in reach.
    pub fn cut_ball(&self, geometry: &GridGeometry) -> Ball {
        Ball { centre_m: self.centre, radius_m: self.reach.cut_m + widening(geometry.spacing_m) }
    }
}

/// Maximum number of voxels that a search about the largest burr can find: their centres lie in a ball.
pub(super) fn most_voxels(geometry: &GridGeometry, parameters: &BoneParameters) -> usize {
    let reach = Reach::of_burr(parameters.max_burr_radius_m, geometry, &parameters.cutting);
    let searched_m = reach.outer_m + geometry.smallest_spacing_m();
    cells_within(geometry, 1, searched_m, searched_m + 0.5 * diagonal_m(geometry, 1))
}

/// Maximum number of blocks of `edge` voxels in which one tick of the largest burr can cut: they meet a ball.
pub(super) fn most_blocks(geometry: &GridGeometry, parameters: &BoneParameters, edge: usize) -> usize {
    let reach = Reach::of_burr(parameters.max_burr_radius_m, geometry, &parameters.cutting);
    cells_within(geometry, edge, reach.outer_m, reach.outer_m + diagonal_m(geometry, edge))
}

/// Diagonal of a cell of `edge` voxels along each axis, m.
fn diagonal_m(geometry: &GridGeometry, edge: usize) -> f64 {
    let [hx, hy, hz] = geometry.spacing_m;
    edge as f64 * (hx * hx + hy * hy + hz * hz).sqrt()
}

/// Maximum number of cells of `edge` voxels per axis, which do not overlap, that meet a cube of half edge `cube_m` and lie in a ball of
/// radius `ball_m`.
fn cells_within(geometry: &GridGeometry, edge: usize, cube_m: f64, ball_m: f64) -> usize {
    let in_cube = (0..3).fold(1usize, |count, axis| {
        let along = (2.0 * cube_m / (edge as f64 * geometry.spacing_m[axis])) as usize + 2;
        count.saturating_mul(along.min(geometry.dims[axis].div_ceil(edge)))
    });
    let ball_m3 = core::f64::consts::PI * (4.0 / 3.0) * ball_m * ball_m * ball_m;
    let cell_m3 = geometry.voxel_volume_m3() * (edge * edge * edge) as f64;
    in_cube.min((ball_m3 / cell_m3) as usize + 1)
}

/// The voxels in reach, in grid order, x fastest, stored as arrays for branch-free SIMD loops.
#[derive(Debug)]
pub(super) struct ReachedVoxels {
    /// The burr's centre and reach at the search; `None` if the cache is empty.
    searched: Option<(Vector3<f64>, Reach)>,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    pub index: Vec<VoxelIndex>,
    /// Where the pool stores each spent fraction, if anywhere, and the fraction.
    pub place: Vec<Place>,
    pub spent: Vec<f64>,
    /// Energy to cut the whole voxel, J.
    pub full_j: Vec<f64>,
    /// This tick's distances from the burr's centre to the surfaces, m; the burr's depth in each voxel as a fraction of its width; the
    /// voxel's capacity, J.
    pub surface: Vec<f64>,
    pub depth: Vec<f64>,
    pub room_j: Vec<f64>,
    /// Capacity of all lists.
    capacity: usize,
}

impl ReachedVoxels {
    /// Reserves room for every voxel that a search about the largest burr can find.
    pub fn new(geometry: &GridGeometry, parameters: &BoneParameters) -> Self {
        let capacity = most_voxels(geometry, parameters);
        let numbers = || Vec::with_capacity(capacity);
        Self {
            searched: None,
            position: [numbers(), numbers(), numbers()],
            index: Vec::with_capacity(capacity),
            place: Vec::with_capacity(capacity),
            spent: numbers(),
            full_j: numbers(),
            surface: numbers(),
            depth: numbers(),
            room_j: numbers(),
            capacity,
        }
    }

    /// Maximum length of the lists.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Empties the cache; call after any bone change other than drilling.
    pub fn forget(&mut self) {
        self.searched = None;
    }

    fn clear(&mut self) {
        self.position.iter_mut().for_each(Vec::clear);
        self.index.clear();
        self.place.clear();
        self.spent.clear();
        self.full_j.clear();
    }

    fn holds(&self, centre: &Vector3<f64>, reach: &Reach, slack_m: f64) -> bool {
        self.searched.is_some_and(|(searched, searched_reach)| {
            searched_reach == *reach && (centre - searched).norm_squared() <= slack_m * slack_m
        })
    }

    /// Computes all surfaces, depths and capacities; returns true if there may be slivers among them.
    fn measure(&mut self, arch: Arch, press: &Press, spacing: [f64; 3], sliver_fraction: f64) -> bool {
        let count = self.index.len();
        for list in [&mut self.surface, &mut self.depth, &mut self.room_j] {
            list.resize(count, 0.0);
        }
        arch.dispatch(Measure {
            press,
            spacing,
            sliver_fraction,
            position: self.position.each_ref().map(Vec::as_slice),
            spent: &self.spent,
            full_j: &self.full_j,
            out: [&mut self.surface, &mut self.depth, &mut self.room_j],
        })
    }

    /// Subtracts the energy of a level from all voxels with positive depth.
    pub fn spend(&mut self, arch: Arch, level_j: f64) -> &Self {
        let [depth, room_j, full_j] = [&self.depth, &self.room_j, &self.full_j];
        arch.dispatch(Spend { level_j, depth, room_j, full_j, spent: &mut self.spent });
        self
    }

    /// From a voxel's centre to a point in the grid's metric frame, m.
    pub fn offset(&self, voxel: usize, to: &Vector3<f64>) -> Vector3<f64> {
        Vector3::from([0, 1, 2].map(|axis| to[axis] - self.position[axis][voxel]))
    }

    /// True if the burr has left the voxel behind and less than `sliver_fraction` of it remains.
    pub fn is_sliver(&self, voxel: usize, press: &Press, sliver_fraction: f64) -> bool {
        let offset = self.offset(voxel, &press.centre).into();
        is_sliver(self.spent[voxel], self.surface[voxel], offset, &press.reach, sliver_fraction)
    }
}

#[inline(always)]
fn is_sliver(spent: f64, surface: f64, [dx, dy, dz]: [f64; 3], reach: &Reach, sliver_fraction: f64) -> bool {
    let left = 1.0 - spent;
    let near = dx * dx <= reach.outer_m * reach.outer_m - dz * dz - dy * dy;
    (spent > 0.0) & (left > 0.0) & (left < sliver_fraction) & (surface > reach.left_m) & near
}

/// The loop of [`ReachedVoxels::measure`], compiled for each instruction set. The instruction set changes no bit: each value is computed
/// on its own by operations that IEEE 754 rounds correctly.
struct Measure<'a> {
    press: &'a Press,
    spacing: [f64; 3],
    sliver_fraction: f64,
    position: [&'a [f64]; 3],
    spent: &'a [f64],
    full_j: &'a [f64],
    out: [&'a mut [f64]; 3],
}

impl pulp::WithSimd for Measure<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> bool {
        let count = self.spent.len();
        let Press { centre, reach, recession_m } = *self.press;
        let [x, y, z] = self.position.map(|along| &along[..count]);
        let (spent, full_j) = (&self.spent[..count], &self.full_j[..count]);
        let [surface, depth, room_j] = self.out.map(|list| &mut list[..count]);
        let mut slivers = 0_u64;
        for voxel in 0..count {
            let from = [centre.x - x[voxel], centre.y - y[voxel], centre.z - z[voxel]];
            let end = VoxelEnd::seen(from, self.spacing, spent[voxel]);
            let box_distance = end.box2.sqrt();
            let distance = if end.cut_distance > box_distance { end.cut_distance } else { box_distance };
            // A burr centred on a voxel has the whole voxel in reach, whatever the direction.
            let per_width = 1.0 / if end.width > 0.0 { end.width } else { self.spacing[0] };
            let left = 1.0 - spent[voxel];
            let deep = (reach.cut_m - distance) * per_width;
            let deep = if deep > 0.0 && left > 0.0 { deep } else { 0.0 };
            let deep = if deep < 1.0 { deep } else { 1.0 };
            // Limited by what is left and by what the teeth can remove.
            let advance = recession_m * per_width;
            let room = if deep < left { deep } else { left };
            let room = if room < advance { room } else { advance };
            surface[voxel] = distance;
            depth[voxel] = deep;
            room_j[voxel] = room * full_j[voxel];
            slivers |= u64::from(is_sliver(spent[voxel], distance, from, &reach, self.sliver_fraction));
        }
        slivers != 0
    }
}

/// The loop of [`ReachedVoxels::spend`].
struct Spend<'a> {
    level_j: f64,
    depth: &'a [f64],
    room_j: &'a [f64],
    full_j: &'a [f64],
    spent: &'a mut [f64],
}

impl pulp::WithSimd for Spend<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let takes = self.depth.iter().zip(self.room_j).zip(self.full_j);
        for (spent, ((depth, room_j), full_j)) in self.spent.iter_mut().zip(takes) {
            let offered = self.level_j * depth;
            let given = if offered < *room_j { offered } else { *room_j };
            let given = if *depth > 0.0 { given } else { 0.0 };
            let sum = *spent + given / full_j;
            *spent = if sum < 1.0 { sum } else { 1.0 };
        }
    }
}

impl ReachedVoxels {
    /// Updates the lists for this tick; returns true if there may be slivers in them.
    pub fn bring(&mut self, voxels: &Voxels, arch: Arch, hu: &[i16], press: &Press) -> bool {
        let (centre, reach) = (&press.centre, &press.reach);
        let geometry = voxels.geometry();
        let slack_m = SLACK_VOXELS * geometry.smallest_spacing_m();
        if !self.holds(centre, reach, slack_m) {
            self.search(voxels, hu, press, slack_m);
            self.searched = Some((*centre, *reach));
        }
        self.measure(arch, press, geometry.spacing_m, voxels.parameters().cutting.sliver_fraction)
    }

    fn search(&mut self, voxels: &Voxels, hu: &[i16], press: &Press, slack_m: f64) {
        self.clear();
        let Press { centre, reach, .. } = press;
        let (occupancy, geometry) = (voxels.occupancy(), voxels.geometry());
        let spacing = geometry.spacing_m;
        // Widened by more than rounding can cause; each tick's own distances decide.
        let rounding_m = 1e-6 * geometry.smallest_spacing_m();
        let outer = reach.outer_m + slack_m + rounding_m;
        let widest = reach.cut_m + slack_m + rounding_m;
        let Some(around) = occupancy.voxels_around((*centre).into(), outer, spacing) else { return };
        if !occupancy.any_in(&around) {
            return;
        }
        let VoxelBox { low, high } = around;
        for k in low[2]..=high[2] {
            let dz = centre.z - k as f64 * spacing[2];
            for j in low[1]..=high[1] {
                let dy = centre.y - j as f64 * spacing[1];
                let room = outer * outer - dz * dz - dy * dy;
                if room < 0.0 {
                    continue;
                }
                // Bone takes part if its box is in reach; farther out only slivers do, which are partly cut.
                let (to_y, to_z) = (outside(dy, spacing[1]), outside(dz, spacing[2]));
                let inner = widest * widest - to_z * to_z - to_y * to_y;
                for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
                    let count = (high[0] - start + 1).min(WINDOW_VOXELS);
                    let window = occupancy.window_place(start);
                    let mut bits = occupancy.window(window, j as usize, k as usize) & ((1u64 << count) - 1);
                    if bits == 0 {
                        continue;
                    }
                    let within = columns_within(centre.x, inner, spacing[0], start);
                    if bits & !within != 0 {
                        bits &= within | voxels.pool().partial_bits(start, count, j as usize, k as usize);
                    }
                    while bits != 0 {
                        let i = start + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let dx = centre.x - i as f64 * spacing[0];
                        let cut = within >> (i - start) & 1 == 1;
                        if dx * dx <= room && (cut || may_be_sliver(voxels, [i, j, k])) {
                            self.push(voxels, hu, [i, j, k]);
                        }
                    }
                }
            }
        }
    }

    fn push(&mut self, voxels: &Voxels, hu: &[i16], voxel: [i64; 3]) {
        let inside = voxel.map(|x| x as usize);
        let index = voxels.geometry().index(inside);
        for (along, position) in self.position.iter_mut().zip(voxels.geometry().voxel_position(voxel)) {
            along.push(position);
        }
        self.index.push(index);
        let place = voxels.pool().place(inside);
        self.place.push(place);
        self.spent.push(voxels.pool().spent_at(place));
        self.full_j.push(voxels.full_energy_j(hu[index.at()]));
    }
}

/// True if so little of the voxel is left that it falls off once the burr has left it behind.
fn may_be_sliver(voxels: &Voxels, voxel: [i64; 3]) -> bool {
    let [i, j, k] = voxel.map(|x| x as usize);
    1.0 - voxels.pool().spent(i, j, k) < voxels.parameters().cutting.sliver_fraction
}

/// The voxels of a window starting at `start` whose slabs along x are within sqrt(`distance2`) of `x`, as bits.
#[inline]
pub(super) fn columns_within(x: f64, distance2: f64, spacing: f64, start: i64) -> u64 {
    if distance2 <= 0.0 {
        return 0;
    }
    let distance = distance2.sqrt();
    let first = (floor_to_i64((x - distance) / spacing + 0.5) - start).clamp(0, 63);
    let end = (floor_to_i64((x + distance) / spacing + 0.5) + 1 - start).clamp(first, 63);
    (1u64 << end) - (1u64 << first)
}
