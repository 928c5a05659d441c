//! Frames whose sums are not kept: any number of them at a time, from one set of copies.

use rayon::prelude::*;

use super::SliceOrdered;
use super::parts::samples_of;
use super::standing::CachedImages;
use crate::carm::CArm;
use crate::error::DrrError;
use crate::grid::VolumeView;
use crate::ray::RayFan;
use crate::removal::RemovedVoxels;

/// Memory of a frame's intermediate images, reused by the next.
#[derive(Debug, Default)]
pub(crate) struct Images {
    sums: Vec<i64>,
    image: Vec<f32>,
}

impl SliceOrdered {
    /// Prepares for [`SliceOrdered::project_once`] from these C-arms, `at_a_time` of them together: applies
    /// pending changes and creates the copies. The current C-arm's sums are kept. Runs on the threads of the
    /// caller's pool.
    ///
    /// # Errors
    /// The volume or the images are too large for the memory.
    pub(crate) fn ready<'a>(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arms: impl IndexedParallelIterator<Item = &'a CArm>,
        at_a_time: usize,
    ) -> Result<(), DrrError> {
        self.settle_or_drop();
        let needs = |c_arm: &CArm| {
            let parts = self.parts(&RayFan::new(&self.store_grid, c_arm), c_arm);
            let across = |slow: usize| parts.iter().any(|part| part.plan.axes.slow == slow);
            ([0, 1, 2].map(across), samples_of(&parts))
        };
        let both = |(a, few): ([bool; 3], usize), (b, many): ([bool; 3], usize)| {
            ([0, 1, 2].map(|slow| a[slow] || b[slow]), few.max(many))
        };
        let (across, samples) = c_arms.map(needs).reduce(|| ([false; 3], 0), both);
        (0..3).filter(|slow| across[*slow]).try_for_each(|slow| self.ensure(view, removed, slow))?;
        self.check_memory(samples.saturating_mul(at_a_time))
    }

    /// Computes the line integrals of a C-arm prepared by [`SliceOrdered::ready`], bit-identical to
    /// [`SliceOrdered::project`]. Keeps nothing. Runs on idle threads of the caller's pool.
    pub(crate) fn project_once(&self, c_arm: &CArm, images: &mut Images, image: &mut [f64]) {
        let fan = RayFan::new(&self.store_grid, c_arm);
        let parts = self.parts(&fan, c_arm);
        let Images { sums, image: floats } = core::mem::take(images);
        let mut standing = CachedImages { c_arm: *c_arm, fan, parts, sums, image: floats };
        self.sum(&mut standing);
        self.develop(&mut standing, image);
        *images = Images { sums: standing.sums, image: standing.image };
    }
}
