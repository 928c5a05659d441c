//! From the intermediate image to the detector: sharpening, then one interpolation per pixel.
//!
//! Bilinear interpolation blurs: it convolves the voxels with a triangle, whose second moment of one sixth of
//! a squared voxel spacing is twice that of the voxel itself. `I - alpha laplacian(I)` with `alpha =
//! oversampling^2 / 12` undoes half of it. The image is then sampled with the Catmull-Rom cubic (Catmull and
//! Rom, "A class of local interpolating splines", 1974), whose error is small compared with that of the
//! voxels.
//!
//! Plain f32 and f64 arithmetic in a fixed order, without fused operations: vector code gives the same bits.

use super::instructions::Plain;
use super::parts::{Blend, ImagePatch};
use super::plan::ImagePlan;
use crate::carm::PixelBox;
use crate::ray::RayFan;

/// Half-open ranges of columns and rows of the intermediate image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rect {
    pub columns: (usize, usize),
    pub rows: (usize, usize),
}

/// 1.5 * 2^52: adding a smaller number rounds it to an integer, which is then in the low bits.
const INTEGER: f64 = 6_755_399_441_055_744.0;

/// Converts an integer of magnitude below 2^51 exactly; the sums are far smaller.
#[inline(always)]
fn float(sum: i64) -> f64 {
    f64::from_bits((sum as u64).wrapping_add(INTEGER.to_bits())) - INTEGER
}

/// Integer part and fraction of a position from 0 to 2^31.
#[inline(always)]
fn split(position: f64) -> (u32, f32) {
    let shifted = position + INTEGER;
    let rest = position - (shifted - INTEGER);
    let below = rest < 0.0;
    let fraction = if below { rest + 1.0 } else { rest };
    ((shifted.to_bits() as u32).wrapping_sub(u32::from(below)), fraction as f32)
}

/// Writes the sharpened image of one row.
#[inline(always)]
fn sharpen_row(
    sums: &[i64],
    plan: &ImagePlan,
    row: usize,
    columns: (usize, usize),
    alpha: f64,
    out: &mut [f32],
) {
    let width = plan.columns;
    let line = |r: usize| sums.get(r * width..(r + 1) * width).unwrap_or(&[]);
    let (above, here, below) = (line(row.wrapping_sub(1)), line(row), line(row + 1));
    // Outside the image the sums are zero, or no pixel reads them.
    let interior = (columns.0.max(1), columns.1.min(width.saturating_sub(1)));
    let at = |line: &[i64], c: usize| line.get(c).copied().unwrap_or(0);
    let one = |c: usize| {
        let around = at(here, c.wrapping_sub(1)) + at(here, c + 1) + at(above, c) + at(below, c);
        (float(at(here, c)) * (1.0 + 4.0 * alpha) - float(around) * alpha) as f32
    };
    if above.is_empty() || below.is_empty() || alpha == 0.0 || interior.0 >= interior.1 {
        (columns.0..columns.1).for_each(|c| out[c] = one(c));
        return;
    }
    for c in [columns.0, columns.1 - 1] {
        out[c] = one(c);
    }
    let (a, b) = interior;
    let inner = out[a..b].iter_mut().zip(&here[a..b]).zip(&above[a..b]).zip(&below[a..b]);
    for ((((o, &i), &up), &down), (&left, &right)) in inner.zip(here[a - 1..].iter().zip(&here[a + 1..])) {
        let around = left + right + up + down;
        *o = (float(i) * (1.0 + 4.0 * alpha) - float(around) * alpha) as f32;
    }
}

/// Maps the intermediate image to the detector.
pub(crate) struct Warp<'a> {
    pub plan: &'a ImagePlan,
    pub fan: &'a RayFan,
    /// The sharpened image.
    pub image: &'a [f32],
    pub blend: Blend,
    /// Attenuation of one unit of the sums over one metre.
    pub scale_per_m: f64,
}

/// Pixels whose positions are computed at once.
const CHUNK: usize = 64;

/// Positions of a run of pixels in the image, and the factors of their samples.
struct Places {
    /// Index of the top-left sample of the 4 x 4 that are read.
    corner: [u32; CHUNK],
    x: [f32; CHUNK],
    y: [f32; CHUNK],
    factor: [f32; CHUNK],
}

impl Warp<'_> {
    /// Line integrals of the pixels of a detector row, starting at `first_column`.
    #[inline(always)]
    pub fn row(&self, row: u32, first_column: u32, out: &mut [f64]) {
        if self.plan.pixels() == 0 {
            if self.blend == Blend::Replace {
                out.fill(0.0);
            }
            return;
        }
        let mut places =
            Places { corner: [0; CHUNK], x: [0.0; CHUNK], y: [0.0; CHUNK], factor: [0.0; CHUNK] };
        let Some(rows) = self.rows() else { return };
        let mut columns = [[0.0_f32; 4]; CHUNK];
        for (chunk, out) in out.chunks_mut(CHUNK).enumerate() {
            self.place(row, first_column + (chunk * CHUNK) as u32, &mut places);
            let weights = catmull_rom(&places.y);
            for (n, columns) in columns.iter_mut().enumerate().take(out.len()) {
                // This early exit stops the compiler from gathering the taps of many pixels at a time
                // (vgather), which is slower.
                let Some(taps) = taps(&rows, places.corner[n] as usize) else { break };
                for (c, v) in columns.iter_mut().enumerate() {
                    *v = (weights[0][n] * taps[0][c] + weights[1][n] * taps[1][c])
                        + (weights[2][n] * taps[2][c] + weights[3][n] * taps[3][c]);
                }
            }
            let weights = catmull_rom(&places.x);
            let mut values = [0.0_f64; CHUNK];
            for n in 0..CHUNK {
                let c = &columns[n];
                let value = (weights[0][n] * c[0] + weights[1][n] * c[1])
                    + (weights[2][n] * c[2] + weights[3][n] * c[3]);
                // A cubic undershoots next to an edge, but attenuation is never negative.
                values[n] = f64::from((value * places.factor[n]).max(0.0));
            }
            match self.blend {
                Blend::Replace => out.copy_from_slice(&values[..out.len()]),
                Blend::Add => out.iter_mut().zip(&values).for_each(|(sum, value)| *sum += value),
            }
        }
    }

    #[inline(always)]
    fn place(&self, row: u32, first_column: u32, places: &mut Places) {
        let plan = self.plan;
        let [k, u, v] = [plan.axes.slow, plan.axes.u, plan.axes.v];
        let reach = plan.far * plan.oversampling;
        let shift = |axis: usize, m: usize| plan.source[axis] * plan.oversampling - plan.first[m] as f64;
        let (shift_x, shift_y) = (shift(u, 0), shift(v, 1));
        // Positions farther out read the zero margin around the volume.
        let (limit_x, limit_y) = (plan.columns as f64 - 3.0, plan.rows as f64 - 3.0);
        let width = plan.columns as u32;
        let scale_per_m = self.scale_per_m as f32;
        let steps = self.fan.row_steps(row);
        let [index_k, index_u, index_v] = [k, u, v].map(|axis| steps.index(axis));
        let world_m = [0, 1, 2].map(|axis| steps.world_m(axis));
        for n in 0..CHUNK {
            let column = f64::from(first_column) + n as f64;
            let at = |line: (f64, f64)| line.0 + column * line.1;
            let along = 1.0 / at(index_k);
            let world_m = world_m.map(at);
            let x = shift_x + at(index_u) * reach * along;
            let y = shift_y + at(index_v) * reach * along;
            let (column, x) = split(x.max(1.0).min(limit_x));
            let (row, y) = split(y.max(1.0).min(limit_y));
            places.corner[n] = (row - 1).wrapping_mul(width).wrapping_add(column - 1);
            places.x[n] = x;
            places.y[n] = y;
            let squares = world_m[0] * world_m[0] + world_m[1] * world_m[1] + world_m[2] * world_m[2];
            places.factor[n] = (squares as f32).sqrt() * (along.abs() as f32) * scale_per_m;
        }
    }

    /// The image, and the image from its second, third and fourth row on, all of the same length, so that one
    /// bounds check covers all four. `None` for an image with fewer rows, which never occurs.
    #[inline(always)]
    fn rows(&self) -> Option<[&[f32]; 4]> {
        let width = self.plan.columns;
        let length = self.image.len().checked_sub(3 * width)?;
        let row = |n: usize| self.image.get(n * width..n * width + length);
        Some([row(0)?, row(1)?, row(2)?, row(3)?])
    }
}

/// Four samples of each of four rows. Positions are clamped to the image, so this is never `None`.
#[inline(always)]
fn taps<'i>(rows: &[&'i [f32]; 4], corner: usize) -> Option<[&'i [f32; 4]; 4]> {
    let row = |n: usize| rows[n].get(corner..corner + 4).and_then(|four| four.first_chunk());
    Some([row(0)?, row(1)?, row(2)?, row(3)?])
}

/// Weights of the four neighbours at fractions t between the middle two.
#[inline(always)]
fn catmull_rom(fractions: &[f32; CHUNK]) -> [[f32; CHUNK]; 4] {
    let mut weights = [[0.0; CHUNK]; 4];
    for n in 0..CHUNK {
        let t = fractions[n];
        let (t2, s) = (t * t, 1.0 - t);
        let s2 = s * s;
        weights[0][n] = -0.5 * t * s2;
        weights[1][n] = 1.0 + t2 * (1.5 * t - 2.5);
        weights[2][n] = 1.0 + s2 * (1.5 * s - 2.5);
        weights[3][n] = -0.5 * t2 * s;
    }
    weights
}

/// The detector pixels that read a rectangle of a part's intermediate image.
pub(crate) fn pixels_of(part: &ImagePatch, fan: &RayFan, rect: &Rect) -> Option<PixelBox> {
    // Sharpening reaches one sample further, the cubic two; one more for rounding.
    const REACH: f64 = 4.0;
    let plan = &part.plan;
    let [k, u, v] = [plan.axes.slow, plan.axes.u, plan.axes.v];
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for x in [rect.columns.0 as f64 - REACH, rect.columns.1 as f64 - 1.0 + REACH] {
        for y in [rect.rows.0 as f64 - REACH, rect.rows.1 as f64 - 1.0 + REACH] {
            let mut direction = [0.0; 3];
            direction[k] = plan.far;
            direction[u] = (x + plan.first[0] as f64) / plan.oversampling - plan.source[u];
            direction[v] = (y + plan.first[1] as f64) / plan.oversampling - plan.source[v];
            let Some(pixel) = fan.pixel_of(direction) else {
                return Some(part.pixels);
            };
            for m in 0..2 {
                low[m] = low[m].min(pixel[m]);
                high[m] = high[m].max(pixel[m]);
            }
        }
    }
    PixelBox::covering(low, high, part.pixels.columns.1, part.pixels.rows.1)?.within(&part.pixels)
}

/// One row to be sharpened, for [`Instructions::run`](super::Instructions).
pub(crate) struct SharpenRow<'a> {
    pub sums: &'a [i64],
    pub plan: &'a ImagePlan,
    pub row: usize,
    pub columns: (usize, usize),
    pub alpha: f64,
    pub out: &'a mut [f32],
}

impl Plain for SharpenRow<'_> {
    #[inline(always)]
    fn run(self) {
        sharpen_row(self.sums, self.plan, self.row, self.columns, self.alpha, self.out);
    }
}

/// One detector row to be warped.
pub(crate) struct WarpRow<'a> {
    pub warp: &'a Warp<'a>,
    pub row: u32,
    pub first_column: u32,
    pub out: &'a mut [f64],
}

impl Plain for WarpRow<'_> {
    #[inline(always)]
    fn run(self) {
        self.warp.row(self.row, self.first_column, self.out);
    }
}
