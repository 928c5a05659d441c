//! Geometry of a frame: the slices to sum, the position of each intermediate-image pixel in each slice, and
//! its weights.
//!
//! The intermediate image lies in the plane of the farthest slice, aligned with it. Its sample with global
//! index i is at `i / oversampling` voxels there and, seen from the source s, at `x_k(i) = s (1 - r_k) + i
//! r_k / oversampling` voxels in slice k, where `r_k` is the ratio of the two depths. The step is constant,
//! so no ray needs its own arithmetic. (P. Lacroute and M. Levoy, "Fast volume rendering using a shear-warp
//! factorization", SIGGRAPH 1994, here with a point source.)
//!
//! Only the box of the voxels that attenuate counts: slices outside it are skipped, and images do not extend
//! beyond it.
//!
//! One image serves all rays and all slices if that box lies before the detector and no ray passes more than
//! four voxels per slice. Otherwise [`parts`](super::parts) splits the detector into rectangles; each has its
//! own axes, and an image for each range of depths, so that near slices are not sampled as densely as the
//! farthest requires.
//!
//! Positions are 32.32 fixed point. Along an image row, 16 samples share one such base; within the group they
//! are 5.27 fixed point. These integers define the weights, so every implementation of the sum gives the same
//! bits.

use super::before::DetectorClip;
use super::copies::CELL;
use super::footprint::visible_groups;
use super::occupied::OccupiedBox;
use crate::carm::PixelBox;
use crate::ray::RayFan;
use crate::vector::Vec3;

/// Samples of a row that share one 32.32 base.
pub(crate) const GROUP: usize = 16;
/// Minimum samples per voxel of the farthest slice. Below one, voxels there can fall between samples; in the
/// middle of the volume the samples are then about one voxel apart.
pub(crate) const LEAST_OVERSAMPLING: f64 = 0.8;
/// Maximum step between samples in a slice, 32.32 voxels.
const MAX_STEP: i64 = ONE + ONE / 4;
/// Voxels that a group can read beyond its first one: 16 steps, plus the neighbour.
pub(crate) const GROUP_REACH: i64 = (GROUP as i64 * MAX_STEP) / ONE + 1;
/// Maximum number of voxel lines that the rows of a tile read.
pub(crate) const MAX_LINES: usize = (TILE_ROWS as i64 * MAX_STEP / ONE) as usize + 2;
/// Rows of the intermediate image that are summed together.
pub(crate) const TILE_ROWS: usize = 8;
/// Bits of the weights along a row; a sample's two weights add up to exactly 2^14.
pub(crate) const WEIGHT_BITS: u32 = 14;
/// Bits of the fraction between two voxel rows.
pub(crate) const ROW_BITS: u32 = 15;
pub(crate) const FRACTION_MASK: u32 = (1 << WEIGHT_BITS) - 1;
/// Fraction bits of positions within a group.
pub(crate) const LANE_BITS: u32 = 27;
/// 2^32: one voxel.
const ONE: i64 = 1 << 32;
/// Maximum slope, in voxels per slice, of rays that share the only image of a frame.
const MAX_SLOPE: f64 = 4.0;
/// The same for a part of the detector. A ray's own best axis has a slope of at most 1; the rest is room for
/// its neighbours.
const MAX_PART_SLOPE: f64 = 2.0;
/// Minimum depth, in slices, that is summed: nearer slices would be magnified without bound.
const MIN_DEPTH: f64 = 1.0;
/// The same for a part of the detector: near slices have their own image, and positions are exact to 2^-20
/// voxel.
const MIN_PART_DEPTH: f64 = 1.0 / 64.0;
/// Maximum number of images per part of the detector.
const MAX_LAYERS: usize = 3;
/// Number of samples whose summation takes as long as reading one pixel (measured).
const SAMPLES_PER_PIXEL: f64 = 40.0;
/// The cost estimate samples every Nth slice.
const COST_STRIDE: usize = 16;
/// Samples around the detector's footprint and the volume: two for the warp, one for sharpening, two for
/// rounding.
pub(crate) const MARGIN: f64 = 5.0;
/// Maximum number of pixels of an intermediate image (1 GiB with its accumulators and floats).
pub(crate) const MAX_PIXELS: f64 = (1_u64 << 26) as f64;

/// The axes of a frame in index space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Axes {
    /// Across the slices.
    pub slow: usize,
    /// Along the image rows; the contiguous axis of the copies.
    pub u: usize,
    /// Along the image's columns.
    pub v: usize,
}

impl Axes {
    /// The axes for slices across this axis.
    pub fn of(slow: usize) -> Self {
        match slow {
            0 => Self { slow, u: 1, v: 2 },
            1 => Self { slow, u: 0, v: 2 },
            _ => Self { slow, u: 0, v: 1 },
        }
    }
}

/// One slice of the volume in the intermediate image's coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Slice {
    /// Its index along the slow axis.
    pub index: usize,
    /// Position of image pixel (0, 0), 32.32 voxels.
    pub start: [i64; 2],
    /// Step between pixels, equal along rows and columns, 32.32 voxels, at most [`MAX_STEP`].
    pub step: i64,
    /// Inverse of the step: pixels per 2^-32 voxel, rounded.
    pub samples_per_position: f64,
    /// Groups that can read an occupied voxel, half-open.
    pub groups: (usize, usize),
    /// Rows that can read an occupied voxel, half-open.
    pub rows: (usize, usize),
    /// Ratio of the image plane's depth to this slice's.
    pub inverse_ratio: f64,
    /// True if the detector's plane can cut the image's rays before this slice.
    pub meets_detector: bool,
}

/// Start of a group of 16 samples: whole voxels, and a 27-bit fraction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupStart {
    pub voxel: i64,
    pub fraction: u32,
}

impl Slice {
    /// Start of a group of samples.
    #[inline(always)]
    pub fn group(&self, group: usize) -> GroupStart {
        let position = self.start[0] + (group * GROUP) as i64 * self.step;
        GroupStart { voxel: position >> 32, fraction: position as u32 >> (32 - LANE_BITS) }
    }

    /// Step between neighbouring samples, 27 fraction bits.
    #[inline(always)]
    pub fn lane_step(&self) -> u32 {
        (self.step >> (32 - LANE_BITS)) as u32
    }

    /// Voxel and 15-bit fraction of an image row.
    #[inline(always)]
    pub fn row(&self, row: usize) -> (i64, i16) {
        let position = self.start[1] + row as i64 * self.step;
        (position >> 32, (position as u32 >> (32 - ROW_BITS)) as i16)
    }

    /// Voxels that a group can read beyond its first one: 15 steps from anywhere in that voxel, and the
    /// neighbour.
    #[inline(always)]
    pub fn reach(&self) -> i64 {
        (((GROUP as i64 - 1) * self.step) >> 32) + 2
    }

    /// The first of the groups `within` that starts at or after a voxel.
    #[inline(always)]
    pub fn first_group_from(&self, voxel: i64, within: (usize, usize)) -> usize {
        let stride = GROUP as i64 * self.step;
        let group = -((self.start[0] - voxel * ONE).div_euclid(stride));
        group.max(within.0 as i64).min(within.1 as i64) as usize
    }

    /// The cells of a row of `row_cells` that the groups `first..end` read, half-open.
    #[inline(always)]
    pub fn cells_read(&self, (first, end): (usize, usize), row_cells: usize) -> (usize, usize) {
        let cell = |voxel: i64| voxel.max(0) as usize / CELL;
        let last = self.group(end.saturating_sub(1)).voxel + self.reach();
        (cell(self.group(first).voxel), (cell(last) + 1).min(row_cells))
    }

    /// Voxel and 14-bit fraction of an image column.
    #[inline(always)]
    pub fn column(&self, column: usize) -> (i64, u32) {
        let start = self.group(column / GROUP);
        let lane = start.fraction + (column % GROUP) as u32 * self.lane_step();
        (start.voxel + i64::from(lane >> LANE_BITS), (lane >> (LANE_BITS - WEIGHT_BITS)) & FRACTION_MASK)
    }
}

/// The rays that share intermediate images: those to a rectangle of the detector.
#[derive(Clone, Copy)]
pub(crate) struct Rays<'a> {
    pub occupied: &'a OccupiedBox,
    pub fan: &'a RayFan,
    pub pixels: PixelBox,
    pub oversampling: f64,
}

/// All geometry of an intermediate image that the sum over slices needs.
#[derive(Debug, Clone)]
pub(crate) struct ImagePlan {
    pub axes: Axes,
    pub slices: Vec<Slice>,
    /// Global indices of the image's first sample and row.
    pub first: [i64; 2],
    /// Columns (a multiple of 16) and rows (a multiple of 8).
    pub columns: usize,
    pub rows: usize,
    pub oversampling: f64,
    /// Source in index coordinates.
    pub source: [f64; 3],
    /// Signed distance from the source to the image's plane along the slow axis, voxels.
    pub far: f64,
    /// For each eight rows, the groups that a pixel of the detector reads, half-open.
    pub visible: Vec<(usize, usize)>,
    /// The detector's plane, if part of the volume lies behind it.
    pub before: Option<DetectorClip>,
}

/// Range of slices across an axis that are summed into one image.
struct Range {
    axes: Axes,
    /// True if depth grows with the index.
    forward: bool,
    /// First and last index.
    ends: (usize, usize),
}

impl Range {
    /// All occupied slices.
    fn of(rays: &Rays<'_>, corners: &[Vec3; 4], axes: Axes) -> Self {
        let slices = rays.occupied.along(axes.slow);
        let ends = (slices.start, slices.end.max(slices.start + 1) - 1);
        Self { axes, forward: corners[0][axes.slow] > 0.0, ends }
    }

    fn last(&self) -> usize {
        if self.forward { self.ends.1 } else { self.ends.0 }
    }

    fn depth(&self, source: Vec3, k: usize) -> f64 {
        (k as f64 - source[self.axes.slow]) * if self.forward { 1.0 } else { -1.0 }
    }
}

impl ImagePlan {
    /// One image for all rays and slices. `None` if no axis suits all rays, or if the occupied box extends
    /// behind the detector's plane.
    pub fn whole(rays: &Rays<'_>) -> Option<Self> {
        let corners = rays.fan.corner_directions(&rays.pixels);
        let axes = best_axes(&corners, MAX_SLOPE)?;
        if !rays.fan.is_before_detector(&rays.occupied.corners()) {
            return None;
        }
        let mut range = Range::of(rays, &corners, axes);
        let (source, last) = (rays.fan.source_index(), range.last());
        let seen = rays.occupied.along(axes.slow).filter(|&k| range.depth(source, k) >= MIN_DEPTH);
        let Some(ends) = ends(seen) else { return Some(Self::empty(rays, axes, last)) };
        range.ends = ends;
        Self::of(rays, &range)
    }

    /// Images for the rays to a part of the detector, each for a range of slices; at least one, and as many
    /// as cost least. `None` if no axis suits all rays, or if an image would be too large: the part must be
    /// split.
    pub fn layers(rays: &Rays<'_>) -> Option<Vec<Self>> {
        let corners = rays.fan.corner_directions(&rays.pixels);
        let axes = best_axes(&corners, MAX_PART_SLOPE)?;
        let mut range = Range::of(rays, &corners, axes);
        let source = rays.fan.source_index();
        let is_met = |&k: &usize| is_met(rays.occupied, source, &corners, axes, range.depth(source, k));
        let seen = rays.occupied.along(axes.slow).filter(is_met);
        let Some((a, b)) = ends(seen) else { return Some(vec![Self::empty(rays, axes, range.last())]) };
        let mut best: Option<(f64, Vec<Self>)> = None;
        for layers in 1..=MAX_LAYERS {
            let start = |n: usize| a + n * (b + 1 - a) / layers;
            let mut plans = Vec::new();
            for n in (0..layers).filter(|&n| start(n) < start(n + 1)) {
                range.ends = (start(n), start(n + 1) - 1);
                plans.extend(Self::of(rays, &range));
            }
            let cost = plans.iter().map(|plan| plan.cost(&rays.pixels)).sum();
            if plans.len() == layers && best.as_ref().is_none_or(|(least, _)| cost < *least) {
                best = Some((cost, plans));
            }
        }
        best.map(|(_, plans)| plans)
    }

    /// Cost of summing the image and reading it at all pixels, in samples.
    pub fn cost(&self, pixels: &PixelBox) -> f64 {
        let side = |(first, end): (u32, u32)| f64::from(end - first);
        let mut samples = 0;
        // Neighbouring slices differ little.
        for slice in self.slices.iter().step_by(COST_STRIDE) {
            for row in (slice.rows.0..slice.rows.1).step_by(TILE_ROWS) {
                let (first, end) = self.summed_columns(slice, row);
                let (first, end) = (first.max(slice.groups.0 * GROUP), end.min(slice.groups.1 * GROUP));
                samples += end.saturating_sub(first) * TILE_ROWS * COST_STRIDE;
            }
        }
        samples as f64 + SAMPLES_PER_PIXEL * side(pixels.columns) * side(pixels.rows)
    }

    /// An empty image.
    pub fn nothing(rays: &Rays<'_>) -> Self {
        Self::empty(rays, Axes::of(2), 0)
    }

    fn empty(rays: &Rays<'_>, axes: Axes, last: usize) -> Self {
        let source = rays.fan.source_index();
        let far = last as f64 - source[axes.slow];
        Self {
            axes,
            slices: Vec::new(),
            first: [0; 2],
            columns: 0,
            rows: 0,
            oversampling: rays.oversampling,
            source,
            far,
            visible: Vec::new(),
            before: None,
        }
    }

    /// `None` if the image would be too large.
    fn of(rays: &Rays<'_>, range: &Range) -> Option<Self> {
        let Range { axes, ends: (a, b), .. } = *range;
        let (corners, occupied) = (rays.fan.corner_directions(&rays.pixels), rays.occupied);
        let (source, oversampling) = (rays.fan.source_index(), rays.oversampling);
        let far_depth = range.depth(source, range.last());
        let mut plan = Self::empty(rays, axes, range.last());
        let far = plan.far;
        let ratios = [a, b].map(|k| range.depth(source, k) / far_depth);
        let mut size = [0_usize; 2];
        let mut footprint = [[0.0; 2]; 4];
        for (m, axis) in [axes.u, axes.v].into_iter().enumerate() {
            let detector = corners.map(|d| (source[axis] + d[axis] * far / d[axes.slow]) * oversampling);
            let hull = |x: f64| ratios.map(|r| (source[axis] + (x - source[axis]) / r) * oversampling);
            let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
            let most = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let [first, end] = occupied.reach(axis);
            let low = least(&detector).max(least(&hull(first))) - MARGIN;
            let high = most(&detector).min(most(&hull(end))) + MARGIN;
            let unit = [GROUP, TILE_ROWS][m] as i64;
            if high < low || low.is_nan() || high.is_nan() {
                return Some(Self::empty(rays, axes, range.last()));
            }
            if high - low > MAX_PIXELS || low.abs() > 1e9 {
                return None;
            }
            // Aligned globally, so that part of the detector has the same samples as the whole.
            let (low, high) = (libm::floor(low) as i64, libm::ceil(high) as i64);
            plan.first[m] = low.div_euclid(unit) * unit;
            size[m] = ((high - plan.first[m]) / unit + 1) as usize * unit as usize;
            (0..4).for_each(|corner| footprint[corner][m] = detector[corner] - plan.first[m] as f64);
        }
        if size[0] as f64 * size[1] as f64 > MAX_PIXELS {
            return None;
        }
        [plan.columns, plan.rows] = size;
        plan.visible = visible_groups(footprint, size);
        let is_before = rays.fan.is_before_detector(&occupied.corners());
        plan.before = (!is_before).then(|| DetectorClip::new(rays.fan, &plan));
        plan.slices = (a..=b).map(|k| plan.slice(k, range.depth(source, k) / far_depth, occupied)).collect();
        Some(plan)
    }

    fn slice(&self, index: usize, ratio: f64, occupied: &OccupiedBox) -> Slice {
        let step = fixed(ratio / self.oversampling).min(MAX_STEP);
        let axes = [self.axes.u, self.axes.v];
        let start = [0, 1].map(|m| fixed(self.source[axes[m]] * (1.0 - ratio)) + self.first[m] * step);
        // A sample reads its voxel and the next one.
        let range = |m: usize, unit: i64, reach: i64, count: usize| {
            let (stride, along) = (unit * step, occupied.along(axes[m]));
            let low = ((along.start as i64 - reach) * ONE - start[m]).div_euclid(stride);
            let high = (along.end as i64 * ONE - 1 - start[m]).div_euclid(stride) + 1;
            let clamp = |x: i64| x.clamp(0, count as i64) as usize;
            (clamp(low), clamp(high))
        };
        let groups = range(0, GROUP as i64, GROUP_REACH, self.columns / GROUP);
        let rows = range(1, 1, 1, self.rows);
        let inverse_ratio = 1.0 / ratio;
        let mut slice = Slice {
            index,
            start,
            step,
            samples_per_position: 1.0 / step as f64,
            groups,
            rows,
            inverse_ratio,
            meets_detector: self
                .before
                .is_some_and(|b| b.cuts(inverse_ratio, (0, self.columns), (0, self.rows))),
        };
        // `div_euclid` rounds down: the first group or row can be just outside.
        let [u, v] = axes.map(|axis| occupied.along(axis).start as i64);
        while slice.groups.0 < slice.groups.1 && slice.group(slice.groups.0).voxel < u - GROUP_REACH {
            slice.groups.0 += 1;
        }
        while slice.rows.0 < slice.rows.1 && slice.row(slice.rows.0).0 < v - 1 {
            slice.rows.0 += 1;
        }
        slice
    }

    /// Pixels of the intermediate image.
    pub fn pixels(&self) -> usize {
        self.columns * self.rows
    }

    /// The columns of an image row that the detector sees, half-open.
    #[inline(always)]
    pub fn seen_columns(&self, row: usize) -> (usize, usize) {
        let (first, end) = self.visible.get(row / TILE_ROWS).copied().unwrap_or((0, 0));
        (first * GROUP, end * GROUP)
    }

    /// True if the detector's plane can cut the rays of a tile's rows before a slice.
    #[inline(always)]
    pub fn meets_detector(&self, slice: &Slice, first_row: usize) -> bool {
        let Some(before) = self.before.as_ref().filter(|_| slice.meets_detector) else { return false };
        before.cuts(slice.inverse_ratio, self.seen_columns(first_row), (first_row, first_row + TILE_ROWS))
    }

    /// The columns of an image row that are summed in a slice, half-open: those that the detector sees,
    /// before it.
    #[inline(always)]
    pub fn summed_columns(&self, slice: &Slice, row: usize) -> (usize, usize) {
        let seen = self.seen_columns(row);
        match &self.before {
            Some(before) if slice.meets_detector => before.columns(slice.inverse_ratio, row, seen),
            _ => seen,
        }
    }
}

/// The first and the last.
fn ends(mut of: impl Iterator<Item = usize>) -> Option<(usize, usize)> {
    let first = of.next()?;
    Some((first, of.last().unwrap_or(first)))
}

/// True if rays between the corners meet the occupied box at a depth, in slices, before the detector's plane.
fn is_met(occupied: &OccupiedBox, source: Vec3, corners: &[Vec3; 4], axes: Axes, depth: f64) -> bool {
    // At most five samples next to a ray are read, each at most 1.25 voxels from the next.
    const BESIDE: f64 = 8.0;
    let farthest = corners.iter().map(|d| d[axes.slow].abs()).fold(0.0, f64::max);
    let meets = |axis: usize| {
        let at = corners.map(|d| source[axis] + depth * d[axis] / d[axes.slow].abs());
        let least = at.into_iter().fold(f64::INFINITY, f64::min);
        let most = at.into_iter().fold(f64::NEG_INFINITY, f64::max);
        let [first, end] = occupied.reach(axis);
        least - BESIDE <= end && most + BESIDE >= first
    };
    (MIN_PART_DEPTH..=farthest).contains(&depth) && meets(axes.u) && meets(axes.v)
}

/// The axis with the smallest maximum slope over the detector, if all rays have the same sign along it and
/// none a larger slope than `limit`. Slopes are linear fractions of the pixel position, so their extremes are
/// at the corners.
fn best_axes(corners: &[Vec3; 4], limit: f64) -> Option<Axes> {
    let mut best: Option<(f64, Axes)> = None;
    for slow in 0..3 {
        let axes = Axes::of(slow);
        let forward = corners[0][slow] > 0.0;
        let mut worst = 0.0_f64;
        for d in corners {
            let along = if forward { d[slow] } else { -d[slow] };
            let slope = d[axes.u].abs().max(d[axes.v].abs()) / along;
            worst = if along > 0.0 && slope.is_finite() { worst.max(slope) } else { f64::INFINITY };
        }
        if worst <= limit && best.is_none_or(|(least, _)| worst < least) {
            best = Some((worst, axes));
        }
    }
    best.map(|(_, axes)| axes)
}

fn fixed(position: f64) -> i64 {
    libm::round(position * ONE as f64) as i64
}
