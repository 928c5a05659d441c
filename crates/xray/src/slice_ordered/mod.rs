//! Line integrals in the volume's memory order (shear-warp): all slices, as seen from the source, are summed
//! into an intermediate image of integers, which is then warped once onto the detector. Every frame is
//! computed this way: where attenuating voxels extend behind the detector, a ray's samples end there; where
//! no axis suits all rays, parts of the detector have their own images.
//!
//! - Every sample is Joseph's (bilinear in a slice): two voxel rows are blended into one row of 16-bit
//!   integers, with rounding, and two neighbours in it are added with 14-bit weights whose sum is exactly
//!   2^14. All arithmetic is integer, so instruction set, number of threads and order do not change a bit.
//! - A sample depends on four voxels. A removed voxel changes the sums by its contribution to the samples
//!   around it; the image then equals that of a full render of the drilled volume.
//! - Values are multiples of a thousandth of water's attenuation (clamped at 32767 of them); previews use
//!   coarser multiples that fit into a byte, on a volume of block means.
//! - The line integral starts at the source and ends at the detector. Both can be inside the volume, even
//!   inside bone. Where one image serves all rays, anything within one slice of the source is left out.
//!
//! Memory: a copy of the volume for each axis across which slices are read (see [`SliceOrdered::memory`]),
//! created when a frame first needs it; a third one only where memory is plentiful.

mod array;
mod before;
mod copies;
mod footprint;
mod instructions;
mod kernel;
mod occupied;
mod once;
mod options;
mod parts;
mod plan;
mod runs;
mod splat;
mod standing;
mod store;
mod warp;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use instructions::Instructions;
pub(crate) use once::Images;
pub use options::{CellShares, SliceOrderedMemory, SliceOrderedOptions, Sums, Update, UpdateCost};

use crate::attenuation::MuTable;
use crate::carm::{CArm, PixelBox};
use crate::error::{DrrError, check_range};
use crate::grid::{Grid, VolumeView};
use crate::machine::Machine;
use crate::ray::RayFan;
use crate::removal::RemovedVoxels;
use occupied::OccupiedBox;
use parts::{ImagePatch, parts_of, samples_of};
use plan::{MAX_PIXELS, Rays, WEIGHT_BITS};
use standing::{CachedImages, SumsConversion, Threads};
use store::{Change, Source, Store, Values};
use warp::{Rect, pixels_of};

/// Up to this number of changed voxels, the calling thread works alone.
const ALONE_UP_TO: usize = 4096;
/// From this number of changed voxels, they are first sorted by memory position.
const SORTED_FROM: usize = 1024;

/// Projects one volume by summing its slices; caches the sums of the last C-arm for incremental updates.
pub struct SliceOrdered {
    options: SliceOrderedOptions,
    machine: &'static dyn Machine,
    grid: Grid,
    store_grid: Grid,
    values: Values,
    fill: i16,
    /// Attenuation of one unit, 1/m.
    unit_per_m: f64,
    store: Store,
    /// Bounding box of the stored voxels that attenuate.
    occupied: OccupiedBox,
    standing: Option<CachedImages>,
    /// After [`SliceOrdered::step_aside`] the previous cache; otherwise memory for the next one-off frame.
    aside: Option<CachedImages>,
    /// Memory for the first frame, already written once: the first access to a page is slow.
    fresh: (Vec<i64>, Vec<f32>),
    /// Voxels changed since the last frame, in order; not yet applied to the copies.
    waiting: Vec<Change>,
    cost: UpdateCost,
}

impl SliceOrdered {
    /// Creates a projector for a volume whose Hounsfield units map to attenuation by `table`. `unit_per_m` is
    /// the attenuation of one unit of the stored integers; removed voxels become `fill_mu_per_m`. Copies are
    /// created when the first frame needs them.
    ///
    /// # Errors
    /// An option or the unit is out of range.
    pub fn new(
        view: &VolumeView<'_>,
        table: &MuTable,
        unit_per_m: f64,
        fill_mu_per_m: f64,
        options: SliceOrderedOptions,
        machine: &'static dyn Machine,
    ) -> Result<Self, DrrError> {
        options.validate()?;
        check_range("unit_per_m", unit_per_m, 1e-9, 1e9, "1e-9 to 1e9 1/m")?;
        let values = Values::new(table, unit_per_m);
        let store = Store::new(view, &values, options.reduction as usize);
        let grid = *view.grid();
        Ok(Self {
            options,
            machine,
            grid,
            store_grid: store.grid(&grid)?,
            occupied: store.occupied(view, &values),
            values,
            fill: Values::rounded(fill_mu_per_m, unit_per_m),
            unit_per_m: unit_per_m * f64::from(store.step()),
            store,
            standing: None,
            aside: None,
            fresh: Default::default(),
            waiting: Vec::new(),
            cost: UpdateCost::default(),
        })
    }

    /// The options.
    pub fn options(&self) -> &SliceOrderedOptions {
        &self.options
    }

    /// Costs measured so far.
    pub fn cost(&self) -> UpdateCost {
        self.cost
    }

    /// Bytes held.
    pub fn memory(&self) -> SliceOrderedMemory {
        let images: usize = self.standing.iter().chain(&self.aside).map(CachedImages::bytes).sum();
        let image = images + size_of_val(&*self.fresh.0) + size_of_val(&*self.fresh.1);
        SliceOrderedMemory {
            copies: self.store.copy_bytes(),
            preview_sums: self.store.preview_bytes(),
            image,
        }
    }

    /// Which 32-voxel cells of each existing copy (for slices across x, y, z) frames have to read.
    pub fn cell_shares(&self) -> [Option<CellShares>; 3] {
        self.store.cell_shares()
    }

    /// The sums of the last frame. Their total is a checksum of the drilled volume from this view.
    pub fn sums(&self) -> Sums<'_> {
        match &self.standing {
            None => Sums { images: 0, values: &[] },
            Some(standing) => Sums { images: standing.parts.len(), values: &standing.sums },
        }
    }

    /// Restores all voxels; copies and sums are rebuilt.
    pub fn restore_all(&mut self, view: &VolumeView<'_>) {
        self.store.restore(view, &self.values);
        self.occupied = self.store.occupied(view, &self.values);
        self.standing = None;
        self.aside = None;
        self.waiting.clear();
    }

    /// Drops the C-arm's sums: the next frame is summed in full.
    pub fn forget(&mut self) {
        self.standing = None;
    }

    /// Keeps the sums of the current C-arm while frames of other C-arms are rendered, until
    /// [`SliceOrdered::step_back`]. Do not remove voxels in between: the kept sums would miss them.
    pub fn step_aside(&mut self) {
        self.settle_or_drop();
        core::mem::swap(&mut self.standing, &mut self.aside);
        // Its sums lack the voxels removed since. With zero columns it matches no C-arm.
        if let Some(standing) = &mut self.standing {
            standing.c_arm.columns = 0;
        }
    }

    /// Applies pending changes; drops the current C-arm's sums first if a full frame costs less than updating
    /// them.
    fn settle_or_drop(&mut self) {
        if self.cost.prefers_full(self.waiting.len()) {
            self.standing = None;
        }
        self.settle();
    }

    /// Returns to the C-arm in use before [`SliceOrdered::step_aside`].
    pub fn step_back(&mut self) {
        core::mem::swap(&mut self.standing, &mut self.aside);
    }

    /// Replaces a voxel by the fill value. The caller ensures that it was not removed before.
    ///
    /// # Errors
    /// The index is outside the volume.
    pub fn remove(&mut self, view: &VolumeView<'_>, linear: usize) -> Result<(), DrrError> {
        let Some(&hu) = view.hu().get(linear) else {
            let given = u32::try_from(linear).unwrap_or(u32::MAX);
            return Err(DrrError::VoxelIndex { given, position: 0, voxels: self.grid.voxels() });
        };
        let old = self.values.of(hu);
        if old != self.fill {
            self.waiting.extend(self.store.change(&self.grid, linear, old, self.fill));
            // The cached images do not cover air that is now filled with attenuating material.
            if self.fill > 0 && self.occupied.include(self.store.voxel_of(&self.grid, linear)) {
                self.standing = None;
                self.aside = None;
            }
        }
        Ok(())
    }

    /// Creates the copies and the images that this C-arm needs, so that the first frame does not wait for
    /// them.
    ///
    /// # Errors
    /// The volume or an image is too large for the memory.
    pub fn prepare(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
    ) -> Result<(), DrrError> {
        let fan = RayFan::new(&self.store_grid, c_arm);
        let parts = self.parts(&fan, c_arm);
        parts.iter().try_for_each(|part| self.ensure(view, removed, part.plan.axes.slow))?;
        if self.standing.is_none() {
            let samples = samples_of(&parts);
            self.check_memory(samples)?;
            // Non-zero, because the system only reserves pages of zeros.
            self.fresh = (vec![1; samples], vec![1.0; samples]);
        }
        Ok(())
    }

    fn parts(&self, fan: &RayFan, c_arm: &CArm) -> Vec<ImagePatch> {
        let pixels = PixelBox { columns: (0, c_arm.columns), rows: (0, c_arm.rows) };
        parts_of(&Rays { occupied: &self.occupied, fan, pixels, oversampling: self.options.oversampling })
    }

    fn ensure(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        slow: usize,
    ) -> Result<(), DrrError> {
        let source = Source { view, removed, values: &self.values, fill: self.fill, machine: self.machine };
        self.store.ensure(&source, slow)
    }

    /// Same as [`SliceOrdered::project`] if no worker threads are needed: the C-arm is unchanged and few
    /// voxels have changed. Otherwise `None`, with nothing written.
    pub fn refresh(&mut self, c_arm: &CArm, image: &mut [f64]) -> Option<Update> {
        if image.len() != c_arm.pixels() { None } else { self.refresh_on(c_arm, image, ALONE_UP_TO) }
    }

    fn refresh_on(&mut self, c_arm: &CArm, image: &mut [f64], most: usize) -> Option<Update> {
        let changes = self.waiting.len();
        let known = self.standing.as_ref().is_some_and(|s| s.c_arm == *c_arm);
        if !known || changes > most || self.cost.prefers_full(changes) {
            return None;
        }
        let threads = if most > ALONE_UP_TO { Threads::Pool } else { Threads::Caller };
        Some(self.update(image, threads))
    }

    /// Updates the line integrals of a C-arm: `image` either holds those of the last call with this C-arm, or
    /// is written completely. Runs on the threads of the caller's pool.
    ///
    /// # Errors
    /// The image has the wrong size, or the volume is too large for the memory.
    pub fn project(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
        image: &mut [f64],
    ) -> Result<Update, DrrError> {
        if image.len() != c_arm.pixels() {
            return Err(DrrError::Length { field: "image", given: image.len(), expected: c_arm.pixels() });
        }
        if let Some(update) = self.refresh_on(c_arm, image, usize::MAX) {
            return Ok(update);
        }
        let fan = RayFan::new(&self.store_grid, c_arm);
        // Reuse the old sums' memory.
        let (sums, image_floats) =
            self.standing.take().map_or_else(|| core::mem::take(&mut self.fresh), |s| (s.sums, s.image));
        self.settle();
        let parts = self.parts(&fan, c_arm);
        parts.iter().try_for_each(|part| self.ensure(view, removed, part.plan.axes.slow))?;
        self.check_memory(samples_of(&parts))?;
        let mut standing = CachedImages { c_arm: *c_arm, fan, parts, sums, image: image_floats };
        self.cost.full_ns = self.sum(&mut standing);
        self.develop(&mut standing, image);
        self.standing = Some(standing);
        Ok(Update::Full)
    }

    /// Sums all slices of the parts; returns how long it took, ns.
    fn sum(&self, standing: &mut CachedImages) -> f64 {
        let CachedImages { parts, sums, image, .. } = standing;
        let samples = samples_of(parts);
        let began_ns = self.machine.now_ns();
        // Every sample is overwritten.
        sums.resize(samples, 0);
        image.resize(samples, 0.0);
        self.store.sum(parts, self.options.instructions, sums);
        self.machine.now_ns().saturating_sub(began_ns) as f64
    }

    /// Sharpens the sums of all parts and warps them to the detector.
    fn develop(&self, standing: &mut CachedImages, image: &mut [f64]) {
        let show = self.show(Threads::Pool);
        for part in 0..standing.parts.len() {
            let plan = &standing.parts[part].plan;
            let all = Rect { columns: (0, plan.columns), rows: (0, plan.rows) };
            show.sharpen(standing, part, &all);
        }
        let CArm { columns, rows, .. } = standing.c_arm;
        show.draw(standing, &PixelBox { columns: (0, columns), rows: (0, rows) }, image);
    }

    /// Refuses intermediate images of more than 1 GiB that the memory cannot hold.
    fn check_memory(&self, samples: usize) -> Result<(), DrrError> {
        const BYTES_EACH: usize = size_of::<i64>() + size_of::<f32>();
        let needed_bytes = samples as u64 * BYTES_EACH as u64;
        let available = || self.machine.available_bytes().filter(|available| needed_bytes > *available);
        match (samples as f64 > MAX_PIXELS).then(available).flatten() {
            None => Ok(()),
            Some(available_bytes) => Err(DrrError::Images { samples, needed_bytes, available_bytes }),
        }
    }

    /// Applies the pending changes to the copies, and to the current C-arm's sums if there are any.
    fn settle(&mut self) {
        if self.waiting.is_empty() {
            return;
        }
        let began_ns = self.machine.now_ns();
        if self.waiting.len() >= SORTED_FROM {
            // The sort is stable, so changes of the same voxel keep their order.
            self.waiting.sort_by_key(|change| change.linear);
        }
        self.store.apply(self.standing.as_mut(), &self.waiting);
        if self.standing.is_some() {
            let elapsed_ns = self.machine.now_ns().saturating_sub(began_ns);
            self.cost.note_update(elapsed_ns, self.waiting.len());
        }
        self.waiting.clear();
    }

    /// Applies the pending changes and redraws the affected pixels.
    fn update(&mut self, image: &mut [f64], threads: Threads) -> Update {
        self.settle();
        let Some(mut standing) = self.standing.take() else { return Update::Unchanged };
        let show = self.show(threads);
        let mut changed = Vec::new();
        for n in 0..standing.parts.len() {
            let part = &mut standing.parts[n];
            let dirty = core::mem::take(&mut part.dirty);
            let (columns, rows) = (part.plan.columns, part.plan.rows);
            for rect in dirty.rects() {
                changed.extend(pixels_of(&standing.parts[n], &standing.fan, rect));
                show.sharpen(&mut standing, n, &rect.grown(1, columns, rows));
            }
        }
        let side = |(first, end): (u32, u32)| (end - first) as usize;
        let mut written = 0;
        for pixels in &changed {
            written += side(pixels.columns) * side(pixels.rows);
            show.draw(&standing, pixels, image);
        }
        self.standing = Some(standing);
        if written == 0 { Update::Unchanged } else { Update::Changed(written) }
    }

    fn show(&self, threads: Threads) -> SumsConversion {
        let unit = f64::from(i32::from(self.store.widening()) << WEIGHT_BITS);
        SumsConversion {
            instructions: self.options.instructions,
            alpha: self.options.alpha(),
            scale_per_m: self.unit_per_m / unit,
            threads,
        }
    }
}
