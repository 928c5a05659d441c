//! The volume in summing format: reordered copies of its values, or of its block means.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::Machine;
use super::copies::{Copy3, Voxel, copy_elements};
use super::instructions::Instructions;
use super::kernel::{TILES, Work};
use super::occupied::OccupiedBox;
use super::options::CellShares;
use super::parts::ImagePatch;
use super::plan::{Axes, TILE_ROWS};
use super::splat::{Splatter, slices_until_flush};
use super::standing::CachedImages;
use crate::attenuation::MuTable;
use crate::error::DrrError;
use crate::grid::{Grid, VolumeView};
use crate::pieces::least_hu;
use crate::removal::RemovedVoxels;
use crate::vector::scale;

/// The copy for slices across z, for which another copy can substitute, is created only if it takes at most
/// one part in this many of the free memory.
const SHARE_OF_THIRD: u64 = 4;

/// A stored voxel whose value changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Change {
    /// Linear index in the store.
    pub linear: u32,
    pub value: i16,
}

/// The stored value of every Hounsfield unit.
pub(super) struct Values(Box<[i16; 65536]>);

impl Values {
    /// Attenuations as multiples of `unit_per_m`.
    pub fn new(table: &MuTable, unit_per_m: f64) -> Self {
        let mut values = Box::new([0_i16; 65536]);
        for (hu, value) in (i16::MIN..=i16::MAX).zip(values.iter_mut()) {
            *value = Self::rounded(table.mu_per_m(hu), unit_per_m);
        }
        Self(values)
    }

    /// An attenuation as a multiple of `unit_per_m`.
    pub fn rounded(mu_per_m: f64, unit_per_m: f64) -> i16 {
        libm::round(mu_per_m / unit_per_m).clamp(0.0, f64::from(i16::MAX)) as i16
    }

    #[inline(always)]
    pub fn of(&self, hu: i16) -> i16 {
        self.0[usize::from(hu as u16 ^ 0x8000)]
    }
}

/// The stored data.
pub(super) enum Store {
    /// Every voxel.
    Whole(Copies<i16>),
    /// The block means, as bytes.
    Preview { copies: Copies<u8>, blocks: Blocks },
}

/// Runs the same code for both kinds of copies.
macro_rules! with_copies {
    ($store:expr, $copies:ident => $code:expr) => {
        match $store {
            Store::Whole($copies) => $code,
            Store::Preview { copies: $copies, .. } => $code,
        }
    };
}

impl Store {
    /// Averages `reduction` voxels per axis into one.
    pub fn new(view: &VolumeView<'_>, values: &Values, reduction: usize) -> Self {
        if reduction == 1 {
            return Self::Whole(Copies::new(view.grid().dims()));
        }
        let blocks = Blocks::new(view, values, reduction);
        Self::Preview { copies: Copies::new(blocks.dims), blocks }
    }

    /// The grid of the stored data.
    pub fn grid(&self, grid: &Grid) -> Result<Grid, DrrError> {
        match self {
            Self::Whole(_) => Ok(*grid),
            Self::Preview { blocks, .. } => blocks.grid(grid),
        }
    }

    /// Units per step of a stored value.
    pub fn step(&self) -> u32 {
        match self {
            Self::Whole(_) => 1,
            Self::Preview { blocks, .. } => blocks.step,
        }
    }

    /// Factor applied to a stored value before weighting.
    pub fn widening(&self) -> i16 {
        match self {
            Self::Whole(_) => <i16 as Voxel>::UNIT,
            Self::Preview { .. } => <u8 as Voxel>::UNIT,
        }
    }

    /// Drops all copies and changes.
    pub fn restore(&mut self, view: &VolumeView<'_>, values: &Values) {
        *self = match self {
            Self::Whole(_) => Self::new(view, values, 1),
            Self::Preview { blocks, .. } => Self::new(view, values, blocks.side),
        };
    }

    /// The change in the store when a voxel of the volume changes from one value to another; `None` if the
    /// stored values stay the same.
    pub fn change(&mut self, grid: &Grid, linear: usize, from: i16, to: i16) -> Option<Change> {
        match self {
            Self::Whole(_) => Some(Change { linear: linear as u32, value: to }),
            Self::Preview { blocks, .. } => {
                let [i, j, k] = blocks.block_of(grid, linear);
                let at = i + blocks.dims[0] * (j + blocks.dims[1] * k);
                let before = blocks.value(blocks.sums[at]);
                blocks.sums[at] = blocks.sums[at] + u32::from(to as u16) - u32::from(from as u16);
                let after = blocks.value(blocks.sums[at]);
                (before != after).then_some(Change { linear: at as u32, value: after })
            }
        }
    }

    /// The stored voxel that a voxel of the volume is part of.
    pub fn voxel_of(&self, grid: &Grid, linear: usize) -> [usize; 3] {
        match self {
            Self::Whole(_) => grid.voxel_of(linear),
            Self::Preview { blocks, .. } => blocks.block_of(grid, linear),
        }
    }

    /// The box of the stored voxels that attenuate.
    pub fn occupied(&self, view: &VolumeView<'_>, values: &Values) -> OccupiedBox {
        match self {
            Self::Whole(_) => {
                let attenuates = |hu: i16| values.of(hu) > 0;
                OccupiedBox::of(view.grid().dims(), view.hu(), least_hu(attenuates), attenuates)
            }
            Self::Preview { blocks, .. } => {
                OccupiedBox::of(blocks.dims, &blocks.sums, 1, |sum| blocks.value(sum) > 0)
            }
        }
    }

    /// Creates the copy that slices across `slow` are read from, if it is missing.
    pub fn ensure(&mut self, source: &Source<'_>, slow: usize) -> Result<(), DrrError> {
        let Source { view, removed, values, fill, machine } = *source;
        match self {
            Self::Whole(copies) => {
                let grid = view.grid();
                let [nx, ny, _] = grid.dims();
                let fill_row = |y: usize, z: usize, row: &mut [i16]| {
                    let start = nx * (y + ny * z);
                    for (v, &hu) in row.iter_mut().zip(&view.hu()[start..start + nx]) {
                        *v = values.of(hu);
                    }
                };
                let changed = removed.iter().map(|linear| (grid.voxel_of(linear), fill));
                copies.ensure(machine, slow, fill_row, changed)
            }
            Self::Preview { copies, blocks } => {
                let [nx, ny, _] = blocks.dims;
                let fill_row = |y: usize, z: usize, row: &mut [u8]| {
                    let start = nx * (y + ny * z);
                    for (v, &sum) in row.iter_mut().zip(&blocks.sums[start..start + nx]) {
                        *v = u8::store(blocks.value(sum));
                    }
                };
                copies.ensure(machine, slow, fill_row, core::iter::empty())
            }
        }
    }

    /// Sums all slices of all images; `sums` holds these one after the other.
    pub fn sum(&self, parts: &[ImagePatch], instructions: Instructions, sums: &mut [i64]) {
        with_copies!(self, copies => copies.sum(parts, instructions, sums));
    }

    /// Applies changes to the current C-arm's sums, if there are any, and to the copies.
    pub fn apply(&mut self, standing: Option<&mut CachedImages>, changes: &[Change]) {
        with_copies!(self, copies => match standing {
            Some(standing) => copies.splat(standing, changes),
            None => copies.set_all(changes),
        });
    }

    /// Bytes of the copies for slices across x, y and z.
    pub fn copy_bytes(&self) -> [usize; 3] {
        with_copies!(self, copies => copies.each(Copy3::bytes).map(Option::unwrap_or_default))
    }

    /// Bytes of the sums of blocks.
    pub fn preview_bytes(&self) -> usize {
        match self {
            Self::Whole(_) => 0,
            Self::Preview { blocks, .. } => size_of_val(&*blocks.sums),
        }
    }

    /// Which cells of each existing copy frames have to read.
    pub fn cell_shares(&self) -> [Option<CellShares>; 3] {
        with_copies!(self, copies => copies.each(Copy3::shares))
    }
}

/// Source data of a copy.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub view: &'a VolumeView<'a>,
    pub removed: &'a RemovedVoxels,
    pub values: &'a Values,
    /// Stored value of a removed voxel.
    pub fill: i16,
    pub machine: &'static dyn Machine,
}

/// The copies, by the axis across which slices are read.
pub(super) struct Copies<T: Voxel> {
    dims: [usize; 3],
    by_slow: [Option<Copy3<T>>; 3],
    largest: i16,
}

impl<T: Voxel> Copies<T> {
    fn new(dims: [usize; 3]) -> Self {
        Self { dims, by_slow: [None, None, None], largest: 0 }
    }

    fn set(&mut self, voxel: [usize; 3], value: i16) {
        self.largest = self.largest.max(value);
        self.by_slow.iter_mut().flatten().for_each(|copy| copy.set(voxel, value));
    }

    fn splat(&mut self, standing: &mut CachedImages, changes: &[Change]) {
        let CachedImages { parts, sums, .. } = standing;
        let mut splatter = Splatter::default();
        for &Change { linear, value } in changes {
            let voxel = self.voxel_of(linear);
            for part in parts.iter_mut() {
                let samples = part.samples();
                let (Some(copy), Some(sums)) = (self.copy(part.plan.axes.slow), sums.get_mut(samples)) else {
                    continue;
                };
                splatter.splat(copy, &part.plan, sums, voxel, value, &mut part.dirty);
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
        for &Change { linear, value } in changes {
            self.set(self.voxel_of(linear), value);
        }
    }

    /// The copy that slices across `slow` are read from. Without their own copy, slices across z use that for
    /// slices across y.
    fn copy(&self, slow: usize) -> Option<&Copy3<T>> {
        let other = if slow == 2 { self.by_slow[1].as_ref() } else { None };
        self.by_slow[slow].as_ref().or(other)
    }

    /// Creates the copy that slices across `slow` are read from, if it is missing; `changed` lists the voxels
    /// that differ from those of `fill_row`.
    fn ensure(
        &mut self,
        machine: &dyn Machine,
        slow: usize,
        fill_row: impl Fn(usize, usize, &mut [T]) + Sync,
        changed: impl Iterator<Item = ([usize; 3], i16)>,
    ) -> Result<(), DrrError> {
        if self.by_slow[slow].is_some() {
            return Ok(());
        }
        let needed_bytes = |slow: usize| copy_elements(self.dims, Axes::of(slow)) * size_of::<T>() as u64;
        let refused = |needed_bytes: u64, available_bytes: u64| {
            let (dims, bytes_each) = (self.dims, size_of::<T>());
            DrrError::Memory { dims, bytes_each, needed_bytes, available_bytes }
        };
        let available = machine.available_bytes();
        // The third copy only saves time.
        let scarce = available.is_some_and(|available| available / SHARE_OF_THIRD < needed_bytes(2));
        let slow = if slow == 2 && scarce { 1 } else { slow };
        if self.by_slow[slow].is_some() {
            return Ok(());
        }
        let needed_bytes = needed_bytes(slow);
        if let Some(available_bytes) = available.filter(|available| needed_bytes > *available) {
            return Err(refused(needed_bytes, available_bytes));
        }
        let copy = Copy3::new(machine, self.dims, Axes::of(slow), fill_row);
        let mut copy = copy.ok_or_else(|| refused(needed_bytes, machine.available_bytes().unwrap_or(0)))?;
        self.largest = self.largest.max(copy.largest());
        changed.for_each(|(voxel, value)| copy.set(voxel, value));
        self.by_slow[slow] = Some(copy);
        Ok(())
    }

    fn sum(&self, parts: &[ImagePatch], instructions: Instructions, sums: &mut [i64]) {
        let flush_after = slices_until_flush(self.largest * T::UNIT);
        let mut rest = sums;
        let mut jobs = Vec::new();
        for part in parts {
            let (own, others) =
                core::mem::take(&mut rest).split_at_mut_checked(part.plan.pixels()).unwrap_or_default();
            rest = others;
            let Some(copy) = self.copy(part.plan.axes.slow) else { continue };
            let lines = (TILES * TILE_ROWS * part.plan.columns).max(1);
            jobs.extend(own.chunks_mut(lines).enumerate().map(|(n, out)| (copy, &part.plan, n, out)));
        }
        // One group of tiles at a time, because those in the middle of an image take longest; finished ones
        // pass on their workspace.
        let spare = Mutex::new(Vec::new());
        let spare = || spare.lock().unwrap_or_else(PoisonError::into_inner);
        jobs.into_par_iter().with_max_len(1).for_each(|(copy, plan, tiles, out)| {
            let work = spare().pop();
            let mut work: Work = work.unwrap_or_default();
            work.fit(plan, copy);
            instructions.sum_tiles(copy, plan, flush_after, tiles * TILES * TILE_ROWS, &mut work, out);
            spare().push(work);
        });
    }

    fn each<U>(&self, of: impl Fn(&Copy3<T>) -> U) -> [Option<U>; 3] {
        self.by_slow.each_ref().map(|copy| copy.as_ref().map(&of))
    }
}

/// Sums over cubes of voxels, from which a preview's values derive.
pub(super) struct Blocks {
    side: usize,
    dims: [usize; 3],
    sums: Vec<u32>,
    /// Units per step of a byte.
    step: u32,
}

impl Blocks {
    fn new(view: &VolumeView<'_>, values: &Values, side: usize) -> Self {
        let [nx, ny, nz] = view.grid().dims();
        let dims = [nx, ny, nz].map(|n| n.div_ceil(side));
        let mut sums = vec![0_u32; dims[0] * dims[1] * dims[2]];
        sums.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(bz, plane)| {
            for z in bz * side..((bz + 1) * side).min(nz) {
                for y in 0..ny {
                    let start = nx * (y + ny * z);
                    let line = &mut plane[dims[0] * (y / side)..][..dims[0]];
                    for (sum, voxels) in line.iter_mut().zip(view.hu()[start..start + nx].chunks(side)) {
                        *sum += voxels.iter().map(|&hu| u32::from(values.of(hu) as u16)).sum::<u32>();
                    }
                }
            }
        });
        let count = (side * side * side) as u32;
        let largest = sums.par_iter().copied().max().unwrap_or(0).div_ceil(count);
        Self { side, dims, sums, step: largest.div_ceil(255).max(1) }
    }

    /// The block that a voxel is part of.
    fn block_of(&self, grid: &Grid, linear: usize) -> [usize; 3] {
        grid.voxel_of(linear).map(|v| v / self.side)
    }

    /// Value of a block in steps: the rounded mean. Voxels outside the volume count as air.
    fn value(&self, sum: u32) -> i16 {
        let unit = (self.side * self.side * self.side) as u32 * self.step;
        ((sum + unit / 2) / unit).min(255) as i16
    }

    fn grid(&self, grid: &Grid) -> Result<Grid, DrrError> {
        let centre = 0.5 * (self.side as f64 - 1.0);
        let (steps_m, fine_m) = (grid.axis_steps_m(), grid.spacing_m());
        let axes = [0, 1, 2].map(|a| scale(steps_m[a], 1.0 / fine_m[a]));
        let spacing_m = fine_m.map(|s| s * self.side as f64);
        Grid::new(self.dims, spacing_m, grid.index_to_world([centre; 3]), axes)
    }
}
