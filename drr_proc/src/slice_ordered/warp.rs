//! From the intermediate image to the detector: sharpening, then one interpolation for each pixel.
//!
//! Bilinear interpolation blurs: it convolves the voxels with a triangle, whose second moment of one sixth of a squared
//! voxel spacing is twice that of the voxel itself. `I - alpha laplacian(I)` with `alpha = oversampling^2 / 12` takes half
//! of it back. The image is then read with Catmull and Rom's cubic ("A class of local interpolating splines", 1974), whose
//! error is small beside that of the voxels.
//!
//! Plain f32 and f64 arithmetic in a fixed order without fused operations: vector code has the same bits.

use super::instructions::Plain;
use super::plan::Plan;
use crate::carm::PixelBox;
use crate::ray::RayFan;

/// Half-open ranges of columns and rows of the intermediate image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rect {
    pub columns: (usize, usize),
    pub rows: (usize, usize),
}

/// Writes the sharpened image of one row.
#[inline(always)]
fn sharpen_row(sums: &[i64], plan: &Plan, row: usize, columns: (usize, usize), alpha: f64, out: &mut [f32]) {
    let width = plan.columns;
    let line = |r: usize| sums.get(r * width..(r + 1) * width).unwrap_or(&[]);
    let (above, here, below) = (line(row.wrapping_sub(1)), line(row), line(row + 1));
    // Beyond the image there is nothing, or nothing that a pixel reads.
    let interior = (columns.0.max(1), columns.1.min(width.saturating_sub(1)));
    let at = |line: &[i64], c: usize| line.get(c).copied().unwrap_or(0);
    let one = |c: usize| {
        let around = at(here, c.wrapping_sub(1)) + at(here, c + 1) + at(above, c) + at(below, c);
        (at(here, c) as f64 * (1.0 + 4.0 * alpha) - around as f64 * alpha) as f32
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
        *o = (i as f64 * (1.0 + 4.0 * alpha) - around as f64 * alpha) as f32;
    }
}

/// The detector's view of the intermediate image.
pub(crate) struct Warp<'a> {
    pub plan: &'a Plan,
    pub fan: &'a RayFan,
    /// The sharpened image.
    pub image: &'a [f32],
    /// Attenuation of one unit of the sums over one metre.
    pub scale_per_m: f64,
}

/// Pixels whose positions are worked out together.
const CHUNK: usize = 64;

/// Positions and factors of a run of pixels.
struct Places {
    column: [i32; CHUNK],
    row: [i32; CHUNK],
    x: [f32; CHUNK],
    y: [f32; CHUNK],
    factor: [f64; CHUNK],
}

impl Warp<'_> {
    /// Line integrals of the pixels of a detector row from `first_column` on.
    #[inline(always)]
    pub fn row(&self, row: u32, first_column: u32, out: &mut [f64]) {
        let mut places = Places {
            column: [0; CHUNK],
            row: [0; CHUNK],
            x: [0.0; CHUNK],
            y: [0.0; CHUNK],
            factor: [0.0; CHUNK],
        };
        for (chunk, out) in out.chunks_mut(CHUNK).enumerate() {
            self.place(row, first_column + (chunk * CHUNK) as u32, &mut places);
            for (n, o) in out.iter_mut().enumerate() {
                let value = self.sample(places.column[n], places.row[n], places.x[n], places.y[n]);
                // A cubic swings below 0 beside an edge; attenuation does not.
                *o = (f64::from(value) * places.factor[n]).max(0.0);
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
        let (limit_x, limit_y) = (plan.columns as f64 + 8.0, plan.rows as f64 + 8.0);
        let steps = self.fan.row_steps(row);
        for n in 0..CHUNK {
            let column = f64::from(first_column) + n as f64;
            let [index, world_m] = steps.at(column);
            let along = 1.0 / index[k];
            // Shifted by 8 to be positive: truncation is then rounding down.
            let x = (shift_x + index[u] * reach * along).clamp(-8.0, limit_x) + 8.0;
            let y = (shift_y + index[v] * reach * along).clamp(-8.0, limit_y) + 8.0;
            let (column, row) = (x as i32, y as i32);
            places.column[n] = column - 8;
            places.row[n] = row - 8;
            places.x[n] = (x - f64::from(column)) as f32;
            places.y[n] = (y - f64::from(row)) as f32;
            let squares = world_m[0] * world_m[0] + world_m[1] * world_m[1] + world_m[2] * world_m[2];
            places.factor[n] = squares.sqrt() * along.abs() * self.scale_per_m;
        }
    }

    /// Catmull-Rom interpolation at (column + x, row + y).
    #[inline(always)]
    fn sample(&self, column: i32, row: i32, x: f32, y: f32) -> f32 {
        let Some(taps) = self.taps(column, row) else { return self.edge_sample(column, row, x, y) };
        cubic(taps, x, y)
    }

    #[inline(always)]
    fn taps(&self, column: i32, row: i32) -> Option<[&[f32; 4]; 4]> {
        let width = self.plan.columns;
        let (c, r) = (usize::try_from(column - 1).ok()?, usize::try_from(row - 1).ok()?);
        if c + 4 > width {
            return None;
        }
        let rows = self.image.get(r * width + c..)?;
        Some([
            rows.first_chunk()?,
            rows.get(width..)?.first_chunk()?,
            rows.get(2 * width..)?.first_chunk()?,
            rows.get(3 * width..)?.first_chunk()?,
        ])
    }

    /// The same where some neighbours lie beyond the image: there is nothing.
    #[cold]
    fn edge_sample(&self, column: i32, row: i32, x: f32, y: f32) -> f32 {
        let (width, height) = (self.plan.columns as i32, self.plan.rows as i32);
        let tap = |c: i32, r: i32| {
            let inside = c >= 0 && r >= 0 && c < width && r < height;
            if inside { self.image[(r * width + c) as usize] } else { 0.0 }
        };
        let taps = [-1, 0, 1, 2].map(|dy| [-1, 0, 1, 2].map(|dx| tap(column + dx, row + dy)));
        let [a, b, c, d] = &taps;
        cubic([a, b, c, d], x, y)
    }
}

#[inline(always)]
fn cubic(taps: [&[f32; 4]; 4], x: f32, y: f32) -> f32 {
    let (wx, wy) = (catmull_rom(x), catmull_rom(y));
    let mut v = [0.0_f32; 4];
    for n in 0..4 {
        v[n] = (wy[0] * taps[0][n] + wy[1] * taps[1][n]) + (wy[2] * taps[2][n] + wy[3] * taps[3][n]);
    }
    (wx[0] * v[0] + wx[1] * v[1]) + (wx[2] * v[2] + wx[3] * v[3])
}

/// Weights of the four neighbours at a fraction t between the middle two.
#[inline(always)]
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, s) = (t * t, 1.0 - t);
    let s2 = s * s;
    let outer = [-0.5 * t * s2, -0.5 * t2 * s];
    [outer[0], 1.0 + t2 * (1.5 * t - 2.5), 1.0 + s2 * (1.5 * s - 2.5), outer[1]]
}

/// The detector pixels that read a rectangle of the intermediate image's sums.
pub(crate) fn pixels_of(plan: &Plan, fan: &RayFan, rect: &Rect, pixels: [u32; 2]) -> Option<PixelBox> {
    // Sharpening reaches one sample further, the cubic two; one more for rounding.
    const REACH: f64 = 4.0;
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
                return Some(PixelBox { columns: (0, pixels[0]), rows: (0, pixels[1]) });
            };
            for m in 0..2 {
                low[m] = low[m].min(pixel[m]);
                high[m] = high[m].max(pixel[m]);
            }
        }
    }
    PixelBox::covering(low, high, pixels[0], pixels[1])
}

/// One row to be sharpened, for [`Instructions::run`](super::Instructions).
pub(crate) struct SharpenRow<'a> {
    pub sums: &'a [i64],
    pub plan: &'a Plan,
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
