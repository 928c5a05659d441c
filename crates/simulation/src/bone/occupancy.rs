//! Bone occupancy: one bit per voxel in rows along x, with coarse counts that skip empty space.

use super::grid::floor_to_i64;

/// Base-2 logarithm of the edge of a coarse cell in voxels along y and z (along x it is one 64-bit word).
const CELL_SHIFT: usize = 3;
/// Number of zero bytes before each row.
const ROW_PADDING: usize = 8;

/// Number of voxels in a window: 64 minus up to 7 lost to a start within a byte.
pub(super) const WINDOW_VOXELS: i64 = 57;

const _: () = assert!(WINDOW_VOXELS == 64 - 7, "a word minus the bits before a window's first");
const _: () = assert!(64 << (2 * CELL_SHIFT) <= u16::MAX as usize, "a cell's count fits into its type");

/// Rows of bits along x, stored as bytes so that a window is one unaligned load. Eight zero bytes precede
/// every row and more than a row of zeros follows the last one, so a window may run past either end of a row.
#[derive(Debug, Clone)]
pub(super) struct Occupancy {
    dims: [usize; 3],
    row_stride: usize,
    bytes: Vec<u8>,
    cell_dims: [usize; 3],
    cell_counts: Vec<u16>,
    solid_count: usize,
}

/// An inclusive box of voxel indices inside the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct VoxelBox {
    pub low: [i64; 3],
    pub high: [i64; 3],
}

impl VoxelBox {
    /// The empty box.
    pub const NOTHING: Self = Self { low: [i64::MAX; 3], high: [i64::MIN; 3] };

    /// Returns the smallest box that contains both.
    pub fn hull(&self, other: &Self) -> Self {
        Self {
            low: core::array::from_fn(|a| self.low[a].min(other.low[a])),
            high: core::array::from_fn(|a| self.high[a].max(other.high[a])),
        }
    }

    /// Returns true if the two boxes overlap.
    #[inline]
    pub fn meets(&self, other: &Self) -> bool {
        (0..3).all(|a| self.low[a] <= other.high[a] && other.low[a] <= self.high[a])
    }

    /// Returns the smallest box that also contains `voxel`.
    pub fn with(&self, voxel: [i64; 3]) -> Self {
        Self {
            low: [0, 1, 2].map(|a| self.low[a].min(voxel[a])),
            high: [0, 1, 2].map(|a| self.high[a].max(voxel[a])),
        }
    }
}

/// Position of a window within every row.
#[derive(Debug, Clone, Copy)]
pub(super) struct WindowPlace {
    byte: usize,
    shift: u32,
}

/// Returns a bit for each of up to 64 values that is at least the threshold, the first one lowest.
fn bits_of(values: &[i16], threshold_hu: i16) -> u64 {
    // A byte for each value, which the compiler's vector instructions compare sixteen at a time.
    let mut bytes = [0u8; 64];
    for (byte, value) in bytes.iter_mut().zip(values) {
        *byte = u8::from(*value >= threshold_hu);
    }
    let mut word = 0;
    for (place, eight) in bytes.as_chunks::<8>().0.iter().enumerate() {
        // Moves bit 8 n of eight bytes to bit 56 + n of the product; its terms do not overlap.
        let gathered = u64::from_le_bytes(*eight).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        word |= gathered << (8 * place);
    }
    word
}

impl Occupancy {
    /// Marks every voxel of at least `threshold_hu` as bone. `hu` has `dims[0] * dims[1] * dims[2]` values, x
    /// fastest.
    pub fn from_threshold(dims: [usize; 3], hu: &[i16], threshold_hu: i16) -> Self {
        let words_per_row = dims[0].div_ceil(64);
        let row_stride = (words_per_row + 1) * ROW_PADDING;
        let cell_dims = [words_per_row, (dims[1] >> CELL_SHIFT) + 1, (dims[2] >> CELL_SHIFT) + 1];
        let mut occupancy = Self {
            dims,
            row_stride,
            bytes: vec![0; row_stride * (dims[1] * dims[2] + 1) + 2 * ROW_PADDING],
            cell_dims,
            cell_counts: vec![0; cell_dims[0] * cell_dims[1] * cell_dims[2]],
            solid_count: 0,
        };
        for (row, values) in hu.chunks_exact(dims[0]).enumerate() {
            let (j, k) = (row % dims[1], row / dims[1]);
            for (word_index, chunk) in values.chunks(64).enumerate() {
                // Most of a CT is not bone.
                if chunk.iter().copied().fold(i16::MIN, i16::max) < threshold_hu {
                    continue;
                }
                let word = bits_of(chunk, threshold_hu);
                let cell = occupancy.cell_index(word_index, j, k);
                let byte = row * row_stride + (1 + word_index) * ROW_PADDING;
                occupancy.bytes[byte..byte + ROW_PADDING].copy_from_slice(&word.to_le_bytes());
                occupancy.cell_counts[cell] += word.count_ones() as u16;
                occupancy.solid_count += word.count_ones() as usize;
            }
        }
        occupancy
    }

    fn cell_index(&self, word: usize, j: usize, k: usize) -> usize {
        ((k >> CELL_SHIFT) * self.cell_dims[1] + (j >> CELL_SHIFT)) * self.cell_dims[0] + word
    }

    fn byte_and_bit(&self, i: usize, j: usize, k: usize) -> (usize, u8) {
        ((k * self.dims[1] + j) * self.row_stride + ROW_PADDING + (i >> 3), 1u8 << (i & 7))
    }

    /// Returns the number of voxels that are bone.
    pub fn solid_count(&self) -> usize {
        self.solid_count
    }

    /// Returns true if the voxel is bone.
    #[inline]
    pub fn is_solid(&self, i: usize, j: usize, k: usize) -> bool {
        let (byte, bit) = self.byte_and_bit(i, j, k);
        self.bytes[byte] & bit != 0
    }

    /// Returns true if the voxel is bone; false outside the grid.
    #[inline]
    pub fn is_solid_at(&self, index: [i64; 3]) -> bool {
        let inside = (0..3).all(|a| index[a] >= 0 && index[a] < self.dims[a] as i64);
        inside && self.is_solid(index[0] as usize, index[1] as usize, index[2] as usize)
    }

    /// Makes a voxel bone.
    pub fn fill(&mut self, [i, j, k]: [usize; 3]) {
        let (byte, bit) = self.byte_and_bit(i, j, k);
        if self.bytes[byte] & bit == 0 {
            let cell = self.cell_index(i >> 6, j, k);
            self.bytes[byte] |= bit;
            self.cell_counts[cell] += 1;
            self.solid_count += 1;
        }
    }

    /// Makes a voxel empty.
    pub fn empty(&mut self, [i, j, k]: [usize; 3]) {
        let (byte, bit) = self.byte_and_bit(i, j, k);
        if self.bytes[byte] & bit != 0 {
            let cell = self.cell_index(i >> 6, j, k);
            self.bytes[byte] &= !bit;
            self.cell_counts[cell] -= 1;
            self.solid_count -= 1;
        }
    }

    /// Returns the position in a row, the same for all rows, of the window of [`WINDOW_VOXELS`] voxels
    /// starting at `start`. A start more than 64 voxels outside is moved to a position where the window is
    /// also empty.
    #[inline]
    pub fn window_place(&self, start: i64) -> WindowPlace {
        let start = start.clamp(-64, self.dims[0] as i64) + 64;
        WindowPlace { byte: (start >> 3) as usize, shift: (start & 7) as u32 }
    }

    /// Returns the window of row (j, k), both inside the grid, as bits; voxels outside the grid are 0. Bits
    /// from [`WINDOW_VOXELS`] up are undefined.
    #[inline]
    pub fn window(&self, place: WindowPlace, j: usize, k: usize) -> u64 {
        self.window_at(place, k * self.slice_stride() + j * self.row_stride)
    }

    /// Returns the window of the row whose bytes start at `row`: see [`Self::row_stride`].
    #[inline]
    pub fn window_at(&self, place: WindowPlace, row: usize) -> u64 {
        match self.bytes.get(row + place.byte..).and_then(|bytes| bytes.first_chunk()) {
            Some(bytes) => u64::from_le_bytes(*bytes) >> place.shift,
            None => 0,
        }
    }

    /// Reads eight voxels along x from `start`, as bits, for N rows of N slices; voxels outside the grid are
    /// 0.
    #[inline]
    pub fn cube<const N: usize>(&self, start: [i64; 3], rows: &mut [[u8; N]; N]) {
        let place = self.window_place(start[0]);
        let [y, z] = [1, 2].map(|axis| {
            let end = (self.dims[axis] as i64 - start[axis]).clamp(0, N as i64) as usize;
            (-start[axis]).clamp(0, end as i64) as usize..end
        });
        for slice in z {
            let k = (start[2] + slice as i64) as usize;
            let first =
                k * self.slice_stride() + (start[1] + y.start as i64) as usize * self.row_stride + place.byte;
            let mut from = self.bytes.get(first..).unwrap_or_default().chunks_exact(self.row_stride);
            // Two bytes always contain eight consecutive voxels.
            let mut next = || match from.next() {
                Some([low, high, ..]) => (u16::from_le_bytes([*low, *high]) >> place.shift) as u8,
                _ => 0,
            };
            if y.len() == N {
                // The common case: without the bounds check, the compiler unrolls it.
                rows[slice] = core::array::from_fn(|_| next());
            } else {
                rows[slice][y.clone()].iter_mut().for_each(|row| *row = next());
            }
        }
    }

    /// Returns the bytes between neighbouring rows along y; row (j, k) starts at `k * slice_stride + j *
    /// row_stride`.
    #[inline]
    pub fn row_stride(&self) -> usize {
        self.row_stride
    }

    /// Returns the bytes between neighbouring rows along z.
    #[inline]
    pub fn slice_stride(&self) -> usize {
        self.row_stride * self.dims[1]
    }

    /// Returns true if any coarse cell that overlaps the box contains bone.
    pub fn any_in(&self, voxels: &VoxelBox) -> bool {
        let cells = |axis: usize, shift: usize| {
            (voxels.low[axis] as usize >> shift)..=(voxels.high[axis] as usize >> shift)
        };
        cells(2, CELL_SHIFT).any(|ck| {
            cells(1, CELL_SHIFT).any(|cj| {
                let row = (ck * self.cell_dims[1] + cj) * self.cell_dims[0];
                cells(0, 6).any(|word| self.cell_counts[row + word] != 0)
            })
        })
    }

    /// Returns the voxels whose boxes overlap the axis-aligned cube of half edge `reach_m` about a point in
    /// the grid's metric frame; `None` if there are none.
    pub fn voxels_around(&self, centre: [f64; 3], reach_m: f64, spacing_m: [f64; 3]) -> Option<VoxelBox> {
        self.voxels_in_box(centre, [reach_m; 3], spacing_m)
    }

    /// Returns the same for a box with these half edges.
    pub fn voxels_in_box(
        &self,
        centre: [f64; 3],
        reach_m: [f64; 3],
        spacing_m: [f64; 3],
    ) -> Option<VoxelBox> {
        let (mut low, mut high) = ([0; 3], [0; 3]);
        for axis in 0..3 {
            let inverse = 1.0 / spacing_m[axis];
            low[axis] = floor_to_i64((centre[axis] - reach_m[axis]) * inverse + 0.5).max(0);
            high[axis] =
                floor_to_i64((centre[axis] + reach_m[axis]) * inverse + 0.5).min(self.dims[axis] as i64 - 1);
            if low[axis] > high[axis] {
                return None;
            }
        }
        Some(VoxelBox { low, high })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_word_has_the_bit_of_each_value(
            values in proptest::collection::vec(-3_i16..3, 0..=64),
            threshold_hu in -3_i16..3,
        ) {
            let bits = values.iter().enumerate();
            let one_by_one = bits.map(|(bit, value)| u64::from(*value >= threshold_hu) << bit);
            prop_assert_eq!(bits_of(&values, threshold_hu), one_by_one.fold(0, |word, bit| word | bit));
        }
    }
}
