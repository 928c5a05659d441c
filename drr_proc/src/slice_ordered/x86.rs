//! AVX-512 (BW) and AVX2: the integers of [`Scalar`](super::kernel::Scalar), 16 samples at a time.
//!
//! `pulp` proves at run time that the instructions exist; its tokens make calling them safe.

use core::arch::x86_64::{__m128i, __m256i, __m512i, _MM_HINT_T0};

use pulp::bytemuck::cast;
use pulp::x86::{V3, V4};

use super::copies::{Voxel, WINDOW};
use super::kernel::{GroupPlace, GroupSums, Lanes, TileRows, window};
use super::plan::{FRACTION_MASK, GROUP, LANE_BITS, WEIGHT_BITS};

const LINES: usize = 10;
/// Both 16-bit halves of a 32-bit lane.
const BOTH: i32 = 0x0001_0001;
/// The first voxel of every pair.
const FIRST_OF_PAIR: u32 = 0x5555_5555;

/// AVX-512.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Avx512(pub V4);

impl Lanes for Avx512 {
    type PerSlice = __m512i;

    #[inline(always)]
    fn per_slice(self, lane_step: u32) -> __m512i {
        let steps: [u32; GROUP] = core::array::from_fn(|lane| lane as u32 * lane_step);
        cast(steps)
    }

    #[inline(always)]
    fn add_group<T: Voxel>(
        self,
        steps: __m512i,
        data: &[T],
        rows: &TileRows,
        place: GroupPlace,
        sums: &mut GroupSums,
    ) {
        let (f, bw) = (self.0.avx512f, self.0.avx512bw);
        let position = f._mm512_add_epi32(f._mm512_set1_epi32(place.fraction as i32), steps);
        let offset = f._mm512_srli_epi32::<LANE_BITS>(position);
        let mask = f._mm512_set1_epi32(FRACTION_MASK as i32);
        let fx = f._mm512_and_si512(f._mm512_srli_epi32::<{ LANE_BITS - WEIGHT_BITS }>(position), mask);
        // Pairs of neighbours (x, x + 1), their weights (2^14 - fx, fx) and the factor (4 fx, 4 fx).
        let doubled = f._mm512_or_si512(offset, f._mm512_slli_epi32::<16>(offset));
        let pairs = f._mm512_add_epi32(doubled, f._mm512_set1_epi32(0x1_0000));
        let fx_high = f._mm512_slli_epi32::<16>(fx);
        let whole = f._mm512_set1_epi32(1 << WEIGHT_BITS);
        let along = f._mm512_or_si512(f._mm512_sub_epi32(whole, fx), fx_high);
        let factor = f._mm512_slli_epi32::<2>(f._mm512_or_si512(fx, fx_high));
        let mut lines: [__m512i; LINES] = [f._mm512_setzero_si512(); LINES];
        for (line, &offset) in lines.iter_mut().zip(&rows.offsets[..rows.lines]) {
            let voxels: __m512i = cast(window(data, offset.wrapping_add_signed(place.voxel as isize)));
            *line = bw._mm512_permutexvar_epi16(pairs, voxels);
        }
        for (row, sums) in sums.iter_mut().enumerate().take(rows.rows.1).skip(rows.rows.0) {
            let fy: __m512i = cast(rows.fraction[row]);
            let both = bw._mm512_mulhi_epu16(factor, fy);
            let lower = bw._mm512_mask_sub_epi16(both, FIRST_OF_PAIR, fy, both);
            let upper = bw._mm512_sub_epi16(along, lower);
            let line = rows.line[row].min(LINES - 2);
            let sum: __m512i = cast(*sums);
            let sum = f._mm512_add_epi32(sum, bw._mm512_madd_epi16(lines[line], upper));
            *sums = cast(f._mm512_add_epi32(sum, bw._mm512_madd_epi16(lines[line + 1], lower)));
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, data: &[T], offset: usize) {
        self.0.sse._mm_prefetch::<_MM_HINT_T0>(data.as_ptr().wrapping_add(offset).cast());
    }
}

/// AVX2.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Avx2(pub V3);

/// Lanes of a 256-bit register.
const HALF: usize = GROUP / 2;

impl Avx2 {
    /// Eight samples, from lane 0 or 8 of the group on.
    #[inline(always)]
    fn add_half<T: Voxel>(
        self,
        first: usize,
        lane_step: u32,
        data: &[T],
        rows: &TileRows,
        place: GroupPlace,
        sums: &mut GroupSums,
    ) {
        let (avx, avx2) = (self.0.avx, self.0.avx2);
        let at = |lane: usize| place.fraction + (first + lane) as u32 * lane_step;
        let positions: [u32; HALF] = core::array::from_fn(at);
        let position: __m256i = cast(positions);
        let offset = avx2._mm256_srli_epi32::<{ LANE_BITS as i32 }>(position);
        let mask = avx._mm256_set1_epi32(FRACTION_MASK as i32);
        let fx = avx2
            ._mm256_and_si256(avx2._mm256_srli_epi32::<{ (LANE_BITS - WEIGHT_BITS) as i32 }>(position), mask);
        // Each half of the register holds four samples, and eight voxels from the first sample's on.
        let starts = [positions[0] >> LANE_BITS, positions[HALF / 2] >> LANE_BITS];
        let [low, high] = starts.map(|s| s as i32);
        let inside = avx2._mm256_sub_epi32(offset, cast([low, low, low, low, high, high, high, high]));
        // Bytes 2 x, 2 x + 1, 2 x + 2, 2 x + 3 of the voxels.
        let spread: __m256i = cast([[0_u8, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12]; 2]);
        let twice = avx2._mm256_shuffle_epi8(avx2._mm256_slli_epi32::<1>(inside), spread);
        let pairs = avx2._mm256_add_epi8(twice, avx._mm256_set1_epi32(0x0302_0100));
        let fx_high = avx2._mm256_slli_epi32::<16>(fx);
        let whole = avx._mm256_set1_epi32(1 << WEIGHT_BITS);
        let along = avx2._mm256_or_si256(avx2._mm256_sub_epi32(whole, fx), fx_high);
        let factor = avx2._mm256_slli_epi32::<2>(avx2._mm256_or_si256(fx, fx_high));
        let first_of_pair = avx._mm256_set1_epi32(0xFFFF);
        let mut lines: [__m256i; LINES] = [avx._mm256_setzero_si256(); LINES];
        for (line, &offset) in lines.iter_mut().zip(&rows.offsets[..rows.lines]) {
            let voxels = window(data, offset.wrapping_add_signed(place.voxel as isize));
            let [low, high] = starts.map(|start| eight(&voxels, start as usize));
            let both = avx2._mm256_inserti128_si256::<1>(avx._mm256_castsi128_si256(low), high);
            *line = avx2._mm256_shuffle_epi8(both, pairs);
        }
        for (row, sums) in sums.iter_mut().enumerate().take(rows.rows.1).skip(rows.rows.0) {
            let fy = avx._mm256_set1_epi32(i32::from(rows.fraction[row][0]) * BOTH);
            let both = avx2._mm256_mulhi_epu16(factor, fy);
            // (fy - both, both): fy - both in the first of each pair, both in the second.
            let rest = avx2._mm256_sub_epi16(fy, both);
            let lower = avx2._mm256_or_si256(
                avx2._mm256_and_si256(rest, first_of_pair),
                avx2._mm256_andnot_si256(first_of_pair, both),
            );
            let upper = avx2._mm256_sub_epi16(along, lower);
            let line = rows.line[row].min(LINES - 2);
            let Some(part) = sums.get_mut(first..first + HALF).and_then(|s| s.first_chunk_mut::<HALF>())
            else {
                continue;
            };
            let sum: __m256i = cast(*part);
            let sum = avx2._mm256_add_epi32(sum, avx2._mm256_madd_epi16(lines[line], upper));
            *part = cast(avx2._mm256_add_epi32(sum, avx2._mm256_madd_epi16(lines[line + 1], lower)));
        }
    }
}

/// Eight voxels of a window.
#[inline(always)]
fn eight(voxels: &[i16; WINDOW], start: usize) -> __m128i {
    match voxels.get(start..).and_then(|rest| rest.first_chunk::<8>()) {
        Some(&eight) => cast(eight),
        None => cast([0_i16; 8]),
    }
}

impl Lanes for Avx2 {
    type PerSlice = u32;

    #[inline(always)]
    fn per_slice(self, lane_step: u32) -> u32 {
        lane_step
    }

    #[inline(always)]
    fn add_group<T: Voxel>(
        self,
        lane_step: u32,
        data: &[T],
        rows: &TileRows,
        place: GroupPlace,
        sums: &mut GroupSums,
    ) {
        self.add_half(0, lane_step, data, rows, place, sums);
        self.add_half(HALF, lane_step, data, rows, place, sums);
    }

    #[inline(always)]
    fn prefetch<T>(self, data: &[T], offset: usize) {
        self.0.sse._mm_prefetch::<_MM_HINT_T0>(data.as_ptr().wrapping_add(offset).cast());
    }
}
