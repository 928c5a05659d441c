//! The smoothed surface for the widest tent, in integer arithmetic.
//!
//! Over the seven voxels under a tent of half width 3, the weights are quadratic polynomials in the point's
//! position between two faces, `u` in [0, 1] voxels: eighteenths of the rows of [`WEIGHT_18`]. The smoothed
//! occupancy is therefore a polynomial in (u_x, u_y, u_z) with 27 coefficients. For whole voxels these are
//! sums of small integers: no rounding, and three coefficients fit into one word. The spent fractions are
//! then subtracted from the coefficients. The coefficients remain valid as long as nothing changes in the
//! seven voxels per axis and the point stays between the same faces ([`super::remembered`]).

use core::ops::{Add, Mul, Sub};

use nalgebra::Vector3;

use super::strength::{BLOCK_EDGE, Block, BlocksAbout};
use super::surface::SurfaceSample;
use super::voxels::Voxels;

/// Number of voxels per axis.
pub(super) const SPLINE_VOXELS: usize = 7;
/// Eighteen times the integral of the tent over each voxel, as coefficients of 1, u, u². The tent's heights
/// at the faces are u/3, (u+1)/3, (u+2)/3, (3-u)/3, (2-u)/3, (1-u)/3.
const WEIGHT_18: [[i64; 3]; SPLINE_VOXELS] =
    [[0, 0, 1], [1, 2, 0], [3, 2, 0], [5, 2, -2], [5, -2, 0], [3, -2, 0], [1, -2, 1]];
/// [`WEIGHT_18`] as floats, for sums with fractions; four lanes, the last of which is unused.
const WEIGHT_18_F64: [[f64; 4]; SPLINE_VOXELS] = {
    let mut weights = [[0.0; 4]; SPLINE_VOXELS];
    let mut place = 0;
    while place < 3 * SPLINE_VOXELS {
        weights[place / 3][place % 3] = WEIGHT_18[place / 3][place % 3] as f64;
        place += 1;
    }
    weights
};
/// Bits per field. The largest sum, of 7 x 7 x 7 products, is below 2^15.
const FIELD_BITS: u32 = 21;

const _: () = assert!(3 * FIELD_BITS < i64::BITS, "three fields fit one word");
const _: () = assert!(SPLINE_VOXELS <= BLOCK_EDGE, "a cell lies in two blocks of an axis at most");

/// Inverse of 18 cubed.
const PER_18_CUBED: f64 = 1.0 / 5832.0;

/// Sums of the three coefficients along x, one field each, indexed by which of seven voxels are bone.
const ROW_SUMS: [i64; 1 << SPLINE_VOXELS] = {
    let mut sums = [0; 1 << SPLINE_VOXELS];
    let mut bits = 1usize;
    while bits < sums.len() {
        let [one, u, u2] = WEIGHT_18[bits.trailing_zeros() as usize];
        sums[bits] = sums[bits & (bits - 1)] + one + (u << FIELD_BITS) + (u2 << (2 * FIELD_BITS));
        bits += 1;
    }
    sums
};

/// Returns the sums over seven rows or slices by power of u: the columns of WEIGHT_18.
#[inline(always)]
fn combine<T>([p0, p1, p2, p3, p4, p5, p6]: [T; SPLINE_VOXELS]) -> [T; 3]
where
    T: Copy + From<i8> + Add<Output = T> + Sub<Output = T> + Mul<Output = T>,
{
    let [two, three, five] = [2, 3, 5].map(T::from);
    [p1 + p6 + three * (p2 + p5) + five * (p3 + p4), two * (p1 + p2 + p3 - p4 - p5 - p6), p0 + p6 - two * p3]
}

/// Returns the three fields of a word, lowest first.
#[inline]
fn fields(word: i64) -> [f64; 3] {
    const UNUSED: u32 = i64::BITS - FIELD_BITS;
    let low = (word << UNUSED) >> UNUSED;
    let rest = (word - low) >> FIELD_BITS;
    let middle = (rest << UNUSED) >> UNUSED;
    [low as f64, middle as f64, ((rest - middle) >> FIELD_BITS) as f64]
}

#[inline]
fn value(c: [f64; 3], u: f64) -> f64 {
    c[0] + u * (c[1] + u * c[2])
}

#[inline]
fn slope(c: [f64; 3], u: f64) -> f64 {
    c[1] + 2.0 * u * c[2]
}

/// The smoothed surface within one cell: eighteenths cubed of the coefficients, by powers of u_z, u_y, u_x.
#[derive(Debug, Clone, Copy)]
pub(super) struct SplineCell {
    coefficients: [[[f64; 3]; 3]; 3],
}

impl SplineCell {
    /// A cell of air only.
    pub const AIR: Self = Self { coefficients: [[[0.0; 3]; 3]; 3] };

    /// Returns the smoothed occupancy and its slopes with respect to u.
    #[inline(always)]
    pub fn sample(&self, u: [f64; 3]) -> SurfaceSample {
        let (mut level, mut slope_x, mut slope_y) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for (z_power, along_x) in self.coefficients.iter().enumerate() {
            let values = along_x.map(|c| value(c, u[0]));
            level[z_power] = value(values, u[1]);
            slope_x[z_power] = value(along_x.map(|c| slope(c, u[0])), u[1]);
            slope_y[z_power] = slope(values, u[1]);
        }
        let slopes = Vector3::new(value(slope_x, u[2]), value(slope_y, u[2]), slope(level, u[2]));
        SurfaceSample { outward_per_m: slopes * PER_18_CUBED, level: value(level, u[2]) * PER_18_CUBED }
    }
}

impl Voxels {
    /// Returns the smoothed surface about the voxels `start..start + 7` per axis.
    #[inline(always)]
    pub(super) fn spline_cell(&self, start: [i64; 3]) -> SplineCell {
        let mut slices = [[0; 3]; SPLINE_VOXELS];
        let mut rows = [[0u8; SPLINE_VOXELS]; SPLINE_VOXELS];
        self.occupancy().cube(start, &mut rows);
        for (slice, rows) in slices.iter_mut().zip(&rows) {
            *slice = combine(rows.map(|bits| ROW_SUMS[usize::from(bits & 0x7f)]));
        }
        let by_y = [0, 1, 2].map(|y_power| combine(slices.map(|slice| slice[y_power])));
        let mut cell =
            SplineCell { coefficients: [0, 1, 2].map(|z_power| by_y.map(|words| fields(words[z_power]))) };
        if let Some(blocks) = self.pool().blocks_about(start, SPLINE_VOXELS as i64 - 1) {
            self.take_spent(start, &blocks, &mut cell);
        }
        cell
    }

    /// Subtracts the spent fractions from a cell. Sums whole rows of the blocks it lies in, and selects its
    /// seven voxels of a row at the end, which is cheaper than selecting them row by row.
    #[inline(always)]
    fn take_spent(&self, start: [i64; 3], blocks: &BlocksAbout, cell: &mut SplineCell) {
        let within = start.map(|x| (x & 7) as usize);
        // Sums of the first and the second block along x.
        let mut halves = [Sums::NOTHING; 2];
        for (x, half) in halves.iter_mut().enumerate() {
            let mut sides = [[None; 2]; 2];
            for (z, side) in sides.iter_mut().enumerate() {
                for (y, block) in side.iter_mut().enumerate() {
                    *block = self.pool().block(blocks, [x, y, z]);
                }
            }
            half.add(&sides, [within[1], within[2]]);
        }
        let [first, second] = &halves;
        for (z_power, by_y) in cell.coefficients.iter_mut().enumerate() {
            for (y_power, by_x) in by_y.iter_mut().enumerate() {
                let both = [first.by_y[y_power][z_power].0, second.by_y[y_power][z_power].0];
                take_rows(by_x, &both.as_flattened()[within[0]..]);
            }
        }
    }
}

/// One number for each of eight voxels along x. Its loops cover all lanes at once, because the compiler
/// vectorises these, but not a loop over lanes that contains the whole sum.
#[derive(Debug, Clone, Copy)]
struct Lanes([f64; BLOCK_EDGE]);

impl Lanes {
    const ZERO: Self = Self([0.0; BLOCK_EDGE]);

    /// Returns the spent fractions of the voxels of a row that are still bone: a fully spent voxel is not
    /// among the whole voxels from which they are subtracted.
    #[inline(always)]
    fn of_bone(row: &[f64; BLOCK_EDGE]) -> Self {
        let mut lanes = Self::ZERO;
        for (lane, spent) in lanes.0.iter_mut().zip(row) {
            *lane = if *spent < 1.0 { *spent } else { 0.0 };
        }
        lanes
    }
}

impl From<i8> for Lanes {
    #[inline(always)]
    fn from(number: i8) -> Self {
        Self([f64::from(number); BLOCK_EDGE])
    }
}

impl Add for Lanes {
    type Output = Self;

    #[inline(always)]
    fn add(mut self, other: Self) -> Self {
        for (lane, other) in self.0.iter_mut().zip(&other.0) {
            *lane += other;
        }
        self
    }
}

impl Sub for Lanes {
    type Output = Self;

    #[inline(always)]
    fn sub(mut self, other: Self) -> Self {
        for (lane, other) in self.0.iter_mut().zip(&other.0) {
            *lane -= other;
        }
        self
    }
}

impl Mul for Lanes {
    type Output = Self;

    #[inline(always)]
    fn mul(mut self, other: Self) -> Self {
        for (lane, other) in self.0.iter_mut().zip(&other.0) {
            *lane *= other;
        }
        self
    }
}

/// Sums of the spent fractions over y and z for eight voxels along x, by the powers of u_y and u_z.
struct Sums {
    by_y: [[Lanes; 3]; 3],
}

impl Sums {
    const NOTHING: Self = Self { by_y: [[Lanes::ZERO; 3]; 3] };

    /// Adds blocks, by z and y; `y` and `z` locate the first voxel within the first block.
    #[inline(always)]
    fn add(&mut self, blocks: &[[Option<Block>; 2]; 2], [y, z]: [usize; 2]) {
        let mut slices = [[Lanes::ZERO; SPLINE_VOXELS]; 3];
        let mut any = false;
        #[allow(
            clippy::needless_range_loop,
            reason = "iterating over slices makes a whole step an eighth slower with AVX-512"
        )]
        for slice in 0..SPLINE_VOXELS {
            let z = z + slice;
            let [first, second] = &blocks[z / BLOCK_EDGE % 2];
            if is_cut(first, second, y, z) {
                any = true;
                let [first, second] = [slice_of(first, z), slice_of(second, z)];
                let mut rows = [Lanes::ZERO; SPLINE_VOXELS];
                for (row, lanes) in rows.iter_mut().enumerate() {
                    let side = if y + row < BLOCK_EDGE { first } else { second };
                    *lanes = Lanes::of_bone(&side[(y + row) % BLOCK_EDGE]);
                }
                let [one, u, u2] = combine(rows);
                [slices[0][slice], slices[1][slice], slices[2][slice]] = [one, u, u2];
            }
        }
        if any {
            for (by_z, slices) in self.by_y.iter_mut().zip(slices) {
                *by_z = combine(slices);
            }
        }
    }
}

/// Returns the slice z of a block.
#[inline(always)]
fn slice_of<'p>(block: &Option<Block<'p>>, z: usize) -> &'p [[f64; BLOCK_EDGE]; BLOCK_EDGE] {
    match block {
        Some(block) => block.slice(z),
        None => &UNCUT,
    }
}

/// A slice of an untouched block.
static UNCUT: [[f64; BLOCK_EDGE]; BLOCK_EDGE] = [[0.0; BLOCK_EDGE]; BLOCK_EDGE];

/// Subtracts sums along x.
#[inline(always)]
fn take_rows(by_x: &mut [f64; 3], sums: &[f64]) {
    let [one, u, u2] = *by_x;
    let mut along_x = [one, u, u2, 0.0];
    for (weights, sum) in WEIGHT_18_F64.iter().zip(sums) {
        for lane in 0..4 {
            along_x[lane] -= weights[lane] * sum;
        }
    }
    let [one, u, u2, _] = along_x;
    *by_x = [one, u, u2];
}

/// Returns whether any of the seven rows from row `y` on may have a spent fraction, in slice `z` of two
/// blocks.
#[inline(always)]
fn is_cut(first: &Option<Block>, second: &Option<Block>, y: usize, z: usize) -> bool {
    let rows = |block: &Option<Block>| block.map_or(0, |block| block.partial_rows(z));
    let both = u128::from(rows(first)) | u128::from(rows(second)) << u64::BITS;
    const UNUSED: usize = BLOCK_EDGE * (BLOCK_EDGE - SPLINE_VOXELS);
    ((both >> (BLOCK_EDGE * y)) as u64) << UNUSED != 0
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use crate::bone::{BoneField, BoneParameters, BurrState, GridGeometry};

    /// The polynomial equals the sums of the tents on scattered, partly cut voxels, inside the grid and
    /// across its edges. Tolerance 1e-12: rounding of a few hundred terms below 1.
    #[test]
    fn polynomial_is_the_sum_of_the_tents() {
        let dims = [19, 17, 15];
        let geometry = GridGeometry::axis_aligned(dims, [0.5e-3, 0.4e-3, 0.6e-3], Vector3::zeros());
        let mut random = 1u64;
        let mut next = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 40) as f64 / (1u64 << 24) as f64
        };
        let hu: Vec<i16> =
            (0..geometry.voxel_count()).map(|_| if next() < 0.6 { 400 } else { -1000 }).collect();
        let mut field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
        let burr = BurrState {
            centre_m: Vector3::new(4.0e-3, 3.0e-3, 4.0e-3),
            radius_m: 3.0e-3,
            speed_rad_s: 800.0,
            normal_force_n: 5.0,
        };
        let report = field.grind(&hu, &burr, 0.05).unwrap();
        assert!(report.cut_count > 100 && report.removed_count == 0);
        let voxels = field.voxels();
        let tent = voxels.tent_sizes(3.0e-3);
        let mut worst: f64 = 0.0;
        for _ in 0..2000 {
            let position = dims.map(|n| (n as f64 + 10.0) * next() - 5.0);
            let mut point = Vector3::from(position);
            point.iter_mut().zip(geometry.spacing_m).for_each(|(x, spacing)| *x *= spacing);
            let fast = voxels.sample_surface(&point, &tent, None);
            let mut slow = voxels.sample_tents(position, &tent);
            for axis in 0..3 {
                slow.outward_per_m[axis] -= fast.outward_per_m[axis] * geometry.spacing_m[axis];
            }
            worst = worst.max(slow.outward_per_m.norm()).max((slow.level - fast.level).abs());
        }
        println!("polynomial against tents: at most {worst:.1e}");
        assert!(worst < 1e-12);
    }
}
