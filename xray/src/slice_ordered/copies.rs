//! The volume in the orders in which slices are read: rows of cells of 32 small integers, aligned for vector loads.
//!
//! There is one copy for each axis across which slices are read, with rows along x (along y for slices across x). Neighbouring rows of a
//! copy belong to successive slices, so a sum that goes from slice to slice reads each plane of rows from end to end: the CPU fetches such
//! rows ahead by itself, and rows of successive planes only as fast as the sum asks for them. A copy is created when the first frame needs
//! it. A row is a whole number of cells, and one bit per cell tells whether it holds anything.

use rayon::prelude::*;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::Machine;
use super::array::Array;
use super::plan::Axes;

/// Voxels per cell.
pub(crate) const CELL: usize = 32;
/// Side of the squares transposed at a time.
const SQUARE: usize = 32;
/// Cells of 16-bit voxels per page of 4096 bytes, and the number of cells by which each plane's start is shifted within a page. Rows of
/// consecutive planes are read at the same time and must not map to the same cache sets.
const PAGE_CELLS: usize = 64;
const PLANE_SHIFT: usize = 5;
/// Left shift applied to byte values, so that rounding between two rows is small compared with the byte's resolution.
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
    Copy + Default + Send + Sync + PartialEq + FromBytes + IntoBytes + Immutable + 'static
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
    /// A row of zeros, which stands in for all rows outside the volume; then the planes.
    data: Array<T::Cell>,
    dims: [usize; 3],
    /// Rows run along `u` and follow one another along `slow`, planes along `v`.
    axes: Axes,
    /// Cells per row, and cells between planes.
    row_cells: usize,
    plane_cells: usize,
    /// One bit per cell of each row: set if anything in the cell attenuates, or did before it was removed.
    occupancy: Vec<u64>,
    words_per_row: usize,
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
    /// Creates the copy for slices across `axes.slow`. `fill_row(y, z, row)` writes the voxels of a row along x. `None` if the machine
    /// has too little memory.
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
        data[row_cells..].par_chunks_mut(plane_cells).enumerate().for_each_init(
            || vec![T::default(); if axes.u == 0 { 0 } else { nx * ny }],
            |flat, (plane, out)| {
                let out = voxels_mut::<T>(out);
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
            },
        );
        let words_per_row = row_cells.div_ceil(64);
        let mut copy =
            Self { data, dims, axes, row_cells, plane_cells, occupancy: Vec::new(), words_per_row };
        copy.occupancy = copy.occupied_rows();
        Some(copy)
    }

    fn occupied_rows(&self) -> Vec<u64> {
        let rows = self.dims[self.axes.slow];
        let mut bits = vec![0_u64; rows * self.dims[self.axes.v] * self.words_per_row];
        let planes = self.data[self.row_cells..].par_chunks(self.plane_cells);
        let zero = T::Cell::default();
        bits.par_chunks_mut(rows * self.words_per_row).zip(planes).for_each(|(bits, plane)| {
            let lines = plane.chunks(self.row_cells);
            for (words, row) in bits.chunks_mut(self.words_per_row).zip(lines) {
                row.iter().enumerate().filter(|(_, cell)| **cell != zero).for_each(|(c, _)| mark(words, c));
            }
        });
        bits
    }

    /// The largest value.
    pub fn largest(&self) -> i16 {
        let largest = |cells: &[T::Cell]| voxels::<T>(cells).iter().map(|v| v.value()).max().unwrap_or(0);
        self.data.par_chunks(1 << 11).map(largest).max().unwrap_or(0)
    }

    /// First cell of a row, and its first word of occupancy.
    #[inline(always)]
    fn row_at(&self, row: usize, plane: usize) -> (usize, usize) {
        let bits = (row + self.dims[self.axes.slow] * plane) * self.words_per_row;
        (self.row_cells * (1 + row) + self.plane_cells * plane, bits)
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
        if value != 0 {
            let (_, row) = self.row_at(voxel[slow], voxel[v]);
            if let Some(words) = self.occupancy.get_mut(row..row + self.words_per_row) {
                mark(words, voxel[u] / CELL);
            }
        }
    }

    /// The value of a voxel as used in sums.
    #[inline(always)]
    pub fn wide(&self, voxel: [usize; 3]) -> i16 {
        let cell = self.data.get(self.cell_of(voxel)..).and_then(|cells| cells.first_chunk::<1>());
        let voxel = cell.and_then(|cell| voxels::<T>(cell).get(voxel[self.axes.u] % CELL));
        voxel.map_or(0, |v| v.value() * T::UNIT)
    }

    /// The same; 0 outside the volume.
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

    /// First cell of row `v` of slice `k` across `slow` (of zeros outside the volume), and the row's occupancy.
    #[inline(always)]
    pub fn row(&self, slow: usize, k: usize, v: i64) -> (usize, &[u64]) {
        let own = slow == self.axes.slow;
        if v < 0 || v >= self.dims[if own { self.axes.v } else { self.axes.slow }] as i64 {
            return (0, &[]);
        }
        let (row, plane) = if own { (k, v as usize) } else { (v as usize, k) };
        let (first, bits) = self.row_at(row, plane);
        (first, self.occupancy.get(bits..bits + self.words_per_row).unwrap_or(&[]))
    }

    /// Words of occupancy per row.
    pub fn words_per_row(&self) -> usize {
        self.words_per_row
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(&*self.data) + self.occupancy.len() * 8
    }

    /// Fraction of cells in which something attenuates.
    pub fn occupied_share(&self) -> f64 {
        let cells = self.occupancy.len() / self.words_per_row * self.row_cells;
        let set: u64 = self.occupancy.iter().map(|w| u64::from(w.count_ones())).sum();
        set as f64 / cells.max(1) as f64
    }
}

#[inline(always)]
fn mark(words: &mut [u64], bit: usize) {
    if let Some(word) = words.get_mut(bit / 64) {
        *word |= 1 << (bit % 64);
    }
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
