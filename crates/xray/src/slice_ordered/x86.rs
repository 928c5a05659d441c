//! AVX-512 (BW) and AVX2: the same integers as [`Scalar`](super::kernel::Scalar), 32 voxels and 16 samples at
//! a time.
//!
//! `pulp` checks at run time that the instructions exist; its tokens make calling them safe.

use core::arch::x86_64::{__m128i, __m256i, __m512i, _MM_HINT_T0};

use pulp::bytemuck::cast;
use pulp::x86::{V3, V4};

use super::copies::{Cell16, LEVELS, Voxel};
use super::kernel::{BlendedRows, GroupPlace, GroupSums, Lanes, WINDOW};
use super::plan::{FRACTION_MASK, GROUP, LANE_BITS, WEIGHT_BITS};

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
    fn blend<T: Voxel>(self, upper: &[T::Cell], lower: &[T::Cell], fraction: i16, out: &mut [Cell16]) {
        let bw = self.0.avx512bw;
        let fraction: __m512i = cast([fraction; 32]);
        for ((out, upper), lower) in out.iter_mut().zip(upper).zip(lower) {
            let (a, b): (__m512i, __m512i) = (cast(T::widen(upper)), cast(T::widen(lower)));
            let part = bw._mm512_mulhrs_epi16(bw._mm512_sub_epi16(b, a), fraction);
            out.0 = cast(bw._mm512_add_epi16(a, part));
        }
    }

    #[inline(always)]
    fn add_group(self, steps: __m512i, rows: BlendedRows<'_>, place: GroupPlace, sums: &mut GroupSums) {
        let (f, bw) = (self.0.avx512f, self.0.avx512bw);
        let position = f._mm512_add_epi32(f._mm512_set1_epi32(place.fraction as i32), steps);
        let offset = f._mm512_srli_epi32::<LANE_BITS>(position);
        let mask = f._mm512_set1_epi32(FRACTION_MASK as i32);
        let fx = f._mm512_and_si512(f._mm512_srli_epi32::<{ LANE_BITS - WEIGHT_BITS }>(position), mask);
        // Pairs of neighbours (x, x + 1) and their weights (2^14 - fx, fx).
        let doubled = f._mm512_or_si512(offset, f._mm512_slli_epi32::<16>(offset));
        let pairs = f._mm512_add_epi32(doubled, f._mm512_set1_epi32(0x1_0000));
        let whole = f._mm512_set1_epi32(1 << WEIGHT_BITS);
        let along = f._mm512_or_si512(f._mm512_sub_epi32(whole, fx), f._mm512_slli_epi32::<16>(fx));
        for (window, sums) in rows.windows(place.first).zip(sums) {
            let voxels: __m512i = cast(*window);
            let products = bw._mm512_madd_epi16(bw._mm512_permutexvar_epi16(pairs, voxels), along);
            *sums = cast(f._mm512_add_epi32(cast(*sums), products));
        }
    }

    #[inline(always)]
    fn join(self, rows: &[&[u8]], at: usize, before: &[u8; LEVELS]) -> ([u8; LEVELS], u32) {
        Avx2(*self.0).join(rows, at, before)
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

/// Positions of eight samples relative to the start of their group.
#[derive(Clone, Copy)]
pub(crate) struct HalfSteps {
    each: __m256i,
    /// The first and the fifth again, as scalars: an address is ready sooner when computed from a scalar
    /// register.
    starts: [u32; 2],
}

/// Positions of eight samples in a group's window, and their weights.
#[derive(Clone, Copy)]
struct HalfGroup {
    /// First voxel of the first four and of the last four samples.
    starts: [usize; 2],
    /// Byte indices of the neighbour pairs within the eight voxels from there.
    pairs: __m256i,
    /// Weights of the pairs.
    along: __m256i,
}

impl Avx2 {
    /// Eight samples of a group that starts at `fraction`.
    #[inline(always)]
    fn half_group(self, steps: &HalfSteps, fraction: u32) -> HalfGroup {
        let (avx, avx2) = (self.0.avx, self.0.avx2);
        let position = avx2._mm256_add_epi32(avx._mm256_set1_epi32(fraction as i32), steps.each);
        let offset = avx2._mm256_srli_epi32::<{ LANE_BITS as i32 }>(position);
        let mask = avx._mm256_set1_epi32(FRACTION_MASK as i32);
        let fx = avx2
            ._mm256_and_si256(avx2._mm256_srli_epi32::<{ (LANE_BITS - WEIGHT_BITS) as i32 }>(position), mask);
        // Each half of the register holds four samples, and the eight voxels from the first sample on.
        let inside = avx2._mm256_sub_epi32(offset, avx2._mm256_shuffle_epi32::<0>(offset));
        // Bytes 2 x, 2 x + 1, 2 x + 2, 2 x + 3 of the voxels.
        let spread: __m256i = cast([[0_u8, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12]; 2]);
        let twice = avx2._mm256_shuffle_epi8(avx2._mm256_slli_epi32::<1>(inside), spread);
        let pairs = avx2._mm256_add_epi8(twice, avx._mm256_set1_epi32(0x0302_0100));
        let whole = avx._mm256_set1_epi32(1 << WEIGHT_BITS);
        let along = avx2._mm256_or_si256(avx2._mm256_sub_epi32(whole, fx), avx2._mm256_slli_epi32::<16>(fx));
        let starts = steps.starts.map(|step| ((fraction + step) >> LANE_BITS) as usize);
        HalfGroup { starts, pairs, along }
    }

    /// Adds eight samples of a row to their sums.
    #[inline(always)]
    fn add_half(self, half: &HalfGroup, window: &[i16; WINDOW], sums: &mut [i32; HALF]) {
        let (avx, avx2) = (self.0.avx, self.0.avx2);
        let [low, high] = half.starts.map(|start| eight(window, start));
        let both = avx2._mm256_inserti128_si256::<1>(avx._mm256_castsi128_si256(low), high);
        let products = avx2._mm256_madd_epi16(avx2._mm256_shuffle_epi8(both, half.pairs), half.along);
        *sums = cast(avx2._mm256_add_epi32(cast(*sums), products));
    }
}

/// Eight voxels of a window, starting at one of its first sixteen.
#[inline(always)]
fn eight(window: &[i16; WINDOW], start: usize) -> __m128i {
    // At most twelve steps of 1.25 voxels: the remainder changes nothing but proves the bound to the
    // compiler.
    cast(window[start % GROUP..].first_chunk::<8>().copied().unwrap_or_default())
}

impl Lanes for Avx2 {
    type PerSlice = [HalfSteps; 2];

    #[inline(always)]
    fn per_slice(self, lane_step: u32) -> [HalfSteps; 2] {
        let half = |first: usize| {
            let step = |lane: usize| (first + lane) as u32 * lane_step;
            let each: [u32; HALF] = core::array::from_fn(step);
            (each, [0, HALF / 2].map(step))
        };
        let [low, high] = [half(0), half(HALF)];
        [HalfSteps { each: cast(low.0), starts: low.1 }, HalfSteps { each: cast(high.0), starts: high.1 }]
    }

    #[inline(always)]
    fn blend<T: Voxel>(self, upper: &[T::Cell], lower: &[T::Cell], fraction: i16, out: &mut [Cell16]) {
        let avx2 = self.0.avx2;
        let fraction: __m256i = cast([fraction; 16]);
        for ((out, upper), lower) in out.iter_mut().zip(upper).zip(lower) {
            let (a, b): ([__m256i; 2], [__m256i; 2]) = (cast(T::widen(upper)), cast(T::widen(lower)));
            let half = |n: usize| {
                let part = avx2._mm256_mulhrs_epi16(avx2._mm256_sub_epi16(b[n], a[n]), fraction);
                avx2._mm256_add_epi16(a[n], part)
            };
            out.0 = cast([half(0), half(1)]);
        }
    }

    #[inline(always)]
    fn add_group(
        self,
        steps: [HalfSteps; 2],
        rows: BlendedRows<'_>,
        place: GroupPlace,
        sums: &mut GroupSums,
    ) {
        // Unrolled by hand: vector code in a closure is not inlined into the function that enables the
        // instruction set.
        let [low, high] = &steps;
        let halves = [self.half_group(low, place.fraction), self.half_group(high, place.fraction)];
        for (window, sums) in rows.windows(place.first).zip(sums) {
            for (half, sums) in halves.iter().zip(sums.as_chunks_mut::<HALF>().0) {
                self.add_half(half, window, sums);
            }
        }
    }

    #[inline(always)]
    fn join(self, rows: &[&[u8]], at: usize, before: &[u8; LEVELS]) -> ([u8; LEVELS], u32) {
        let (sse2, ssse3) = (self.0.sse2, self.0.ssse3);
        let mut first = sse2._mm_set1_epi8(-1);
        let mut differs = sse2._mm_setzero_si128();
        for (n, row) in rows.iter().enumerate() {
            let Some(row) = row.get(at..).and_then(|rest| rest.first_chunk::<LEVELS>()) else { continue };
            first = if n == 0 { cast(*row) } else { first };
            differs = sse2._mm_or_si128(differs, sse2._mm_xor_si128(cast(*row), first));
        }
        let same = sse2._mm_cmpeq_epi8(differs, sse2._mm_setzero_si128());
        let joined = sse2._mm_or_si128(first, sse2._mm_andnot_si128(same, sse2._mm_set1_epi8(-1)));
        // The last preceding cell, then all of these except the last.
        let previous = ssse3._mm_alignr_epi8::<15>(joined, cast(*before));
        let changed = !(sse2._mm_movemask_epi8(sse2._mm_cmpeq_epi8(joined, previous)) as u32) & 0xFFFF;
        (cast(joined), changed)
    }

    #[inline(always)]
    fn prefetch<T>(self, data: &[T], offset: usize) {
        self.0.sse._mm_prefetch::<_MM_HINT_T0>(data.as_ptr().wrapping_add(offset).cast());
    }
}
