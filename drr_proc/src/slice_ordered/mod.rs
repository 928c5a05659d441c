//! Line integrals in the volume's own memory order: all slices are summed, as the source sees them, into an intermediate image
//! of integers, and that is warped once onto the detector.
//!
//! - Every sample is Joseph's (bilinear in a slice): two rows of voxels are blended into one of 16-bit integers, rounded, and two
//!   neighbours in it are added with 14-bit weights whose sum is 2^14 exactly. All are exact integers, so neither instruction set
//!   nor number of threads nor order changes a bit.
//! - A sample depends on four voxels: a removed one is worked into the sums by the difference that it makes to the samples around
//!   it, and the image equals that of a full render of the drilled volume.
//! - Values are multiples of a thousandth of water's attenuation (clamped at 32767 of them); previews use coarser multiples
//!   that fit a byte, on a volume of block means.
//! - The line integral begins at the source: what lies behind it, or within one slice of it, is not in the picture. A source inside
//!   the volume, or inside bone, is therefore no error.
//!
//! Memory: one copy of the volume for each of two orders (see [`SliceOrdered::memory`]), made when a frame first needs it.

mod copies;
mod instructions;
mod kernel;
mod pages;
mod plan;
mod splat;
mod warp;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::prelude::*;

pub use instructions::Instructions;

use crate::attenuation::MuTable;
use crate::carm::{CArm, PixelBox};
use crate::error::{DrrError, check_range};
use crate::grid::{Grid, VolumeView};
use crate::ray::RayFan;
use crate::removal::RemovedVoxels;
use copies::{Copy3, Voxel, copy_elements};
use kernel::{TILES, Work};
use plan::{LEAST_OVERSAMPLING, Plan, TILE_ROWS, WEIGHT_BITS};
use splat::{Dirty, Splatter, slices_until_flush};
use warp::{Rect, SharpenRow, Warp, WarpRow, pixels_of};

/// Fewer pixels than this are warped without waking the worker threads.
const PARALLEL_FROM: usize = 1 << 14;
/// Most changed voxels that are worked in without the worker threads.
const ALONE_UP_TO: usize = 4096;
/// Fewest changed voxels that are worked in in the order of memory instead of their own.
const SORTED_FROM: usize = 1024;
/// Updates by which a measured cost is averaged.
const SMOOTHING: f64 = 0.25;

/// How the sum is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SliceOrderedOptions {
    /// Samples of the intermediate image for each voxel of the farthest slice, 0.8 to 4.
    pub oversampling: f64,
    /// Whether the blur of the interpolation is taken back.
    pub sharpen: bool,
    /// Voxels along each axis that are joined to one, 1 to 8. Above 1, values are stored in bytes.
    pub reduction: u32,
    /// Instructions to use.
    pub instructions: Instructions,
}

impl Default for SliceOrderedOptions {
    fn default() -> Self {
        Self { oversampling: 1.0, sharpen: true, reduction: 1, instructions: Instructions::best() }
    }
}

impl SliceOrderedOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// The first field that is out of range, by name.
    pub fn validate(&self) -> Result<(), DrrError> {
        check_range("oversampling", self.oversampling, LEAST_OVERSAMPLING, 4.0, "0.8 to 4")?;
        check_range("reduction", f64::from(self.reduction), 1.0, 8.0, "1 to 8")
    }

    fn alpha(&self) -> f64 {
        if self.sharpen { self.oversampling * self.oversampling / 12.0 } else { 0.0 }
    }
}

/// How a frame came about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Update {
    /// All slices were summed.
    Full,
    /// Changed voxels were taken out of the cached sums, and this number of pixels was written.
    Changed(usize),
    /// Nothing had changed.
    Unchanged,
}

/// Bytes that a [`SliceOrdered`] holds, and what they are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SliceOrderedMemory {
    /// Copy with rows along x; 0 if no frame has needed it.
    pub along_x: usize,
    /// Copy with rows along y; 0 if no frame has needed it.
    pub along_y: usize,
    /// Sums of the blocks of a preview.
    pub preview_sums: usize,
    /// Intermediate images, as integers and as floats: one, and another once a frame was rendered aside.
    pub image: usize,
}

impl SliceOrderedMemory {
    /// All of it.
    pub fn total(&self) -> usize {
        self.along_x + self.along_y + self.preview_sums + self.image
    }
}

/// Times measured while running, nanoseconds, which decide how changes are worked in (never what comes out).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UpdateCost {
    /// Nanoseconds of the last full sum over slices.
    pub full_ns: f64,
    /// Nanoseconds of taking out one voxel, averaged over the last updates; 0 before the first.
    pub voxel_ns: f64,
}

impl UpdateCost {
    /// Whether taking out `voxels` is estimated to take longer than summing all slices.
    fn prefers_full(&self, voxels: usize) -> bool {
        voxels as f64 * self.voxel_ns > self.full_ns
    }
}

/// A voxel of the store by linear index, and what it becomes.
type Change = (u32, i16);

/// The two copies.
struct Copies<T: Voxel> {
    dims: [usize; 3],
    by_fast: [Option<Copy3<T>>; 2],
    largest: i16,
}

impl<T: Voxel> Copies<T> {
    fn new(dims: [usize; 3]) -> Self {
        Self { dims, by_fast: [None, None], largest: 0 }
    }

    fn set(&mut self, voxel: [usize; 3], value: i16) {
        self.largest = self.largest.max(value);
        self.by_fast.iter_mut().flatten().for_each(|copy| copy.set(voxel, value));
    }

    /// Works changes into the sums of a C-arm, and into the copies.
    fn splat(&mut self, standing: &mut Standing, changes: &[Change]) {
        let Standing { plan, sums, dirty, .. } = standing;
        let mut splatter = Splatter::default();
        for &(linear, value) in changes {
            let voxel = self.voxel_of(linear);
            if let Some(copy) = &self.by_fast[plan.axes.u] {
                splatter.splat(copy, plan, sums, (voxel, value), dirty);
            }
            self.set(voxel, value);
        }
    }

    fn voxel_of(&self, linear: u32) -> [usize; 3] {
        let [nx, ny, _] = self.dims;
        let linear = linear as usize;
        [linear % nx, linear / nx % ny, linear / nx / ny]
    }

    fn set_all(&mut self, changes: &[Change]) {
        for &(linear, value) in changes {
            self.set(self.voxel_of(linear), value);
        }
    }

    /// Makes a copy if it is missing; `changed` are the voxels that differ from `fill_row`'s.
    fn ensure(
        &mut self,
        fast: usize,
        fill_row: impl Fn(usize, usize, &mut [T]) + Sync,
        changed: impl Iterator<Item = ([usize; 3], i16)>,
    ) -> Result<(), DrrError> {
        if self.by_fast[fast].is_some() {
            return Ok(());
        }
        check_memory(self.dims, fast, size_of::<T>())?;
        let copy = Copy3::new(self.dims, fast, fill_row);
        let mut copy =
            copy.map_err(|_| refusal(self.dims, fast, size_of::<T>(), available_memory().unwrap_or(0)))?;
        self.largest = self.largest.max(copy.largest());
        changed.for_each(|(voxel, value)| copy.set(voxel, value));
        self.by_fast[fast] = Some(copy);
        Ok(())
    }

    fn sum(&self, plan: &Plan, with: Instructions, sums: &mut Vec<i64>) {
        // Every tile is written whole.
        sums.resize(plan.pixels(), 0);
        let Some(copy) = &self.by_fast[plan.axes.u] else { return };
        let flush_after = slices_until_flush(self.largest * T::UNIT);
        // One at a time, because those in the middle of the picture take longest; work space goes from one to the next.
        let spare = Mutex::new(Vec::new());
        let spare = || spare.lock().unwrap_or_else(PoisonError::into_inner);
        let tiles = sums.par_chunks_mut((TILES * TILE_ROWS * plan.columns).max(1)).enumerate();
        tiles.with_max_len(1).for_each(|(tiles, out)| {
            let work = spare().pop();
            let mut work = work.unwrap_or_else(|| Work::new(plan, copy));
            with.sum_tiles(copy, plan, flush_after, tiles * TILES * TILE_ROWS, &mut work, out);
            spare().push(work);
        });
    }

    fn bytes(&self) -> [usize; 2] {
        [0, 1].map(|fast| self.by_fast[fast].as_ref().map_or(0, Copy3::bytes))
    }
}

/// What is stored.
enum Store {
    Whole(Copies<i16>),
    Preview { copies: Copies<u8>, blocks: Blocks },
}

/// Sums of the values of cubes of voxels: what a preview's values come from.
struct Blocks {
    side: usize,
    dims: [usize; 3],
    sums: Vec<u32>,
    /// Units in one step of a byte.
    step: u32,
}

impl Blocks {
    fn new(view: &VolumeView<'_>, values: &[i16; 65536], side: usize) -> Self {
        let [nx, ny, nz] = view.grid().dims();
        let dims = [nx, ny, nz].map(|n| n.div_ceil(side));
        let mut sums = vec![0_u32; dims[0] * dims[1] * dims[2]];
        sums.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(bz, plane)| {
            for z in bz * side..((bz + 1) * side).min(nz) {
                for y in 0..ny {
                    let start = nx * (y + ny * z);
                    let line = &mut plane[dims[0] * (y / side)..][..dims[0]];
                    for (sum, voxels) in line.iter_mut().zip(view.hu()[start..start + nx].chunks(side)) {
                        *sum += voxels.iter().map(|&hu| u32::from(value_of(values, hu) as u16)).sum::<u32>();
                    }
                }
            }
        });
        let count = (side * side * side) as u32;
        let largest = sums.par_iter().copied().max().unwrap_or(0).div_ceil(count);
        Self { side, dims, sums, step: largest.div_ceil(255).max(1) }
    }

    /// Value of a block in steps: the rounded mean; voxels that the volume does not have count as air.
    fn value(&self, sum: u32) -> i16 {
        let unit = (self.side * self.side * self.side) as u32 * self.step;
        ((sum + unit / 2) / unit).min(255) as i16
    }

    fn grid(&self, grid: &Grid) -> Result<Grid, DrrError> {
        let centre = 0.5 * (self.side as f64 - 1.0);
        let direction = grid.direction();
        let spacing_m = grid.spacing_m().map(|s| s * self.side as f64);
        Grid::new(self.dims, spacing_m, grid.index_to_world([centre; 3]), direction)
    }
}

/// The cached image of one C-arm.
struct Standing {
    c_arm: CArm,
    fan: RayFan,
    plan: Plan,
    sums: Vec<i64>,
    image: Vec<f32>,
    /// What has changed in the sums and not yet in the image.
    dirty: Dirty,
}

/// Projects one volume by summing its slices, and keeps the sums of the last C-arm for changes.
pub struct SliceOrdered {
    options: SliceOrderedOptions,
    grid: Grid,
    store_grid: Grid,
    values: Box<[i16; 65536]>,
    fill: i16,
    /// Attenuation of one unit, 1/m.
    unit_per_m: f64,
    store: Store,
    standing: Option<Standing>,
    /// What stood before [`SliceOrdered::step_aside`]; otherwise the memory of what was rendered aside.
    aside: Option<Standing>,
    /// Voxels changed since the last frame, in their order; the copies do not have them yet.
    waiting: Vec<Change>,
    cost: UpdateCost,
}

fn value_of(values: &[i16; 65536], hu: i16) -> i16 {
    values[usize::from(hu as u16 ^ 0x8000)]
}

impl SliceOrdered {
    /// For a volume whose Hounsfield units mean the attenuation in `table`; `unit_per_m` is the attenuation of one unit of the stored
    /// integers, and removed voxels become `fill_mu_per_m`. Copies are made when the first frame needs them.
    ///
    /// # Errors
    /// An option or a unit out of range.
    pub fn new(
        view: &VolumeView<'_>,
        table: &MuTable,
        unit_per_m: f64,
        fill_mu_per_m: f64,
        options: SliceOrderedOptions,
    ) -> Result<Self, DrrError> {
        options.validate()?;
        check_range("unit_per_m", unit_per_m, 1e-9, 1e9, "1e-9 to 1e9 1/m")?;
        let units = |mu: f64| libm::round(mu / unit_per_m).clamp(0.0, f64::from(i16::MAX)) as i16;
        let mut values = Box::new([0_i16; 65536]);
        for (hu, value) in (i16::MIN..=i16::MAX).zip(values.iter_mut()) {
            *value = units(table.mu_per_m(hu));
        }
        let grid = *view.grid();
        let (store, store_grid, unit_per_m) = if options.reduction == 1 {
            (Store::Whole(Copies::new(grid.dims())), grid, unit_per_m)
        } else {
            let blocks = Blocks::new(view, &values, options.reduction as usize);
            let (store_grid, step) = (blocks.grid(&grid)?, f64::from(blocks.step));
            (Store::Preview { copies: Copies::new(blocks.dims), blocks }, store_grid, unit_per_m * step)
        };
        Ok(Self {
            options,
            grid,
            store_grid,
            values,
            fill: units(fill_mu_per_m),
            unit_per_m,
            store,
            standing: None,
            aside: None,
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
        let ([along_x, along_y], preview_sums) = match &self.store {
            Store::Whole(copies) => (copies.bytes(), 0),
            Store::Preview { copies, blocks } => (copies.bytes(), blocks.sums.len() * 4),
        };
        let of = |standing: &Standing| standing.sums.len() * 8 + standing.image.len() * 4;
        let image = self.standing.iter().chain(&self.aside).map(of).sum();
        SliceOrderedMemory { along_x, along_y, preview_sums, image }
    }

    /// Share of the cells of 32 voxels that are not skipped, of the copies that exist (along x, along y).
    pub fn occupied_shares(&self) -> [Option<f64>; 2] {
        match &self.store {
            Store::Whole(copies) => copies.by_fast.each_ref().map(|c| c.as_ref().map(Copy3::occupied_share)),
            Store::Preview { copies, .. } => {
                copies.by_fast.each_ref().map(|c| c.as_ref().map(Copy3::occupied_share))
            }
        }
    }

    /// The sums of the last frame: columns, rows, and integers row by row. Their sum is a checksum of the drilled volume as seen.
    pub fn sums(&self) -> (usize, usize, &[i64]) {
        self.standing.as_ref().map_or((0, 0, &[]), |s| (s.plan.columns, s.plan.rows, &s.sums))
    }

    /// Puts all voxels back: copies, sums and all.
    pub fn restore_all(&mut self, view: &VolumeView<'_>) {
        match &mut self.store {
            Store::Whole(copies) => *copies = Copies::new(copies.dims),
            Store::Preview { copies, blocks } => {
                *copies = Copies::new(copies.dims);
                *blocks = Blocks::new(view, &self.values, blocks.side);
            }
        }
        self.standing = None;
        self.aside = None;
        self.waiting.clear();
    }

    /// Forgets the sums of the C-arm: the next frame is a full one.
    pub fn forget(&mut self) {
        self.standing = None;
    }

    /// Keeps the sums of the standing C-arm while frames of others are rendered, until [`SliceOrdered::step_back`]. Voxels removed in
    /// between reach the standing C-arm only if they are removed before or after.
    pub fn step_aside(&mut self) {
        if self.cost.prefers_full(self.waiting.len()) {
            self.standing = None;
        }
        self.settle();
        core::mem::swap(&mut self.standing, &mut self.aside);
        // Its sums lack what has been removed since.
        if let Some(standing) = &mut self.standing {
            standing.c_arm.columns = 0;
        }
    }

    /// Returns to the C-arm that stood before [`SliceOrdered::step_aside`].
    pub fn step_back(&mut self) {
        core::mem::swap(&mut self.standing, &mut self.aside);
    }

    /// A voxel becomes what fills removed ones. The caller makes sure that it had not been removed.
    ///
    /// # Errors
    /// An index outside the volume.
    pub fn remove(&mut self, view: &VolumeView<'_>, linear: usize) -> Result<(), DrrError> {
        let Some(&hu) = view.hu().get(linear) else {
            let given = u32::try_from(linear).unwrap_or(u32::MAX);
            return Err(DrrError::VoxelIndex { given, position: 0, voxels: self.grid.voxels() });
        };
        let old = value_of(&self.values, hu);
        if old == self.fill {
            return Ok(());
        }
        let change = match &mut self.store {
            Store::Whole(_) => Some((linear, self.fill)),
            Store::Preview { blocks, .. } => {
                let block = self.grid.voxel_of(linear).map(|v| v / blocks.side);
                let at = block[0] + blocks.dims[0] * (block[1] + blocks.dims[1] * block[2]);
                let before = blocks.value(blocks.sums[at]);
                blocks.sums[at] = blocks.sums[at] + u32::from(self.fill as u16) - u32::from(old as u16);
                let after = blocks.value(blocks.sums[at]);
                (before != after).then_some((at, after))
            }
        };
        self.waiting.extend(change.map(|(linear, value)| (linear as u32, value)));
        Ok(())
    }

    /// Makes the copy that frames of this C-arm need, so that the first one does not wait for it. False if the C-arm's rays have to be
    /// traced one by one: no axis of the volume is within a slope of 4 voxels a slice of all of them, or the volume reaches
    /// behind the detector.
    ///
    /// # Errors
    /// A volume too large for the memory.
    pub fn prepare(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
    ) -> Result<bool, DrrError> {
        let fan = RayFan::new(&self.store_grid, c_arm);
        match Plan::new(&self.store_grid, &fan, [c_arm.columns, c_arm.rows], self.options.oversampling) {
            Some(plan) => self.ensure(view, removed, plan.axes.u).map(|()| true),
            None => Ok(false),
        }
    }

    fn ensure(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        fast: usize,
    ) -> Result<(), DrrError> {
        let (values, fill, grid) = (&self.values, self.fill, &self.grid);
        match &mut self.store {
            Store::Whole(copies) => {
                let [nx, ny, _] = grid.dims();
                let fill_row = |y: usize, z: usize, row: &mut [i16]| {
                    let start = nx * (y + ny * z);
                    for (v, &hu) in row.iter_mut().zip(&view.hu()[start..start + nx]) {
                        *v = value_of(values, hu);
                    }
                };
                copies.ensure(fast, fill_row, removed.iter().map(|linear| (grid.voxel_of(linear), fill)))
            }
            Store::Preview { copies, blocks } => {
                let [nx, ny, _] = blocks.dims;
                let fill_row = |y: usize, z: usize, row: &mut [u8]| {
                    let start = nx * (y + ny * z);
                    for (v, &sum) in row.iter_mut().zip(&blocks.sums[start..start + nx]) {
                        *v = u8::store(blocks.value(sum));
                    }
                };
                copies.ensure(fast, fill_row, core::iter::empty())
            }
        }
    }

    /// As [`SliceOrdered::project`], where that needs no worker threads: the C-arm stands and few voxels have changed. `None`, and
    /// nothing written, otherwise.
    pub fn refresh(&mut self, c_arm: &CArm, image: &mut [f64]) -> Option<Update> {
        if image.len() != c_arm.pixels() { None } else { self.refresh_on(c_arm, image, ALONE_UP_TO) }
    }

    fn refresh_on(&mut self, c_arm: &CArm, image: &mut [f64], most: usize) -> Option<Update> {
        let changes = self.waiting.len();
        let known = self.standing.as_ref().is_some_and(|s| s.c_arm == *c_arm);
        if !known || changes > most || self.cost.prefers_full(changes) {
            return None;
        }
        Some(self.update(image, most > ALONE_UP_TO))
    }

    /// Brings the line integrals of a C-arm up to date: `image` holds those of the last call with this C-arm, or is written whole. `None`
    /// if the rays have to be traced one by one (see [`SliceOrdered::prepare`]); then nothing is written. Runs on the threads of
    /// the caller's pool.
    ///
    /// # Errors
    /// An image of another size, a volume too large for the memory.
    pub fn project(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
        image: &mut [f64],
    ) -> Result<Option<Update>, DrrError> {
        if image.len() != c_arm.pixels() {
            return Err(DrrError::Length { field: "image", given: image.len(), expected: c_arm.pixels() });
        }
        if let Some(update) = self.refresh_on(c_arm, image, usize::MAX) {
            return Ok(Some(update));
        }
        let fan = RayFan::new(&self.store_grid, c_arm);
        let pixels = [c_arm.columns, c_arm.rows];
        // The sums are made anew, in the same memory.
        let memory = self.standing.take().map_or_else(Default::default, |s| (s.sums, s.image));
        self.settle();
        let Some(plan) = Plan::new(&self.store_grid, &fan, pixels, self.options.oversampling) else {
            return Ok(None);
        };
        self.ensure(view, removed, plan.axes.u)?;
        let began = Instant::now();
        let (mut sums, floats): (Vec<i64>, Vec<f32>) = memory;
        match &self.store {
            Store::Whole(copies) => copies.sum(&plan, self.options.instructions, &mut sums),
            Store::Preview { copies, .. } => copies.sum(&plan, self.options.instructions, &mut sums),
        }
        self.cost.full_ns = began.elapsed().as_nanos() as f64;
        let mut standing =
            Standing { c_arm: *c_arm, fan, plan, sums, image: floats, dirty: Dirty::default() };
        standing.image.resize(standing.plan.pixels(), 0.0);
        let all = Rect { columns: (0, standing.plan.columns), rows: (0, standing.plan.rows) };
        let detector = PixelBox { columns: (0, c_arm.columns), rows: (0, c_arm.rows) };
        self.show(&mut standing, &all, &detector, image, true);
        self.standing = Some(standing);
        Ok(Some(Update::Full))
    }

    /// Works the waiting changes into the sums of the standing C-arm, or into the copies alone.
    fn settle(&mut self) {
        if self.waiting.is_empty() {
            return;
        }
        let began = Instant::now();
        if self.waiting.len() >= SORTED_FROM {
            // In the order in which they lie in memory; changes of the same voxel stay in theirs.
            self.waiting.sort_by_key(|&(linear, _)| linear);
        }
        match (&mut self.standing, &mut self.store) {
            (Some(standing), Store::Whole(copies)) => copies.splat(standing, &self.waiting),
            (Some(standing), Store::Preview { copies, .. }) => copies.splat(standing, &self.waiting),
            (None, Store::Whole(copies)) => copies.set_all(&self.waiting),
            (None, Store::Preview { copies, .. }) => copies.set_all(&self.waiting),
        }
        if self.standing.is_some() {
            let each_ns = began.elapsed().as_nanos() as f64 / self.waiting.len() as f64;
            let before = self.cost.voxel_ns;
            self.cost.voxel_ns =
                if before == 0.0 { each_ns } else { before + SMOOTHING * (each_ns - before) };
        }
        self.waiting.clear();
    }

    /// Works the waiting changes in and shows what has changed.
    fn update(&mut self, image: &mut [f64], parallel: bool) -> Update {
        self.settle();
        let Some(mut standing) = self.standing.take() else { return Update::Unchanged };
        let dirty = core::mem::take(&mut standing.dirty);
        let (columns, rows) = (standing.plan.columns, standing.plan.rows);
        let pixels = [standing.c_arm.columns, standing.c_arm.rows];
        let mut written = 0;
        for rect in dirty.rects() {
            let changed = pixels_of(&standing.plan, &standing.fan, rect, pixels);
            let changed = changed.unwrap_or(PixelBox { columns: (0, 0), rows: (0, 0) });
            let side = |(first, end): (u32, u32)| (end - first) as usize;
            written += side(changed.columns) * side(changed.rows);
            self.show(&mut standing, &rect.grown(1, columns, rows), &changed, image, parallel);
        }
        self.standing = Some(standing);
        if written == 0 { Update::Unchanged } else { Update::Changed(written) }
    }

    /// What one unit of the stored values is in the sums, before the weights.
    fn stored_unit(&self) -> i16 {
        match &self.store {
            Store::Whole(_) => <i16 as Voxel>::UNIT,
            Store::Preview { .. } => <u8 as Voxel>::UNIT,
        }
    }

    /// Sharpens a rectangle of the sums and warps it to a rectangle of the detector.
    fn show(
        &self,
        standing: &mut Standing,
        rect: &Rect,
        detector: &PixelBox,
        image: &mut [f64],
        parallel: bool,
    ) {
        let Standing { c_arm, fan, plan, sums, image: floats, .. } = standing;
        let with = self.options.instructions;
        let alpha = self.options.alpha();
        let width = plan.columns;
        let sharpen = |(row, line): (usize, &mut [f32])| {
            with.run(SharpenRow { sums, plan, row, columns: rect.columns, alpha, out: line });
        };
        let (first, end) = rect.rows;
        let lines = &mut floats[first * width..end * width];
        if !parallel || lines.len() < PARALLEL_FROM || rect.columns.1 - rect.columns.0 < 64 {
            lines.chunks_mut(width.max(1)).enumerate().for_each(|(n, line)| sharpen((first + n, line)));
        } else {
            let numbered = lines.par_chunks_mut(width.max(1)).enumerate().with_min_len(8);
            numbered.for_each(|(n, line)| sharpen((first + n, line)));
        }
        let scale_per_m = self.unit_per_m / f64::from(i32::from(self.stored_unit()) << WEIGHT_BITS);
        let warp = Warp { plan, fan, image: floats, scale_per_m };
        let (c0, c1) = (detector.columns.0 as usize, detector.columns.1 as usize);
        let (r0, r1) = (detector.rows.0 as usize, detector.rows.1 as usize);
        let columns = c_arm.columns as usize;
        let rows = &mut image[r0 * columns..r1 * columns];
        let draw = |(n, line): (usize, &mut [f64])| {
            let out = &mut line[c0..c1];
            with.run(WarpRow { warp: &warp, row: (r0 + n) as u32, first_column: detector.columns.0, out });
        };
        if !parallel || (r1 - r0) * (c1 - c0) < PARALLEL_FROM {
            rows.chunks_mut(columns).enumerate().for_each(draw);
        } else {
            rows.par_chunks_mut(columns).enumerate().with_min_len(8).for_each(draw);
        }
    }
}

/// Refuses a copy that the machine's free memory cannot hold.
fn check_memory(dims: [usize; 3], fast: usize, bytes_each: usize) -> Result<(), DrrError> {
    let needed = copy_elements(dims, fast) * bytes_each as u64;
    match available_memory() {
        Some(available) if needed > available => Err(refusal(dims, fast, bytes_each, available)),
        _ => Ok(()),
    }
}

fn refusal(dims: [usize; 3], fast: usize, bytes_each: usize, available_bytes: u64) -> DrrError {
    let needed_bytes = copy_elements(dims, fast) * bytes_each as u64;
    DrrError::Memory { dims, bytes_each, needed_bytes, available_bytes }
}

/// `MemAvailable` of `/proc/meminfo` (proc_meminfo(5)), in bytes; `None` where there is none.
fn available_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}
