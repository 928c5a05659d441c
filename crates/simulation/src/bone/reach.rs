//! Finds the voxels that a burr can reach, with a cache for a burr that moves little between ticks. A burr is
//! a ball or a row of balls; a voxel belongs to the ball that is deepest in it, so that no voxel counts
//! twice.
//!
//! A voxel matters to a tick of drilling if its surface lies within the burr's reach. The list holds the
//! voxels whose boxes overlap a slightly wider reach ([`SLACK_VOXELS`]). While the burr stays within that
//! slack of the search position, the list contains all voxels that matter, because a tick never restores
//! bone. Distances are always recomputed, drilling updates the list's spent fractions together with the
//! field's, and the list is in grid order regardless of the burr's position. The results are therefore those
//! of a new search, bit for bit, and the list is not part of the state.

use nalgebra::Vector3;
use pulp::Arch;
use scene::MAX_CUTTER_BALLS;

use super::cutting::{Ball, CuttingLaw, TickLoads};
use super::gather::outside;
use super::grid::{GridGeometry, VoxelIndex, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::parameters::BoneParameters;
use super::query::VoxelEnd;
use super::strength::PoolIndex;
use super::voxels::Voxels;

/// Extra reach of the cached search, in voxels of the smallest spacing. A burr fed at 1.5 mm/s through 0.5 mm
/// voxels needs a new search every 33 ticks.
const SLACK_VOXELS: f64 = 0.1;

/// Number of values compared at a time.
const LANES: usize = 8;

/// Returns the cutting radius of a burr, m: its radius plus the cutting law's reach.
fn cut_radius_m(radius_m: f64, cutting: &CuttingLaw) -> f64 {
    radius_m + cutting.reach_m
}

/// A ball of the burr in a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct PressedBall {
    /// Its centre in the grid's metric frame.
    pub centre: Vector3<f64>,
    /// Its radius, metres.
    pub radius_m: f64,
    /// Cutting radius: the ball's radius plus the cutting law's reach, metres.
    pub cut_m: f64,
}

/// The inputs that determine the burr's depth in a voxel and the energy that the voxel can absorb in a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct BurrPress<'b> {
    /// The burr's balls, from front to back.
    pub balls: &'b [PressedBall],
    /// Maximum recession of a surface in the tick, metres.
    pub recession_m: f64,
}

impl<'b> BurrPress<'b> {
    /// Creates the inputs of one burr and tick; stores the balls in `into`.
    pub fn new(voxels: &Voxels, work: &TickLoads, dt_s: f64, into: &'b mut Vec<PressedBall>) -> Self {
        let cutting = &voxels.parameters().cutting;
        let pressed = |ball: &Ball| PressedBall {
            centre: voxels.geometry().point_to_grid(&ball.centre_m),
            radius_m: ball.radius_m,
            cut_m: cut_radius_m(ball.radius_m, cutting),
        };
        into.clear();
        into.push(pressed(&work.burr.ball()));
        into.extend(work.behind.iter().map(pressed));
        Self { balls: into, recession_m: cutting.most_recession_m(work.burr.speed_rad_s, dt_s) }
    }
}

/// Returns the maximum number of voxels that a search around the largest burr can find: their boxes overlap a
/// capsule.
pub(super) fn most_voxels(geometry: &GridGeometry, parameters: &BoneParameters) -> usize {
    let cut_m = cut_radius_m(parameters.max_burr_radius_m, &parameters.cutting);
    let searched_m = cut_m + geometry.smallest_spacing_m();
    let span_m = parameters.cutter_span_m;
    cells_within(geometry, 1, (searched_m, searched_m + diagonal_m(geometry, 1)), span_m)
}

/// Returns the maximum number of blocks of `edge` voxels in which one tick of the largest burr can cut: they
/// overlap a capsule.
pub(super) fn most_blocks(geometry: &GridGeometry, parameters: &BoneParameters, edge: usize) -> usize {
    let cut_m = cut_radius_m(parameters.max_burr_radius_m, &parameters.cutting);
    cells_within(geometry, edge, (cut_m, cut_m + diagonal_m(geometry, edge)), parameters.cutter_span_m)
}

/// Returns the diagonal of a cell of `edge` voxels along each axis, m.
fn diagonal_m(geometry: &GridGeometry, edge: usize) -> f64 {
    let [hx, hy, hz] = geometry.spacing_m;
    edge as f64 * (hx * hx + hy * hy + hz * hz).sqrt()
}

/// Returns the maximum number of cells of `edge` voxels per axis, which do not overlap each other, that
/// overlap the bounding box of a capsule of radius `box_m` and lie in one of radius `capsule_m`; the centres
/// of its ends are `span_m` apart, in any direction.
fn cells_within(geometry: &GridGeometry, edge: usize, (box_m, capsule_m): (f64, f64), span_m: f64) -> usize {
    let in_box = (0..3).fold(1usize, |count, axis| {
        let along = ((2.0 * box_m + span_m) / (edge as f64 * geometry.spacing_m[axis])) as usize + 2;
        count.saturating_mul(along.min(geometry.dims[axis].div_ceil(edge)))
    });
    let pi = core::f64::consts::PI;
    let capsule_m3 =
        pi * (4.0 / 3.0) * capsule_m * capsule_m * capsule_m + pi * capsule_m * capsule_m * span_m;
    let cell_m3 = geometry.voxel_volume_m3() * (edge * edge * edge) as f64;
    in_box.min((capsule_m3 / cell_m3) as usize + 1)
}

/// The voxels in reach, in grid order, x fastest, stored as arrays for branch-free SIMD loops.
#[derive(Debug)]
pub(super) struct ReachedVoxels {
    /// The burr's balls at the time of the search; empty if the cache is empty.
    searched: Vec<PressedBall>,
    /// Centres along each grid axis, metres.
    position: [Vec<f64>; 3],
    /// Bounding box of all voxels in reach.
    pub around: VoxelBox,
    pub index: Vec<VoxelIndex>,
    /// The voxels' positions along each grid axis.
    pub at: Vec<[i64; 3]>,
    /// The place of each spent fraction in the pool, if any, and the fraction.
    pub place: Vec<PoolIndex>,
    pub spent: Vec<f64>,
    /// Energy to cut the whole voxel, J.
    pub full_j: Vec<f64>,
    /// The burr's depth in each voxel in this tick, as a fraction of its width, the voxel's capacity, J, and
    /// its width toward the burr, m.
    pub depth: Vec<f64>,
    pub room_j: Vec<f64>,
    width_m: Vec<f64>,
    /// The deepest ball in each voxel; empty for a burr of one ball.
    deepest: Vec<u8>,
    /// Depths, capacities and widths for one ball of several.
    of_ball: [Vec<f64>; 3],
    /// Capacity of all lists.
    capacity: usize,
}

impl ReachedVoxels {
    /// Reserves room for every voxel that a search around the largest burr can find.
    pub fn new(geometry: &GridGeometry, parameters: &BoneParameters) -> Self {
        let capacity = most_voxels(geometry, parameters);
        let numbers = || Vec::with_capacity(capacity);
        let for_several = if parameters.cutter_span_m > 0.0 { capacity } else { 0 };
        let others = || Vec::with_capacity(for_several);
        Self {
            searched: Vec::with_capacity(MAX_CUTTER_BALLS),
            position: [numbers(), numbers(), numbers()],
            around: VoxelBox::NOTHING,
            index: Vec::with_capacity(capacity),
            at: Vec::with_capacity(capacity),
            place: Vec::with_capacity(capacity),
            spent: numbers(),
            full_j: numbers(),
            depth: numbers(),
            room_j: numbers(),
            width_m: numbers(),
            deepest: Vec::with_capacity(for_several),
            of_ball: [others(), others(), others()],
            capacity,
        }
    }

    /// Returns the maximum length of the lists.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Empties the cache; call after any bone change other than drilling.
    pub fn forget(&mut self) {
        self.searched.clear();
    }

    fn clear(&mut self) {
        self.position.iter_mut().for_each(Vec::clear);
        self.around = VoxelBox::NOTHING;
        self.index.clear();
        self.at.clear();
        self.place.clear();
        self.spent.clear();
        self.full_j.clear();
    }

    fn holds(&self, press: &BurrPress, slack_m: f64) -> bool {
        let near = |(searched, ball): (&PressedBall, &PressedBall)| {
            searched.cut_m == ball.cut_m
                && (ball.centre - searched.centre).norm_squared() <= slack_m * slack_m
        };
        self.searched.len() == press.balls.len() && self.searched.iter().zip(press.balls).all(near)
    }

    /// Computes all depths and capacities, for each voxel with the ball that is deepest in it.
    fn measure(&mut self, arch: Arch, press: &BurrPress, spacing: [f64; 3]) {
        let count = self.index.len();
        let [of_depth, of_room_j, of_width_m] = &mut self.of_ball;
        self.deepest.clear();
        for (number, ball) in press.balls.iter().enumerate() {
            let mut out = match number {
                0 => [&mut self.depth, &mut self.room_j, &mut self.width_m],
                _ => [&mut *of_depth, &mut *of_room_j, &mut *of_width_m],
            };
            out.iter_mut().for_each(|list| list.resize(count, 0.0));
            arch.dispatch(Measure {
                ball,
                recession_m: press.recession_m,
                spacing,
                position: self.position.each_ref().map(Vec::as_slice),
                spent: &self.spent,
                full_j: &self.full_j,
                out: out.map(Vec::as_mut_slice),
            });
            if number == 0 {
                continue;
            }
            self.deepest.resize(count, 0);
            for voxel in 0..count {
                if of_depth[voxel] > self.depth[voxel] {
                    self.depth[voxel] = of_depth[voxel];
                    self.room_j[voxel] = of_room_j[voxel];
                    self.width_m[voxel] = of_width_m[voxel];
                    self.deepest[voxel] = number as u8;
                }
            }
        }
    }

    /// Returns the ball that is deepest in a voxel.
    pub fn ball_in<'b>(&self, voxel: usize, press: &BurrPress<'b>) -> &'b PressedBall {
        let number = self.deepest.get(voxel).copied().unwrap_or(0);
        &press.balls[usize::from(number)]
    }

    /// Subtracts the energy of a level from all voxels with positive depth.
    pub fn spend(&mut self, arch: Arch, level_j: f64) {
        let [depth, room_j, full_j] = [&self.depth, &self.room_j, &self.full_j];
        arch.dispatch(Spend { level_j, depth, room_j, full_j, spent: &mut self.spent });
    }

    /// Returns the maximum recession of a surface per joule and unit of depth, m/J.
    pub fn most_recession_m_per_j(&self, arch: Arch) -> f64 {
        let count = self.depth.len();
        let [width_m, full_j] = [&self.width_m[..count], &self.full_j[..count]];
        arch.dispatch(MostRecession { depth: &self.depth, width_m, full_j })
    }

    /// Returns the vector from a voxel's centre to a point in the grid's metric frame, m.
    pub fn offset(&self, voxel: usize, to: &Vector3<f64>) -> Vector3<f64> {
        Vector3::from([0, 1, 2].map(|axis| to[axis] - self.position[axis][voxel]))
    }
}

/// The loop of [`ReachedVoxels::measure`], compiled for each instruction set. The instruction set changes no
/// bit: each value is computed separately by operations that IEEE 754 rounds correctly.
struct Measure<'a> {
    ball: &'a PressedBall,
    recession_m: f64,
    spacing: [f64; 3],
    position: [&'a [f64]; 3],
    spent: &'a [f64],
    full_j: &'a [f64],
    out: [&'a mut [f64]; 3],
}

impl pulp::WithSimd for Measure<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let count = self.spent.len();
        let PressedBall { centre, cut_m, .. } = *self.ball;
        let recession_m = self.recession_m;
        let [x, y, z] = self.position.map(|along| &along[..count]);
        let (spent, full_j) = (&self.spent[..count], &self.full_j[..count]);
        let [depth, room_j, width_m] = self.out.map(|list| &mut list[..count]);
        for voxel in 0..count {
            let from = [centre.x - x[voxel], centre.y - y[voxel], centre.z - z[voxel]];
            let end = VoxelEnd::seen(from, self.spacing, spent[voxel]);
            let box_distance = end.box2.sqrt();
            let distance = if end.cut_distance > box_distance { end.cut_distance } else { box_distance };
            // A burr centred on a voxel reaches the whole voxel in any direction.
            let per_width = 1.0 / if end.width > 0.0 { end.width } else { self.spacing[0] };
            let left = 1.0 - spent[voxel];
            let deep = (cut_m - distance) * per_width;
            let deep = if deep > 0.0 && left > 0.0 { deep } else { 0.0 };
            let deep = if deep < 1.0 { deep } else { 1.0 };
            // Limited by the remaining fraction and by what the teeth can remove.
            let advance = recession_m * per_width;
            let room = if deep < left { deep } else { left };
            let room = if room < advance { room } else { advance };
            depth[voxel] = deep;
            room_j[voxel] = room * full_j[voxel];
            width_m[voxel] = end.width;
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

/// The loop of [`ReachedVoxels::most_recession_m_per_j`].
struct MostRecession<'a> {
    depth: &'a [f64],
    width_m: &'a [f64],
    full_j: &'a [f64],
}

impl pulp::WithSimd for MostRecession<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> f64 {
        let [(depth, rest), (width_m, rest_m), (full_j, rest_j)] =
            [self.depth, self.width_m, self.full_j].map(<[f64]>::as_chunks::<LANES>);
        let mut most = [0.0; LANES];
        for ((depth, width_m), full_j) in depth.iter().zip(width_m).zip(full_j) {
            for lane in 0..LANES {
                let recession = depth[lane] * width_m[lane] / full_j[lane];
                most[lane] = if recession > most[lane] { recession } else { most[lane] };
            }
        }
        let ends = rest.iter().zip(rest_m).zip(rest_j);
        let of_ends = ends.map(|((depth, width_m), full_j)| depth * width_m / full_j);
        most.into_iter().chain(of_ends).fold(0.0, f64::max)
    }
}

impl ReachedVoxels {
    /// Updates the lists for this tick.
    pub fn bring(&mut self, voxels: &Voxels, arch: Arch, hu: &[i16], press: &BurrPress) {
        let geometry = voxels.geometry();
        let slack_m = SLACK_VOXELS * geometry.smallest_spacing_m();
        if !self.holds(press, slack_m) {
            self.search(voxels, hu, press, slack_m);
            self.searched.clear();
            self.searched.extend_from_slice(press.balls);
        }
        self.measure(arch, press, geometry.spacing_m);
    }

    fn search(&mut self, voxels: &Voxels, hu: &[i16], press: &BurrPress, slack_m: f64) {
        self.clear();
        let (occupancy, geometry) = (voxels.occupancy(), voxels.geometry());
        let spacing = geometry.spacing_m;
        // Widened by more than rounding can cause; the distances of each tick decide.
        let widest_m = |ball: &PressedBall| ball.cut_m + slack_m + 1e-6 * geometry.smallest_spacing_m();
        let boxes = press
            .balls
            .iter()
            .filter_map(|ball| occupancy.voxels_around(ball.centre.into(), widest_m(ball), spacing));
        let Some(around) = boxes.reduce(|a, b| a.hull(&b)) else { return };
        if !occupancy.any_in(&around) {
            return;
        }
        let VoxelBox { low, high } = around;
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
                    let count = (high[0] - start + 1).min(WINDOW_VOXELS);
                    let window = occupancy.window(occupancy.window_place(start), j as usize, k as usize);
                    let within = |ball: &PressedBall| {
                        let to_z = outside(ball.centre.z - k as f64 * spacing[2], spacing[2]);
                        let to_y = outside(ball.centre.y - j as f64 * spacing[1], spacing[1]);
                        let room = widest_m(ball) * widest_m(ball) - to_z * to_z - to_y * to_y;
                        columns_within(ball.centre.x, room, spacing[0], start)
                    };
                    let near = press.balls.iter().fold(0, |near, ball| near | within(ball));
                    let mut bits = window & ((1u64 << count) - 1) & near;
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
        self.around = self.around.with(voxel);
        self.index.push(index);
        self.at.push(voxel);
        let place = voxels.pool().place(inside);
        self.place.push(place);
        self.spent.push(voxels.pool().spent_at(place));
        self.full_j.push(voxels.full_energy_j(hu[index.at()]));
    }
}

/// Returns the voxels of a window starting at `start` whose slabs along x are within sqrt(`distance2`) of
/// `x`, as bits.
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
