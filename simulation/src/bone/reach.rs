//! Which voxels a burr can reach, found once for a burr that moves little between ticks.
//!
//! A voxel matters to a tick of drilling if its surface lies within the burr's reach, or if it is a sliver that the burr has
//! left behind (see [`super::drilling`]). The list holds the voxels of both kinds about a burr whose reach is a little wider
//! ([`SLACK_VOXELS`]). As long as the burr stays within that slack of where it was searched, the list contains all that count:
//! bone never comes back in a tick, and what is out of reach and no sliver yet cannot become one. Distances
//! are always taken afresh, drilling keeps the list's spent fractions as it keeps the field's, and the order is that of the grid
//! whatever the burr's place, so the results are those of a fresh search bit for bit, and the list is no part of the state.

use nalgebra::Vector3;
use pulp::Arch;

use super::drilling::{CuttingLaw, voxels_in_cube};
use super::field::BoneField;
use super::gather::outside;
use super::grid::{GridGeometry, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::query::VoxelEnd;

/// How much wider the remembered reach is, in voxels of the smallest spacing. A burr fed at 1.5 mm/s in voxels of 0.5 mm is
/// searched every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;

/// The radii about a burr's centre that decide which voxels count, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reach {
    /// Where a voxel's surface is cut: the burr's radius plus the law's reach.
    pub cut_m: f64,
    /// Beyond this a surface has been left behind.
    pub left_m: f64,
    /// Voxels whose centres are farther are not looked at.
    pub outer_m: f64,
}

impl Reach {
    /// Of a burr of the given radius.
    pub fn of_burr(radius_m: f64, geometry: &GridGeometry, cutting: &CuttingLaw) -> Self {
        let [hx, hy, hz] = geometry.spacing_m;
        let cut_m = radius_m + cutting.reach_m;
        let left_m = cut_m + cutting.reach_m;
        // A sliver's centre is at most half a diagonal inside its receded surface.
        let outer_m = left_m + 0.5 * (hx * hx + hy * hy + hz * hz).sqrt();
        Self { cut_m, left_m, outer_m }
    }
}

/// What of a tick decides how deep a burr is in a voxel and what it can take there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Press {
    /// The burr's centre in the grid's metric frame.
    pub centre: Vector3<f64>,
    pub reach: Reach,
    /// Farthest that a surface recedes in the tick, metres.
    pub recession_m: f64,
}

/// The voxels in reach, in the order of the grid, x fastest; numbers side by side, for loops without branches.
#[derive(Debug, Clone, Default)]
pub(super) struct ReachedVoxels {
    /// The burr's centre and reach at the search. `None`: nothing is remembered.
    searched: Option<(Vector3<f64>, Reach)>,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    /// Linear indices.
    pub index: Vec<u32>,
    /// Where each one's spent fraction is kept, if anywhere, and the fraction.
    pub place: Vec<usize>,
    pub spent: Vec<f64>,
    /// Energy that the whole voxel takes, J.
    pub full_j: Vec<f64>,
    /// Of this tick: distances from the burr's centre to the surfaces, m; how deep the burr is in each, as a fraction of its width;
    /// what it can take, J.
    pub surface: Vec<f64>,
    pub depth: Vec<f64>,
    pub room_j: Vec<f64>,
    /// Room for all lists.
    capacity: usize,
}

impl ReachedVoxels {
    /// Room for every voxel that a search about the largest burr can find, reserved here.
    pub fn new(geometry: &GridGeometry, max_burr_radius_m: f64, cutting: &CuttingLaw) -> Self {
        let reach = Reach::of_burr(max_burr_radius_m, geometry, cutting);
        let capacity = voxels_in_cube(geometry, reach.outer_m + geometry.smallest_spacing_m());
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

    /// Voxels that can be in the lists.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// For any change of the bone but drilling.
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

    /// Surfaces, depths and rooms of all; whether there may be slivers among them.
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

    /// Takes the energy of a level from all that have depth.
    pub fn spend(&mut self, arch: Arch, level_j: f64) -> &Self {
        let [depth, room_j, full_j] = [&self.depth, &self.room_j, &self.full_j];
        arch.dispatch(Spend { level_j, depth, room_j, full_j, spent: &mut self.spent });
        self
    }

    /// Whether the burr has left a voxel behind of which less than `sliver_fraction` remains.
    pub fn is_sliver(&self, voxel: usize, press: &Press, sliver_fraction: f64) -> bool {
        let offset = [0, 1, 2].map(|axis| press.centre[axis] - self.position[axis][voxel]);
        is_sliver(self.spent[voxel], self.surface[voxel], offset, &press.reach, sliver_fraction)
    }
}

#[inline(always)]
fn is_sliver(spent: f64, surface: f64, [dx, dy, dz]: [f64; 3], reach: &Reach, sliver_fraction: f64) -> bool {
    let left = 1.0 - spent;
    let near = dx * dx <= reach.outer_m * reach.outer_m - dz * dz - dy * dy;
    (spent > 0.0) & (left > 0.0) & (left < sliver_fraction) & (surface > reach.left_m) & near
}

/// The loop of [`ReachedVoxels::measure`], compiled for each instruction set. None of them changes a bit: each number is worked out for
/// itself, by operations that IEEE 754 rounds correctly.
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
            // A burr centred on a voxel has all of it in reach, whatever the direction.
            let per_width = 1.0 / if end.width > 0.0 { end.width } else { self.spacing[0] };
            let left = 1.0 - spent[voxel];
            let deep = (reach.cut_m - distance) * per_width;
            let deep = if deep > 0.0 && left > 0.0 { deep } else { 0.0 };
            let deep = if deep < 1.0 { deep } else { 1.0 };
            // Not more than there is, and than the teeth take.
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

impl BoneField {
    /// Brings `reached` to this tick; returns whether there may be slivers in it.
    pub(super) fn reach(&mut self, hu: &[i16], press: &Press) -> bool {
        let (centre, reach) = (&press.centre, &press.reach);
        let slack_m = SLACK_VOXELS * self.geometry.smallest_spacing_m();
        if !self.reached.holds(centre, reach, slack_m) {
            let mut reached = core::mem::take(&mut self.reached);
            self.search_reach(hu, centre, reach, slack_m, &mut reached);
            reached.searched = Some((*centre, *reach));
            self.reached = reached;
        }
        let sliver_fraction = self.parameters.cutting.sliver_fraction;
        self.reached.measure(self.arch, press, self.geometry.spacing_m, sliver_fraction)
    }

    fn search_reach(
        &self,
        hu: &[i16],
        centre: &Vector3<f64>,
        reach: &Reach,
        slack_m: f64,
        reached: &mut ReachedVoxels,
    ) {
        reached.clear();
        let spacing = self.geometry.spacing_m;
        // Wider by what rounding can take: each tick's own distances decide.
        let rounding_m = 1e-6 * self.geometry.smallest_spacing_m();
        let outer = reach.outer_m + slack_m + rounding_m;
        let widest = reach.cut_m + slack_m + rounding_m;
        let Some(voxels) = self.occupancy.voxels_around((*centre).into(), outer, spacing) else { return };
        if !self.occupancy.any_in(&voxels) {
            return;
        }
        let VoxelBox { low, high } = voxels;
        for k in low[2]..=high[2] {
            let dz = centre.z - k as f64 * spacing[2];
            for j in low[1]..=high[1] {
                let dy = centre.y - j as f64 * spacing[1];
                let room = outer * outer - dz * dz - dy * dy;
                if room < 0.0 {
                    continue;
                }
                // Bone takes part if its box is in reach; behind it only slivers do, which are cut in part.
                let (to_y, to_z) = (outside(dy, spacing[1]), outside(dz, spacing[2]));
                let inner = widest * widest - to_z * to_z - to_y * to_y;
                for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
                    let count = (high[0] - start + 1).min(WINDOW_VOXELS);
                    let window = self.occupancy.window_place(start);
                    let mut bits =
                        self.occupancy.window(window, j as usize, k as usize) & ((1u64 << count) - 1);
                    if bits == 0 {
                        continue;
                    }
                    let within = columns_within(centre.x, inner, spacing[0], start);
                    if bits & !within != 0 {
                        bits &= within | self.pool.partial_bits(start, count, j as usize, k as usize);
                    }
                    while bits != 0 {
                        let i = start + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let dx = centre.x - i as f64 * spacing[0];
                        let cut = within >> (i - start) & 1 == 1;
                        if dx * dx <= room && (cut || self.may_be_sliver([i, j, k])) {
                            self.push_reached(hu, [i, j, k], reached);
                        }
                    }
                }
            }
        }
    }

    /// Whether so little is left of a voxel of the grid that it falls off when the burr has left it behind.
    fn may_be_sliver(&self, voxel: [i64; 3]) -> bool {
        let [i, j, k] = voxel.map(|x| x as usize);
        1.0 - self.pool.spent(i, j, k) < self.parameters.cutting.sliver_fraction
    }

    fn push_reached(&self, hu: &[i16], voxel: [i64; 3], reached: &mut ReachedVoxels) {
        let inside = voxel.map(|x| x as usize);
        let index = self.geometry.linear_index(inside[0], inside[1], inside[2]);
        for (along, position) in reached.position.iter_mut().zip(self.voxel_position(voxel)) {
            along.push(position);
        }
        reached.index.push(index as u32);
        let place = self.pool.place(inside);
        reached.place.push(place);
        reached.spent.push(self.pool.spent_at(place));
        reached
            .full_j
            .push(self.cutting_table.specific_energy_j_m3(hu[index]) * self.geometry.voxel_volume_m3());
    }
}

/// The voxels of a window that starts at `start` whose slabs along x are within the root of `distance2` of `x`, as bits.
#[inline]
fn columns_within(x: f64, distance2: f64, spacing: f64, start: i64) -> u64 {
    if distance2 <= 0.0 {
        return 0;
    }
    let distance = distance2.sqrt();
    let first = (floor_to_i64((x - distance) / spacing + 0.5) - start).clamp(0, 63);
    let end = (floor_to_i64((x + distance) / spacing + 0.5) + 1 - start).clamp(first, 63);
    (1u64 << end) - (1u64 << first)
}
