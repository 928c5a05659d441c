//! Which rays share an intermediate image. One image serves a whole frame where it can. Otherwise the
//! detector is halved until an axis suits all rays of a rectangle, and further where that saves samples. A
//! rectangle has one image, or several for ranges of depths where that costs less; their line integrals add
//! up.

use super::plan::{ImagePlan, Rays};
use super::splat::Dirty;
use crate::carm::PixelBox;
use crate::vector::{norm, sub};

/// Maximum number of times a rectangle is halved only to save time, and the minimum saving of each halving.
const MAX_HALVINGS: usize = 3;
const WORTH_HALVING: f64 = 0.9;

/// How an image's line integrals are written to the pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Blend {
    /// The first image of a rectangle replaces them.
    Replace,
    /// The other images are added.
    Add,
}

/// An intermediate image and the rectangle of the detector that reads it.
#[derive(Debug)]
pub(crate) struct ImagePatch {
    pub pixels: PixelBox,
    pub blend: Blend,
    pub plan: ImagePlan,
    /// Start of the part's samples among those of all parts.
    pub start: usize,
    /// Samples whose sums have changed but whose sharpened values have not been updated.
    pub dirty: Dirty,
}

impl ImagePatch {
    /// Range of the part's samples among those of all parts.
    pub fn samples(&self) -> core::ops::Range<usize> {
        self.start..self.start + self.plan.pixels()
    }
}

/// Samples of all parts together.
pub(crate) fn samples_of(parts: &[ImagePatch]) -> usize {
    parts.last().map_or(0, |last| last.samples().end)
}

/// The parts of a frame. Images of one rectangle follow one another.
pub(crate) fn parts_of(all: &Rays<'_>) -> Vec<ImagePatch> {
    let mut parts = Vec::new();
    if let Some(plan) = ImagePlan::whole(all) {
        add(&mut parts, all.pixels, vec![plan]);
        return parts;
    }
    let layers = |pixels: PixelBox| ImagePlan::layers(&Rays { pixels, ..*all });
    let mut waiting = vec![(all.pixels, 0, layers(all.pixels))];
    while let Some((pixels, depth, plans)) = waiting.pop() {
        let rays = Rays { pixels, ..*all };
        match (plans, halves(&rays)) {
            (Some(plans), halves) => {
                let halves = halves.filter(|_| depth < MAX_HALVINGS);
                match halves.and_then(|halves| cheaper(&rays, &plans, halves)) {
                    Some(halves) => {
                        waiting.extend(halves.map(|(pixels, plans)| (pixels, depth + 1, Some(plans))));
                    }
                    None => add(&mut parts, pixels, plans),
                }
            }
            (None, Some(halves)) => waiting.extend(halves.map(|pixels| (pixels, depth, layers(pixels)))),
            // Along a ray's own best axis the slope is at most 1, so what remains is a ray that misses the
            // volume by 1e9 samples.
            (None, None) => add(&mut parts, pixels, vec![ImagePlan::nothing(&rays)]),
        }
    }
    parts
}

/// The halves of a rectangle with their plans, if they cost clearly less than the whole: where the detector
/// cuts the volume obliquely, one half's rays end at nearer slices, which need fewer samples.
fn cheaper(
    rays: &Rays<'_>,
    plans: &[ImagePlan],
    halves: [PixelBox; 2],
) -> Option<[(PixelBox, Vec<ImagePlan>); 2]> {
    let cost =
        |pixels: &PixelBox, plans: &[ImagePlan]| plans.iter().map(|plan| plan.cost(pixels)).sum::<f64>();
    let planned = |pixels: PixelBox| Some((pixels, ImagePlan::layers(&Rays { pixels, ..*rays })?));
    let [first, second] = halves.map(planned);
    let halves = [first?, second?];
    let apart: f64 = halves.iter().map(|(pixels, plans)| cost(pixels, plans)).sum();
    (apart < WORTH_HALVING * cost(&rays.pixels, plans)).then_some(halves)
}

fn add(parts: &mut Vec<ImagePatch>, pixels: PixelBox, plans: Vec<ImagePlan>) {
    for (n, plan) in plans.into_iter().enumerate() {
        let blend = if n == 0 { Blend::Replace } else { Blend::Add };
        let start = samples_of(parts);
        parts.push(ImagePatch { pixels, blend, plan, start, dirty: Dirty::default() });
    }
}

/// The two halves of a rectangle across its longer side; `None` for a single pixel.
fn halves(rays: &Rays<'_>) -> Option<[PixelBox; 2]> {
    let PixelBox { columns, rows } = rays.pixels;
    let [corner, right, below, _] = rays.fan.corner_directions(&rays.pixels);
    let middle = |(first, end): (u32, u32)| first + (end - first) / 2;
    let (width, height) = (norm(sub(right, corner)), norm(sub(below, corner)));
    if columns.1 - columns.0 > 1 && (width >= height || rows.1 - rows.0 <= 1) {
        let cut = middle(columns);
        return Some([(columns.0, cut), (cut, columns.1)].map(|columns| PixelBox { columns, rows }));
    }
    let cut = middle(rows);
    (rows.1 - rows.0 > 1).then(|| [(rows.0, cut), (cut, rows.1)].map(|rows| PixelBox { columns, rows }))
}
