//! Finds the voxels that a burr can reach, once for a burr that moves little between ticks.
//!
//! A voxel matters to a tick of drilling if its surface lies within the burr's reach. The list holds the voxels whose boxes meet a
//! slightly wider reach ([`SLACK_VOXELS`]). While the burr stays within that slack of the search position, the list contains all voxels
//! that matter: bone never comes back in a tick. Distances are always recomputed, drilling updates the list's
//! spent fractions together with the field's, and the list follows grid order wherever the burr is. The results are therefore those of a
//! new search, bit for bit, and the list is not part of the state.

use nalgebra::Vector3;
use pulp::Arch;

use super::cutting::{BurrState, CuttingLaw};
use super::gather::outside;
use super::grid::{GridGeometry, VoxelIndex, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::parameters::BoneParameters;
use super::query::VoxelEnd;
use super::strength::Place;
use super::voxels::Voxels;

/// Extra reach of the cached search, in voxels of the smallest spacing. A burr fed at 1.5 mm/s through voxels of 0.5 mm needs a new
/// search every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;

/// Cutting radius of a burr, m: its own and the cutting law's reach.
fn cut_radius_m(radius_m: f64, cutting: &CuttingLaw) -> f64 {
    radius_m + cutting.reach_m
}

/// The inputs that determine how deep the burr is in a voxel and how much energy the voxel can absorb in a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Press {
    /// The burr's centre in the grid's metric frame.
    pub centre: Vector3<f64>,
    /// Cutting radius: the burr's radius plus the cutting law's reach, metres.
    pub cut_m: f64,
    /// Maximum recession of a surface in the tick, metres.
    pub recession_m: f64,
}

impl Press {
    /// The inputs of one burr and tick.
    pub fn new(voxels: &Voxels, burr: &BurrState, dt_s: f64) -> Self {
        let cutting = &voxels.parameters().cutting;
        Self {
            centre: voxels.geometry().point_to_grid(&burr.centre_m),
            cut_m: cut_radius_m(burr.radius_m, cutting),
            recession_m: cutting.feed_per_revolution_max_m * burr.speed_rad_s.abs() * dt_s
                / core::f64::consts::TAU,
        }
    }
}

/// Maximum number of voxels that a search about the largest burr can find: their boxes meet a ball.
pub(super) fn most_voxels(geometry: &GridGeometry, parameters: &BoneParameters) -> usize {
    let cut_m = cut_radius_m(parameters.max_burr_radius_m, &parameters.cutting);
    let searched_m = cut_m + geometry.smallest_spacing_m();
    cells_within(geometry, 1, searched_m, searched_m + diagonal_m(geometry, 1))
}

/// Maximum number of blocks of `edge` voxels in which one tick of the largest burr can cut: they meet a ball.
pub(super) fn most_blocks(geometry: &GridGeometry, parameters: &BoneParameters, edge: usize) -> usize {
    let cut_m = cut_radius_m(parameters.max_burr_radius_m, &parameters.cutting);
    cells_within(geometry, edge, cut_m, cut_m + diagonal_m(geometry, edge))
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
    /// The burr's centre and cutting radius at the search; `None` if the cache is empty.
    searched: Option<(Vector3<f64>, f64)>,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    pub index: Vec<VoxelIndex>,
    /// The same along each grid axis.
    pub at: Vec<[i64; 3]>,
    /// Where the pool stores each spent fraction, if anywhere, and the fraction.
    pub place: Vec<Place>,
    pub spent: Vec<f64>,
    /// Energy to cut the whole voxel, J.
    pub full_j: Vec<f64>,
    /// The burr's depth in each voxel in this tick, as a fraction of its width, and the voxel's capacity, J.
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
            at: Vec::with_capacity(capacity),
            place: Vec::with_capacity(capacity),
            spent: numbers(),
            full_j: numbers(),
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
        self.at.clear();
        self.place.clear();
        self.spent.clear();
        self.full_j.clear();
    }

    fn holds(&self, press: &Press, slack_m: f64) -> bool {
        self.searched.is_some_and(|(centre, cut_m)| {
            cut_m == press.cut_m && (press.centre - centre).norm_squared() <= slack_m * slack_m
        })
    }

    /// Computes all depths and capacities.
    fn measure(&mut self, arch: Arch, press: &Press, spacing: [f64; 3]) {
        let count = self.index.len();
        for list in [&mut self.depth, &mut self.room_j] {
            list.resize(count, 0.0);
        }
        arch.dispatch(Measure {
            press,
            spacing,
            position: self.position.each_ref().map(Vec::as_slice),
            spent: &self.spent,
            full_j: &self.full_j,
            out: [&mut self.depth, &mut self.room_j],
        });
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
}

/// The loop of [`ReachedVoxels::measure`], compiled for each instruction set. The instruction set changes no bit: each value is computed
/// on its own by operations that IEEE 754 rounds correctly.
struct Measure<'a> {
    press: &'a Press,
    spacing: [f64; 3],
    position: [&'a [f64]; 3],
    spent: &'a [f64],
    full_j: &'a [f64],
    out: [&'a mut [f64]; 2],
}

impl pulp::WithSimd for Measure<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let count = self.spent.len();
        let Press { centre, cut_m, recession_m } = *self.press;
        let [x, y, z] = self.position.map(|along| &along[..count]);
        let (spent, full_j) = (&self.spent[..count], &self.full_j[..count]);
        let [depth, room_j] = self.out.map(|list| &mut list[..count]);
        for voxel in 0..count {
            let from = [centre.x - x[voxel], centre.y - y[voxel], centre.z - z[voxel]];
            let end = VoxelEnd::seen(from, self.spacing, spent[voxel]);
            let box_distance = end.box2.sqrt();
            let distance = if end.cut_distance > box_distance { end.cut_distance } else { box_distance };
            // A burr centred on a voxel has the whole voxel in reach, whatever the direction.
            let per_width = 1.0 / if end.width > 0.0 { end.width } else { self.spacing[0] };
            let left = 1.0 - spent[voxel];
            let deep = (cut_m - distance) * per_width;
            let deep = if deep > 0.0 && left > 0.0 { deep } else { 0.0 };
            let deep = if deep < 1.0 { deep } else { 1.0 };
            // Limited by what is left and by what the teeth can remove.
            let advance = recession_m * per_width;
            let room = if deep < left { deep } else { left };
            let room = if room < advance { room } else { advance };
            depth[voxel] = deep;
            room_j[voxel] = room * full_j[voxel];
        }
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
    /// Updates the lists for this tick.
    pub fn bring(&mut self, voxels: &Voxels, arch: Arch, hu: &[i16], press: &Press) {
        let geometry = voxels.geometry();
        let slack_m = SLACK_VOXELS * geometry.smallest_spacing_m();
        if !self.holds(press, slack_m) {
            self.search(voxels, hu, press, slack_m);
            self.searched = Some((press.centre, press.cut_m));
        }
        self.measure(arch, press, geometry.spacing_m);
    }

    fn search(&mut self, voxels: &Voxels, hu: &[i16], press: &Press, slack_m: f64) {
        self.clear();
        let Press { centre, cut_m, .. } = press;
        let (occupancy, geometry) = (voxels.occupancy(), voxels.geometry());
        let spacing = geometry.spacing_m;
        // Widened by more than rounding can cause; each tick's own distances decide.
        let widest = cut_m + slack_m + 1e-6 * geometry.smallest_spacing_m();
        let Some(around) = occupancy.voxels_around((*centre).into(), widest, spacing) else { return };
        if !occupancy.any_in(&around) {
            return;
        }
        let VoxelBox { low, high } = around;
        for k in low[2]..=high[2] {
            let to_z = outside(centre.z - k as f64 * spacing[2], spacing[2]);
            for j in low[1]..=high[1] {
                let to_y = outside(centre.y - j as f64 * spacing[1], spacing[1]);
                let room = widest * widest - to_z * to_z - to_y * to_y;
                for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
                    let count = (high[0] - start + 1).min(WINDOW_VOXELS);
                    let window = occupancy.window(occupancy.window_place(start), j as usize, k as usize);
                    let mut bits =
                        window & ((1u64 << count) - 1) & columns_within(centre.x, room, spacing[0], start);
                    while bits != 0 {
                        self.push(voxels, hu, [start + i64::from(bits.trailing_zeros()), j, k]);
                        bits &= bits - 1;
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
        self.at.push(voxel);
        let place = voxels.pool().place(inside);
        self.place.push(place);
        self.spent.push(voxels.pool().spent_at(place));
        self.full_j.push(voxels.full_energy_j(hu[index.at()]));
    }
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
