//! Which voxels a burr can reach, found once for a burr that moves little between ticks.
//!
//! A voxel matters to a tick of drilling if its surface lies within the burr's reach, or if it is a sliver that the burr has
//! left behind (see [`super::drilling`]). The list holds the voxels of both kinds about a burr whose reach is a little wider
//! ([`SLACK_VOXELS`]). As long as the burr stays within that slack of where it was searched, the list contains all that count:
//! bone never comes back in a tick, and what is out of reach and no sliver yet cannot become one. Distances and spent fractions
//! are always taken afresh, and the order is that of the grid whatever the burr's place, so the results are those of a fresh
//! search bit for bit, and the list is no part of the state.

use nalgebra::Vector3;

use super::drilling::{CuttingLaw, voxels_in_cube};
use super::field::BoneField;
use super::gather::outside;
use super::grid::{GridGeometry, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};

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

/// The voxels in reach, in the order of the grid, x fastest; numbers side by side, for loops without branches.
#[derive(Debug, Clone, Default)]
pub(super) struct ReachedVoxels {
    /// The burr's centre and reach at the search. `None`: nothing is remembered.
    searched: Option<(Vector3<f64>, Reach)>,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    /// Linear indices.
    pub index: Vec<u32>,
    /// Where each one's spent fraction is kept, if anywhere.
    pub place: Vec<usize>,
    /// Energy that the whole voxel takes, J.
    pub full_j: Vec<f64>,
    /// Of this tick: spent fractions, distances from the burr's centre to the surfaces, widths seen from there.
    pub spent: Vec<f64>,
    pub surface: Vec<f64>,
    pub width: Vec<f64>,
    /// Of this tick: those that are cut or are slivers, by place in the lists.
    pub kept: Vec<u32>,
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
            full_j: numbers(),
            spent: numbers(),
            surface: numbers(),
            width: numbers(),
            kept: Vec::with_capacity(capacity),
        }
    }

    /// For any change of the bone but drilling.
    pub fn forget(&mut self) {
        self.searched = None;
    }

    fn clear(&mut self) {
        self.position.iter_mut().for_each(Vec::clear);
        self.index.clear();
        self.place.clear();
        self.full_j.clear();
    }

    fn holds(&self, centre: &Vector3<f64>, reach: &Reach, slack_m: f64) -> bool {
        self.searched.is_some_and(|(searched, searched_reach)| {
            searched_reach == *reach && (centre - searched).norm_squared() <= slack_m * slack_m
        })
    }

    /// Distances, widths, and which voxels are kept.
    fn measure(&mut self, centre: &Vector3<f64>, spacing: [f64; 3], reach: &Reach, sliver_fraction: f64) {
        let count = self.index.len();
        self.surface.resize(count, 0.0);
        self.width.resize(count, 0.0);
        self.kept.resize(count, 0);
        let [x, y, z] = [0, 1, 2].map(|axis| &self.position[axis][..count]);
        let spent = &self.spent[..count];
        let (surface, width) = (&mut self.surface[..count], &mut self.width[..count]);
        let [hx, hy, hz] = spacing;
        for voxel in 0..count {
            let (dx, dy, dz) = (centre.x - x[voxel], centre.y - y[voxel], centre.z - z[voxel]);
            let (to_x, to_y, to_z) = (outside(dx, hx), outside(dy, hy), outside(dz, hz));
            let box_distance = (to_x * to_x + to_y * to_y + to_z * to_z).sqrt();
            let length = (dx * dx + dy * dy + dz * dz).sqrt();
            let divisor = if length > 1e-300 { length } else { 1e-300 };
            let along = (dx.abs() * hx + dy.abs() * hy + dz.abs() * hz) / divisor;
            let cut_distance = divisor - (0.5 - spent[voxel]) * along;
            // A whole voxel is its box.
            let cut_distance = if spent[voxel] > 0.0 { cut_distance } else { 0.0 };
            surface[voxel] = if cut_distance > box_distance { cut_distance } else { box_distance };
            // A burr centred on a voxel has all of it in reach, whatever the direction.
            width[voxel] = if length > 0.0 { along } else { hx };
        }
        let outer2 = reach.outer_m * reach.outer_m;
        let mut kept = 0;
        for voxel in 0..count {
            let (dx, dy, dz) = (centre.x - x[voxel], centre.y - y[voxel], centre.z - z[voxel]);
            let left = 1.0 - spent[voxel];
            let near = dx * dx <= outer2 - dz * dz - dy * dy;
            let sliver =
                (spent[voxel] > 0.0) & (left < sliver_fraction) & (surface[voxel] > reach.left_m) & near;
            self.kept[kept] = voxel as u32;
            kept += usize::from((left > 0.0) & ((surface[voxel] < reach.cut_m) | sliver));
        }
        self.kept.truncate(kept);
    }
}

impl BoneField {
    /// Brings `reached` to this tick: the voxels that are cut, and the slivers.
    pub(super) fn reach(&mut self, hu: &[i16], centre: &Vector3<f64>, reach: &Reach) {
        let spacing = self.geometry.spacing_m;
        let slack_m = SLACK_VOXELS * self.geometry.smallest_spacing_m();
        let mut reached = core::mem::take(&mut self.reached);
        if !reached.holds(centre, reach, slack_m) {
            self.search_reach(hu, centre, reach, slack_m, &mut reached);
            reached.searched = Some((*centre, *reach));
        }
        reached.spent.clear();
        reached.spent.extend(reached.place.iter().map(|place| self.pool.spent_at(*place)));
        reached.measure(centre, spacing, reach, self.parameters.cutting.sliver_fraction);
        self.reached = reached;
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
        reached.place.push(self.pool.place(inside));
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
