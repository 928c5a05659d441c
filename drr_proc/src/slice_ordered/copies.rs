//! The volume in the orders in which slices are read: rows of small integers with zeros between them.
//!
//! Two copies are enough for all three axes: slices across z and across y are read in rows along x, slices across x in rows
//! along y. A copy is made when the first frame needs it. It takes `(nx + 32) ny nz` values (along x), or
//! `nx (ny + 32) nz` (along y), and one bit for every 32 voxels.

use rayon::prelude::*;

/// Zeros between rows: a window of 32 voxels may begin 32 before a row's first voxel or at its last.
const PAD: usize = 32;
/// Voxels that one load takes.
pub(crate) const WINDOW: usize = 32;
/// Side of the squares that are transposed at a time.
const SQUARE: usize = 32;
/// Voxels that a window beginning in one cell of 32 may reach before the cell (none) and behind it.
const REACH: usize = super::plan::GROUP;

/// What a voxel is stored as.
pub(crate) trait Voxel: Copy + Default + Send + Sync + PartialEq + 'static {
    /// A window as the 16-bit numbers that are multiplied.
    fn widen(window: &[Self; WINDOW]) -> [i16; WINDOW];
    /// Stores a value that is in range.
    fn store(value: i16) -> Self;
    /// The value.
    fn value(self) -> i16;
}

impl Voxel for i16 {
    #[inline(always)]
    fn widen(window: &[Self; WINDOW]) -> [i16; WINDOW] {
        *window
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
    #[inline(always)]
    fn widen(window: &[Self; WINDOW]) -> [i16; WINDOW] {
        window.map(i16::from)
    }
    #[inline(always)]
    fn store(value: i16) -> Self {
        // The renderer's unit keeps previews within 0..=255.
        value.clamp(0, 255) as Self
    }
    #[inline(always)]
    fn value(self) -> i16 {
        i16::from(self)
    }
}

/// One order of the volume.
pub(crate) struct Copy3<T> {
    data: Vec<T>,
    dims: [usize; 3],
    /// Offset of voxel (0, 0, 0).
    origin: usize,
    /// Distance in `data` along each axis.
    strides: [usize; 3],
    /// The axis along which rows are contiguous.
    fast: usize,
    /// Bits of the rows: bit b is set if a window that begins in voxels 32 (b - 1).. 32 b of the row can meet something.
    occupancy: Vec<u64>,
    words_per_row: usize,
}

/// Elements of a copy with rows along `fast`.
pub(crate) fn copy_elements(dims: [usize; 3], fast: usize) -> u64 {
    let rows = dims.iter().map(|&n| n as u64).product::<u64>() / dims[fast] as u64;
    rows * (dims[fast] + PAD) as u64 + 2 * (dims[fast] + 2 * PAD) as u64
}

impl<T: Voxel> Copy3<T> {
    /// Makes the copy with rows along `fast` (0 or 1). `fill_row(y, z, row)` writes the voxels of a row along x.
    pub fn new(dims: [usize; 3], fast: usize, fill_row: impl Fn(usize, usize, &mut [T]) + Sync) -> Self {
        let [nx, ny, nz] = dims;
        // A row of zeros in front stands for the rows beyond the volume.
        let head = dims[fast] + 2 * PAD;
        let width = dims[fast] + PAD;
        let strides = if fast == 0 { [1, width, width * ny] } else { [width, 1, width * nx] };
        let plane = strides[2];
        let mut data = vec![T::default(); head + plane * nz + 2 * PAD];
        let words_per_row = (dims[fast].div_ceil(WINDOW) + 1).div_ceil(64);
        data[head..head + plane * nz].par_chunks_mut(plane).enumerate().for_each_init(
            || vec![T::default(); if fast == 0 { 0 } else { nx * ny }],
            |flat, (z, out)| {
                if fast == 0 {
                    for (y, row) in out.chunks_mut(width).enumerate() {
                        fill_row(y, z, &mut row[PAD..]);
                    }
                } else {
                    for (y, row) in flat.chunks_mut(nx).enumerate() {
                        fill_row(y, z, row);
                    }
                    transpose(flat, [nx, ny], out, width);
                }
            },
        );
        let mut copy =
            Self { data, dims, origin: head + PAD, strides, fast, occupancy: Vec::new(), words_per_row };
        copy.occupancy = copy.occupied_rows(head, width);
        copy
    }

    fn occupied_rows(&self, head: usize, width: usize) -> Vec<u64> {
        let rows = (self.dims[0] * self.dims[1] * self.dims[2]) / self.dims[self.fast];
        let mut bits = vec![0_u64; rows * self.words_per_row];
        let zero = T::default();
        let lines = self.data[head..head + rows * width].par_chunks(width);
        bits.par_chunks_mut(self.words_per_row).zip(lines).for_each(|(words, row)| {
            let voxels = &row[PAD..];
            for (cell, voxels) in voxels.chunks(WINDOW).enumerate() {
                if voxels.iter().any(|&v| v != zero) {
                    mark(words, cell + 1);
                }
                if voxels.iter().take(REACH).any(|&v| v != zero) {
                    mark(words, cell);
                }
            }
        });
        bits
    }

    /// Largest value.
    pub fn largest(&self) -> i16 {
        self.data
            .par_chunks(1 << 16)
            .map(|c| c.iter().map(|v| v.value()).max().unwrap_or(0))
            .max()
            .unwrap_or(0)
    }

    /// Changes a voxel.
    pub fn set(&mut self, voxel: [usize; 3], value: i16) {
        let [x, y, z] = voxel;
        let offset = self.origin + x * self.strides[0] + y * self.strides[1] + z * self.strides[2];
        if let Some(v) = self.data.get_mut(offset) {
            *v = T::store(value);
        }
        if value != 0 {
            let row = self.row_number(voxel) * self.words_per_row;
            let cell = voxel[self.fast] / WINDOW;
            if let Some(words) = self.occupancy.get_mut(row..row + self.words_per_row) {
                mark(words, cell + 1);
                if voxel[self.fast] % WINDOW < REACH {
                    mark(words, cell);
                }
            }
        }
    }

    fn row_number(&self, voxel: [usize; 3]) -> usize {
        let other = 1 - self.fast;
        voxel[other] + self.dims[other] * voxel[2]
    }

    /// All values, with the zeros around them.
    #[inline(always)]
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// Distance between neighbours along an axis.
    #[inline(always)]
    pub fn stride(&self, axis: usize) -> usize {
        self.strides[axis]
    }

    /// Offset of the first voxel of a row of slice `k` across `slow`, or of zeros beyond the volume; and its occupancy.
    #[inline(always)]
    pub fn row(&self, slow: usize, k: usize, v_axis: usize, v: i64) -> (usize, &[u64]) {
        if v < 0 || v >= self.dims[v_axis] as i64 {
            return (PAD, &[]);
        }
        let v = v as usize;
        let offset = self.origin + k * self.strides[slow] + v * self.strides[v_axis];
        let other = 1 - self.fast;
        let (o, z) = if slow == 2 { (v, k) } else { (k, v) };
        let row = (o + self.dims[other] * z) * self.words_per_row;
        (offset, self.occupancy.get(row..row + self.words_per_row).unwrap_or(&[]))
    }

    /// Words of a row's occupancy.
    pub fn words_per_row(&self) -> usize {
        self.words_per_row
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.data.len() * size_of::<T>() + self.occupancy.len() * 8
    }

    /// Share of the cells of 32 voxels in which something attenuates.
    pub fn occupied_share(&self) -> f64 {
        let cells = self.occupancy.len() / self.words_per_row * (self.dims[self.fast].div_ceil(WINDOW) + 1);
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

/// `out[x width + PAD + y] = flat[x + nx y]`, square by square.
fn transpose<T: Copy>(flat: &[T], [nx, ny]: [usize; 2], out: &mut [T], width: usize) {
    for y0 in (0..ny).step_by(SQUARE) {
        let y1 = (y0 + SQUARE).min(ny);
        for x0 in (0..nx).step_by(SQUARE) {
            for x in x0..(x0 + SQUARE).min(nx) {
                let line = &mut out[x * width + PAD + y0..x * width + PAD + y1];
                for (o, row) in line.iter_mut().zip(flat[y0 * nx..].chunks(nx)) {
                    *o = row[x];
                }
            }
        }
    }
}
