//! The cached sums and images of one C-arm, and their conversion to line integrals on its detector.

use rayon::prelude::*;

use super::instructions::Instructions;
use super::parts::ImagePatch;
use super::warp::{Rect, SharpenRow, Warp, WarpRow};
use crate::carm::{CArm, PixelBox};
use crate::ray::RayFan;

/// Below this number of pixels, the calling thread warps them without waking the workers.
const PARALLEL_FROM: usize = 1 << 14;

/// Threads to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Threads {
    /// The calling thread only.
    Caller,
    /// The pool that the caller runs in.
    Pool,
}

/// The cached images of one C-arm.
pub(super) struct CachedImages {
    pub c_arm: CArm,
    pub fan: RayFan,
    pub parts: Vec<ImagePatch>,
    /// Sums over all slices of each part, row-major, one part after the other.
    pub sums: Vec<i64>,
    /// The same, sharpened.
    pub image: Vec<f32>,
}

impl CachedImages {
    /// Bytes of the sums and the image.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.sums) + size_of_val(&*self.image)
    }
}

/// Conversion of sums to line integrals.
#[derive(Clone, Copy)]
pub(super) struct SumsConversion {
    pub instructions: Instructions,
    /// Strength of the sharpening.
    pub alpha: f64,
    /// Attenuation of one unit of the sums, 1/m.
    pub scale_per_m: f64,
    pub threads: Threads,
}

impl SumsConversion {
    /// Sharpens a rectangle of a part's sums.
    pub fn sharpen(self, standing: &mut CachedImages, part: usize, rect: &Rect) {
        let CachedImages { parts, sums, image, .. } = standing;
        let Some(part) = parts.get(part) else { return };
        let (plan, samples) = (&part.plan, part.samples());
        let (Some(sums), Some(image)) = (sums.get(samples.clone()), image.get_mut(samples)) else { return };
        let Self { instructions, alpha, threads, .. } = self;
        let width = plan.columns;
        let sharpen = |(row, line): (usize, &mut [f32])| {
            instructions.run(SharpenRow { sums, plan, row, columns: rect.columns, alpha, out: line });
        };
        let (first, end) = rect.rows;
        let lines = &mut image[first * width..end * width];
        if threads == Threads::Caller || lines.len() < PARALLEL_FROM || rect.columns.1 - rect.columns.0 < 64 {
            lines.chunks_mut(width.max(1)).enumerate().for_each(|(n, line)| sharpen((first + n, line)));
        } else {
            let numbered = lines.par_chunks_mut(width.max(1)).enumerate().with_min_len(8);
            numbered.for_each(|(n, line)| sharpen((first + n, line)));
        }
    }

    /// Warps the images to a rectangle of the detector.
    pub fn draw(self, standing: &CachedImages, detector: &PixelBox, out: &mut [f64]) {
        for part in &standing.parts {
            if let Some(detector) = detector.within(&part.pixels) {
                self.draw_part(standing, part, &detector, out);
            }
        }
    }

    fn draw_part(self, standing: &CachedImages, part: &ImagePatch, detector: &PixelBox, out: &mut [f64]) {
        let Self { instructions, scale_per_m, threads, .. } = self;
        let Some(image) = standing.image.get(part.samples()) else { return };
        let warp = Warp { plan: &part.plan, fan: &standing.fan, image, blend: part.blend, scale_per_m };
        let (c0, c1) = (detector.columns.0 as usize, detector.columns.1 as usize);
        let (r0, r1) = (detector.rows.0 as usize, detector.rows.1 as usize);
        let columns = standing.c_arm.columns as usize;
        let rows = &mut out[r0 * columns..r1 * columns];
        let draw = |(n, line): (usize, &mut [f64])| {
            let out = &mut line[c0..c1];
            let row = (r0 + n) as u32;
            instructions.run(WarpRow { warp: &warp, row, first_column: detector.columns.0, out });
        };
        if threads == Threads::Caller || (r1 - r0) * (c1 - c0) < PARALLEL_FROM {
            rows.chunks_mut(columns).enumerate().for_each(draw);
        } else {
            rows.par_chunks_mut(columns).enumerate().with_min_len(8).for_each(draw);
        }
    }
}
