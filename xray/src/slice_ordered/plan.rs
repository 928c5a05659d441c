//! Geometry of a frame: the slices to sum, the position of each intermediate-image pixel in each slice, and its weights.
//!
//! The intermediate image lies in the plane of the farthest slice, aligned with it. Its sample with global index i is at `i /
//! oversampling` voxels there and, seen from the source s, at `x_k(i) = s (1 - r_k) + i r_k / oversampling` voxels in slice k, where
//! `r_k` is the ratio of the two depths. The step is constant, so no ray needs its own arithmetic. (P. Lacroute and M. Levoy, "Fast
//! volume rendering using a shear-warp factorization", SIGGRAPH 1994, here with a point source.)
//!
//! Positions are 32.32 fixed point. Along an image row, 16 samples share one such base; within the group they are 5.27 fixed point. These
//! integers define the weights, so every implementation of the sum gives the same bits.

use crate::grid::Grid;
use crate::ray::RayFan;

/// Samples of a row that share one 32.32 base.
pub(crate) const GROUP: usize = 16;
/// Minimum samples per voxel of the farthest slice. Below one, voxels there may fall between samples; in the middle of the volume the
/// samples are then about one voxel apart.
pub(crate) const LEAST_OVERSAMPLING: f64 = 0.8;
/// Maximum step between samples in a slice, 32.32 voxels.
const MAX_STEP: i64 = ONE + ONE / 4;
/// Voxels that a group may read beyond its first one: 16 steps, plus the neighbour.
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
/// Maximum slope, in voxels per slice, for summing by slices.
const MAX_SLOPE: f64 = 4.0;
/// Minimum depth, in slices, that is summed: nearer slices would be magnified without bound.
const MIN_DEPTH: f64 = 1.0;
/// Samples around the detector's footprint and the volume: two for the warp, one for sharpening, two for rounding.
const MARGIN: f64 = 5.0;
/// Maximum number of pixels of an intermediate image (1 GiB with its accumulators and floats).
const MAX_PIXELS: f64 = (1_u64 << 26) as f64;

/// The axes of a frame in index space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Axes {
    /// Across the slices.
    pub slow: usize,
    /// Along the image rows; the contiguous axis of the copy being read.
    pub u: usize,
    /// Along the image's columns.
    pub v: usize,
}

impl Axes {
    fn of(slow: usize) -> Self {
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
    /// Groups that can intersect the volume, half-open.
    pub groups: (usize, usize),
    /// Rows that can intersect the volume, half-open.
    pub rows: (usize, usize),
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

    /// The groups that read one of the voxels `first..end` of a row, half-open.
    #[inline(always)]
    pub fn groups_reading(&self, first: i64, end: i64) -> (usize, usize) {
        let stride = GROUP as i64 * self.step;
        // The first group that starts at or after a voxel.
        let from = |voxel: i64| -((self.start[0] - voxel * ONE).div_euclid(stride));
        let clamp = |group: i64| group.clamp(self.groups.0 as i64, self.groups.1 as i64) as usize;
        (clamp(from(first - GROUP_REACH)), clamp(from(end)))
    }

    /// Voxel and 14-bit fraction of an image column.
    #[inline(always)]
    pub fn column(&self, column: usize) -> (i64, u32) {
        let start = self.group(column / GROUP);
        let lane = start.fraction + (column % GROUP) as u32 * self.lane_step();
        (start.voxel + i64::from(lane >> LANE_BITS), (lane >> (LANE_BITS - WEIGHT_BITS)) & FRACTION_MASK)
    }
}

/// All frame geometry that the sum over slices needs.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
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
}

impl Plan {
    /// Plans a frame. `None` if no axis suits all rays, or if the volume extends behind the detector plane: such frames are traced ray by
    /// ray.
    pub fn new(grid: &Grid, fan: &RayFan, pixels: [u32; 2], oversampling: f64) -> Option<Self> {
        let corners = fan.corner_directions(pixels);
        let dims = grid.dims();
        let source = fan.source_index();
        let axes = best_axes(&corners)?;
        if !fan.is_before_detector(dims) {
            return None;
        }
        let forward = corners[0][axes.slow] > 0.0;
        let depth = |k: usize| (k as f64 - source[axes.slow]) * if forward { 1.0 } else { -1.0 };
        let last = if forward { dims[axes.slow] - 1 } else { 0 };
        let far_depth = depth(last);
        let seen: Vec<usize> = (0..dims[axes.slow]).filter(|&k| depth(k) >= MIN_DEPTH).collect();
        let far = last as f64 - source[axes.slow];
        let mut plan =
            Self { axes, slices: Vec::new(), first: [0; 2], columns: 0, rows: 0, oversampling, source, far };
        let (Some(&a), Some(&b)) = (seen.first(), seen.last()) else { return Some(plan) };
        let ratios = [a, b].map(|k| depth(k) / far_depth);
        let mut size = [0_usize; 2];
        for (m, axis) in [axes.u, axes.v].into_iter().enumerate() {
            let detector = corners.map(|d| (source[axis] + d[axis] * far / d[axes.slow]) * oversampling);
            let hull = |x: f64| ratios.map(|r| (source[axis] + (x - source[axis]) / r) * oversampling);
            let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
            let most = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let low = least(&detector).max(least(&hull(-1.0))) - MARGIN;
            let high = most(&detector).min(most(&hull(dims[axis] as f64))) + MARGIN;
            let unit = [GROUP, TILE_ROWS][m] as i64;
            if high < low || low.is_nan() || high.is_nan() {
                return Some(plan);
            }
            if high - low > MAX_PIXELS || low.abs() > 1e9 {
                return None;
            }
            // Aligned globally, so that part of the detector has the same samples as the whole.
            let (low, high) = (libm::floor(low) as i64, libm::ceil(high) as i64);
            plan.first[m] = low.div_euclid(unit) * unit;
            size[m] = ((high - plan.first[m]) / unit + 1) as usize * unit as usize;
        }
        if size[0] as f64 * size[1] as f64 > MAX_PIXELS {
            return None;
        }
        [plan.columns, plan.rows] = size;
        plan.slices = seen.iter().map(|&k| plan.slice(k, depth(k) / far_depth, dims)).collect();
        Some(plan)
    }

    fn slice(&self, index: usize, ratio: f64, dims: [usize; 3]) -> Slice {
        let step = fixed(ratio / self.oversampling).min(MAX_STEP);
        let axes = [self.axes.u, self.axes.v];
        let start = [0, 1].map(|m| fixed(self.source[axes[m]] * (1.0 - ratio)) + self.first[m] * step);
        // A sample reads its voxel and the next one.
        let range = |m: usize, unit: i64, reach: i64, count: usize| {
            let stride = unit * step;
            let low = (-(reach * ONE) - start[m]).div_euclid(stride);
            let high = (dims[axes[m]] as i64 * ONE - 1 - start[m]).div_euclid(stride) + 1;
            let clamp = |x: i64| x.clamp(0, count as i64) as usize;
            (clamp(low), clamp(high))
        };
        let groups = range(0, GROUP as i64, GROUP_REACH, self.columns / GROUP);
        let rows = range(1, 1, 1, self.rows);
        let samples_per_position = 1.0 / step as f64;
        let mut slice = Slice { index, start, step, samples_per_position, groups, rows };
        // `div_euclid` rounds down: the first group or row may lie just outside.
        while slice.groups.0 < slice.groups.1 && slice.group(slice.groups.0).voxel < -GROUP_REACH {
            slice.groups.0 += 1;
        }
        while slice.rows.0 < slice.rows.1 && slice.row(slice.rows.0).0 < -1 {
            slice.rows.0 += 1;
        }
        slice
    }

    /// Pixels of the intermediate image.
    pub fn pixels(&self) -> usize {
        self.columns * self.rows
    }
}

/// The axis with the smallest maximum slope over the detector, if all rays have the same sign along it. Slopes are linear fractions of
/// the pixel position, so their extremes are at the corners.
fn best_axes(corners: &[[f64; 3]; 4]) -> Option<Axes> {
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
        if worst <= MAX_SLOPE && best.is_none_or(|(least, _)| worst < least) {
            best = Some((worst, axes));
        }
    }
    best.map(|(_, axes)| axes)
}

fn fixed(position: f64) -> i64 {
    libm::round(position * ONE as f64) as i64
}
