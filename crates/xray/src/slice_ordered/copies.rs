//! The volume in the orders in which slices are read: rows of cells of 32 small integers, aligned for vector
//! loads.
//!
//! There is one copy for each axis across which slices are read, with rows along x (along y for slices across
//! x). Neighbouring rows of a copy belong to successive slices, so a sum that proceeds from slice to slice
//! reads each plane of rows from end to end. The CPU prefetches such rows by itself; rows of successive
//! planes arrive only as fast as the sum requests them. A copy is created when the first frame needs it. A
//! row is a whole number of cells. Each cell has a level: the value of all its voxels, if they are equal.
//! Where the levels around a sample agree, the sample is known without its voxels.

use rayon::prelude::*;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::Machine;
use super::array::Array;
use super::options::CellShares;
use super::plan::Axes;

/// Voxels per cell.
pub(crate) const CELL: usize = 32;
/// Side of the squares transposed at a time.
const SQUARE: usize = 32;
/// Cells of 16-bit voxels per page of 4096 bytes, and the number of cells by which each plane's start is
/// shifted within a page. Rows of consecutive planes are read at the same time and must not map to the same
/// cache sets.
const PAGE_CELLS: usize = 64;
const PLANE_SHIFT: usize = 5;
/// Levels compared at a time: each row's are a multiple of this.
pub(crate) const LEVELS: usize = 16;
/// Level of a cell whose voxels differ (or did before a removal), or whose value is not among the most
/// frequent.
pub(crate) const MIXED: u8 = u8::MAX;
/// Left shift applied to byte values, so that rounding between two rows is small compared with the byte's
/// resolution.
const BYTE_SHIFT: u32 = 4;

/// 32 voxels of 16 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C, align(64))]
pub(crate) struct Cell16(pub [i16; CELL]);

/// 32 voxels of 8 bits.
#[derive(Debug, Clone, Copy, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C, align(32))]
pub(crate) struct Cell8(pub [u8; CELL]);

/// Storage format of a voxel.
pub(crate) trait Voxel:
    Copy + Default + Send + Sync + Ord + FromBytes + IntoBytes + Immutable + 'static
{
    /// A cell of 32 voxels.
    type Cell: Copy + Default + PartialEq + Send + Sync + FromBytes + IntoBytes + Immutable;
    /// Factor that [`Voxel::widen`] applies to stored values.
    const UNIT: i16;
    /// A cell as 16-bit integers, ready for summing.
    fn widen(cell: &Self::Cell) -> [i16; CELL];
    /// Stores a value, which must be in range.
    fn store(value: i16) -> Self;
    /// The value.
    fn value(self) -> i16;
}

impl Voxel for i16 {
    type Cell = Cell16;
    const UNIT: i16 = 1;

    #[inline(always)]
    fn widen(cell: &Cell16) -> [i16; CELL] {
        cell.0
    }
    #[inline(always)]
    fn store(value: i16) -> Self {
        value
    }
    #[inline(always)]
    fn value(self) -> i16 {
        self
    }
}

impl Voxel for u8 {
    type Cell = Cell8;
    const UNIT: i16 = 1 << BYTE_SHIFT;

    #[inline(always)]
    fn widen(cell: &Cell8) -> [i16; CELL] {
        cell.0.map(|v| i16::from(v) << BYTE_SHIFT)
    }
    #[inline(always)]
    fn store(value: i16) -> Self {
        // The renderer's unit keeps preview values within 0..=255.
        value.clamp(0, 255) as Self
    }
    #[inline(always)]
    fn value(self) -> i16 {
        i16::from(self)
    }
}

/// The voxels of consecutive cells.
#[inline(always)]
pub(crate) fn voxels<T: Voxel>(cells: &[T::Cell]) -> &[T] {
    // Cannot fail: cells have stricter alignment than voxels and hold a whole number of them.
    <[T]>::ref_from_bytes(cells.as_bytes()).unwrap_or(&[])
}

#[inline(always)]
fn voxels_mut<T: Voxel>(cells: &mut [T::Cell]) -> &mut [T] {
    <[T]>::mut_from_bytes(cells.as_mut_bytes()).unwrap_or(&mut [])
}

/// One ordering of the volume.
pub(crate) struct Copy3<T: Voxel> {
    /// A row of zeros, used for all rows outside the volume; then the planes.
    data: Array<T::Cell>,
    dims: [usize; 3],
    /// Rows run along `u` and follow one another along `slow`, planes along `v`.
    axes: Axes,
    /// Cells per row, and cells between planes.
    row_cells: usize,
    plane_cells: usize,
    /// For each cell of each row, the index in `values` of its voxels' common value, or [`MIXED`]; the row of
    /// zeros comes first.
    levels: Vec<u8>,
    /// The values of the levels, as used in sums; the first is zero.
    values: Vec<i16>,
    levels_per_row: usize,
    /// The largest value at creation, as stored.
    largest: i16,
}

/// Location of a slice's rows: their number, the first cell and first level of the first row, and the strides
/// from row to row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SliceRows {
    count: u64,
    first: (usize, usize),
    step: (usize, usize),
}

/// Cells per row and per plane of a copy.
fn extents(dims: [usize; 3], axes: Axes) -> (usize, usize) {
    let row = dims[axes.u].div_ceil(CELL);
    let used = row * dims[axes.slow];
    (row, used.next_multiple_of(PAGE_CELLS) + PLANE_SHIFT)
}

/// Elements of a copy.
pub(crate) fn copy_elements(dims: [usize; 3], axes: Axes) -> u64 {
    let (row, plane) = extents(dims, axes);
    (row as u64 + plane as u64 * dims[axes.v] as u64) * CELL as u64
}

impl<T: Voxel> Copy3<T> {
    /// Creates the copy for slices across `axes.slow`. `fill_row(y, z, row)` writes the voxels of a row along
    /// x. `None` if the machine has too little memory.
    pub fn new(
        machine: &dyn Machine,
        dims: [usize; 3],
        axes: Axes,
        fill_row: impl Fn(usize, usize, &mut [T]) + Sync,
    ) -> Option<Self> {
        let [nx, ny, _] = dims;
        let (row_cells, plane_cells) = extents(dims, axes);
        let width = row_cells * CELL;
        let mut data = Array::zeroed(machine, row_cells + plane_cells * dims[axes.v])?;
        let levels_per_row = row_cells.next_multiple_of(LEVELS);
        let plane_levels = dims[axes.slow] * levels_per_row;
        let mut of_cells = vec![0_i16; levels_per_row + plane_levels * dims[axes.v]];
        let planes = data[row_cells..].par_chunks_mut(plane_cells);
        let planes = planes.zip(of_cells[levels_per_row..].par_chunks_mut(plane_levels)).enumerate();
        let fill_plane =
            |flat: &mut Vec<T>, (plane, (cells, levels)): (usize, (&mut [T::Cell], &mut [i16]))| {
                let out = voxels_mut::<T>(cells);
                if axes.u == 0 {
                    for (n, row) in out.chunks_mut(width).take(dims[axes.slow]).enumerate() {
                        let (y, z) = if axes.slow == 1 { (n, plane) } else { (plane, n) };
                        fill_row(y, z, &mut row[..nx]);
                    }
                } else {
                    for (y, row) in flat.chunks_mut(nx).enumerate() {
                        fill_row(y, plane, row);
                    }
                    transpose(flat, [nx, ny], out, width);
                }
                // Done here while the plane is still in the CPU cache.
                values_of_cells::<T>(cells.chunks(row_cells), levels.chunks_mut(levels_per_row))
            };
        let flat = || vec![T::default(); if axes.u == 0 { 0 } else { nx * ny }];
        let largest = planes.map_init(flat, fill_plane).max().unwrap_or(0);
        let values = most_frequent(&of_cells);
        let mut level_of = vec![MIXED; 1 << 16];
        for (level, value) in (0..MIXED).zip(&values) {
            level_of[usize::from(*value as u16)] = level;
        }
        let levels = of_cells.par_iter().map(|value| level_of[usize::from(*value as u16)]).collect();
        Some(Self { data, dims, axes, row_cells, plane_cells, levels, values, levels_per_row, largest })
    }

    /// The largest value at creation.
    pub fn largest(&self) -> i16 {
        self.largest
    }

    /// First cell of a row, and its first level.
    #[inline(always)]
    fn row_at(&self, row: usize, plane: usize) -> (usize, usize) {
        let levels = (1 + row + self.dims[self.axes.slow] * plane) * self.levels_per_row;
        (self.row_cells * (1 + row) + self.plane_cells * plane, levels)
    }

    /// Index in `data` of the cell that contains a voxel.
    #[inline(always)]
    fn cell_of(&self, voxel: [usize; 3]) -> usize {
        let Axes { slow, u, v } = self.axes;
        self.row_at(voxel[slow], voxel[v]).0 + voxel[u] / CELL
    }

    /// Changes a voxel.
    pub fn set(&mut self, voxel: [usize; 3], value: i16) {
        let Axes { slow, u, v } = self.axes;
        let at = self.cell_of(voxel);
        let Some(cell) = self.data.get_mut(at..=at) else { return };
        if let Some(stored) = voxels_mut::<T>(cell).get_mut(voxel[u] % CELL) {
            *stored = T::store(value);
        }
        let (_, row) = self.row_at(voxel[slow], voxel[v]);
        if let Some(level) = self.levels.get_mut(row + voxel[u] / CELL)
            && self.values.get(usize::from(*level)) != Some(&(value * T::UNIT))
        {
            *level = MIXED;
        }
    }

    /// The value of a voxel as used in sums.
    #[inline(always)]
    pub fn wide(&self, voxel: [usize; 3]) -> i16 {
        let cell = self.data.get(self.cell_of(voxel)..).and_then(|cells| cells.first_chunk::<1>());
        let voxel = cell.and_then(|cell| voxels::<T>(cell).get(voxel[self.axes.u] % CELL));
        voxel.map_or(0, |v| v.value() * T::UNIT)
    }

    /// Like [`Self::wide`], but 0 outside the volume.
    #[inline(always)]
    pub fn wide_or_zero(&self, voxel: [usize; 3]) -> i16 {
        if (0..3).all(|axis| voxel[axis] < self.dims[axis]) { self.wide(voxel) } else { 0 }
    }

    /// All cells.
    #[inline(always)]
    pub fn data(&self) -> &[T::Cell] {
        &self.data
    }

    /// Number of cells per row.
    #[inline(always)]
    pub fn row_cells(&self) -> usize {
        self.row_cells
    }

    /// The rows of slice `k` across `slow`.
    #[inline(always)]
    pub fn rows(&self, slow: usize, k: usize) -> SliceRows {
        let own = slow == self.axes.slow;
        let at = |v: usize| if own { self.row_at(k, v) } else { self.row_at(v, k) };
        let (first, next) = (at(0), at(1));
        let count = self.dims[if own { self.axes.v } else { self.axes.slow }];
        SliceRows { count: count as u64, first, step: (next.0 - first.0, next.1 - first.1) }
    }

    /// First cell of row `v` of a slice (of zeros outside the volume), and the row's levels.
    #[inline(always)]
    pub fn row(&self, rows: &SliceRows, v: i64) -> (usize, &[u8]) {
        // A negative number becomes a large unsigned one.
        let inside = (v as u64) < rows.count;
        let at = |first: usize, step: usize| if inside { first + v as usize * step } else { 0 };
        let levels = at(rows.first.1, rows.step.1);
        let levels = self.levels.get(levels..levels + self.levels_per_row).unwrap_or(&[]);
        (at(rows.first.0, rows.step.0), levels)
    }

    /// The value of a level, as used in sums.
    #[inline(always)]
    pub fn value_of(&self, level: u8) -> i16 {
        self.values.get(usize::from(level)).copied().unwrap_or(0)
    }

    /// Number of levels per row: one per cell, padded with zeros to a multiple of [`LEVELS`].
    pub fn levels_per_row(&self) -> usize {
        self.levels_per_row
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.data) + size_of_val(&*self.levels)
    }

    /// Fractions of cells in which something attenuates, and of those whose voxels differ.
    pub fn shares(&self) -> CellShares {
        let count = |which: fn(&u8) -> bool| self.levels.iter().filter(|level| which(level)).count() as f64;
        let cells = (self.dims[self.axes.slow] * self.dims[self.axes.v] * self.row_cells).max(1) as f64;
        CellShares {
            occupied: count(|level| *level != 0) / cells,
            mixed: count(|level| *level == MIXED) / cells,
        }
    }
}

/// Records for each cell of a plane's rows the common value of its voxels as used in sums, negative if they
/// differ. Returns the largest stored value.
fn values_of_cells<'a, T: Voxel>(
    rows: impl Iterator<Item = &'a [T::Cell]>,
    levels: impl Iterator<Item = &'a mut [i16]>,
) -> i16
where
    T::Cell: 'a,
{
    let mut largest = T::default();
    for (row, levels) in rows.zip(levels) {
        for (cell, level) in row.iter().zip(levels) {
            *level = value_of::<T>(cell);
        }
        largest = voxels::<T>(row).iter().copied().fold(largest, T::max);
    }
    largest.value()
}

/// The common value of a cell's voxels as used in sums; negative if they differ.
fn value_of<T: Voxel>(cell: &T::Cell) -> i16 {
    let wide = T::widen(cell);
    // Without an early exit, the compiler compares many voxels at a time.
    let differs = wide.iter().fold(0, |differs, voxel| differs | (voxel ^ wide[0]));
    if differs == 0 { wide[0] } else { -1 }
}

/// Zero, then the values that most cells have, as many as there are levels.
fn most_frequent(values: &[i16]) -> Vec<i16> {
    let mut counts = vec![0_u32; 1 << 15];
    for value in values.iter().filter(|value| **value > 0) {
        counts[*value as usize] += 1;
    }
    let mut used: Vec<i16> = (1..=i16::MAX).filter(|value| counts[*value as usize] > 0).collect();
    used.sort_by_key(|value| core::cmp::Reverse(counts[*value as usize]));
    core::iter::once(0).chain(used).take(usize::from(MIXED)).collect()
}

/// `out[x width + y] = flat[x + nx y]`, square by square.
fn transpose<T: Copy>(flat: &[T], [nx, ny]: [usize; 2], out: &mut [T], width: usize) {
    for y0 in (0..ny).step_by(SQUARE) {
        let y1 = (y0 + SQUARE).min(ny);
        for x0 in (0..nx).step_by(SQUARE) {
            for x in x0..(x0 + SQUARE).min(nx) {
                let line = &mut out[x * width + y0..x * width + y1];
                for (o, row) in line.iter_mut().zip(flat[y0 * nx..].chunks(nx)) {
                    *o = row[x];
                }
            }
        }
    }
}
