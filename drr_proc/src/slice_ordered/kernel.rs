//! The sum over slices, eight rows of the intermediate image at a time.
//!
//! For each slice, groups of 16 samples are interpolated with integer weights and added to 32-bit sums, which go over into
//! 64-bit ones before they can overflow. [`Lanes`] is the part that instruction sets do differently; all of them compute the
//! same integers.

use super::copies::{Copy3, Voxel, WINDOW};
use super::plan::{FRACTION_MASK, GROUP, LANE_BITS, Plan, Slice, TILE_ROWS, WEIGHT_BITS, weights};

/// 32-bit sums of one group: eight rows of 16 samples.
pub(crate) type GroupSums = [[i32; GROUP]; TILE_ROWS];

/// Most rows of voxels that the eight image rows of a tile read: the step is at most one voxel.
const MAX_LINES: usize = TILE_ROWS + 2;

/// How a tile's rows lie in a slice.
#[derive(Debug)]
pub(crate) struct TileRows {
    /// Image rows of the tile that meet the slice, half open.
    pub rows: (usize, usize),
    /// For each image row its first line, and its 14-bit fraction in every lane.
    pub line: [usize; TILE_ROWS],
    pub fraction: [[u16; 2 * GROUP]; TILE_ROWS],
    /// Offsets in the copy of the first voxel of each line.
    pub offsets: [usize; MAX_LINES],
    pub lines: usize,
    /// Step between samples, 27 bits.
    pub lane_step: u32,
    /// Distance in the copy to the next slice.
    pub next_slice: usize,
}

/// One group of samples in a slice: voxel (may be negative) and 27-bit fraction at which it begins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupPlace {
    pub voxel: i64,
    pub fraction: u32,
}

/// An instruction set.
pub(crate) trait Lanes: Copy {
    /// Constants of a slice, kept in registers.
    type PerSlice: Copy;
    /// Works out the constants of a slice.
    fn per_slice(self, lane_step: u32) -> Self::PerSlice;
    /// Adds one group of samples to its sums.
    fn add_group<T: Voxel>(
        self,
        constants: Self::PerSlice,
        data: &[T],
        rows: &TileRows,
        place: GroupPlace,
        sums: &mut GroupSums,
    );
    /// Asks for a cache line.
    fn prefetch<T>(self, data: &[T], offset: usize);
}

/// The window of 32 voxels at an offset; zeros where there is none, which the zeros between rows rule out.
#[inline(always)]
pub(crate) fn window<T: Voxel>(data: &[T], offset: usize) -> [i16; WINDOW] {
    match data.get(offset..).and_then(|rest| rest.first_chunk::<WINDOW>()) {
        Some(window) => T::widen(window),
        None => [0; WINDOW],
    }
}

/// No special instructions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scalar;

impl Lanes for Scalar {
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
        let mut offsets = [0_usize; GROUP];
        let mut fractions = [0_u32; GROUP];
        for (lane, (offset, fraction)) in offsets.iter_mut().zip(&mut fractions).enumerate() {
            let position = place.fraction + lane as u32 * lane_step;
            *offset = (position >> LANE_BITS) as usize;
            *fraction = (position >> (LANE_BITS - WEIGHT_BITS)) & FRACTION_MASK;
        }
        for (row, sums) in sums.iter_mut().enumerate().take(rows.rows.1).skip(rows.rows.0) {
            let line = rows.line[row];
            let at = |line: usize| window(data, rows.offsets[line].wrapping_add_signed(place.voxel as isize));
            let (upper, lower) = (at(line), at(line + 1));
            let fy = u32::from(rows.fraction[row][0]);
            for (lane, sum) in sums.iter_mut().enumerate() {
                let (x, w) = (offsets[lane], weights(fractions[lane], fy));
                let voxel = |row: &[i16; WINDOW], x: usize| i32::from(row[x & (WINDOW - 1)]);
                *sum += voxel(&upper, x) * w[0]
                    + voxel(&upper, x + 1) * w[1]
                    + voxel(&lower, x) * w[2]
                    + voxel(&lower, x + 1) * w[3];
            }
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, _data: &[T], _offset: usize) {}
}

/// Work space of a thread.
pub(crate) struct Work {
    sums: Vec<GroupSums>,
    occupied: Vec<u64>,
    rows: TileRows,
}

impl Work {
    pub fn new(plan: &Plan, words_per_row: usize) -> Self {
        Self {
            sums: vec![[[0; GROUP]; TILE_ROWS]; plan.columns / GROUP],
            occupied: vec![0; words_per_row],
            rows: TileRows {
                rows: (0, 0),
                line: [0; TILE_ROWS],
                fraction: [[0; 2 * GROUP]; TILE_ROWS],
                offsets: [0; MAX_LINES],
                lines: 0,
                lane_step: 0,
                next_slice: 0,
            },
        }
    }
}

/// Sums all slices into the tile of eight rows that begins at image row `first_row`; `out` is the tile, row by row.
/// `flush_after` slices at most are summed in 32 bits.
#[inline(always)]
pub(crate) fn sum_tile<T: Voxel, L: Lanes>(
    lanes: L,
    copy: &Copy3<T>,
    plan: &Plan,
    flush_after: usize,
    first_row: usize,
    work: &mut Work,
    out: &mut [i64],
) {
    out.fill(0);
    let mut summed = 0;
    let mut touched = (usize::MAX, 0);
    for slice in &plan.slices {
        let (low, high) = (slice.rows.0.max(first_row), slice.rows.1.min(first_row + TILE_ROWS));
        if low >= high || slice.groups.0 >= slice.groups.1 {
            continue;
        }
        if !place_rows(copy, plan, slice, first_row, (low, high), work) {
            continue;
        }
        touched = (touched.0.min(slice.groups.0), touched.1.max(slice.groups.1));
        sum_slice(lanes, copy.data(), slice, work);
        summed += 1;
        if summed == flush_after {
            flush(work, plan.columns, touched, out);
            (summed, touched) = (0, (usize::MAX, 0));
        }
    }
    flush(work, plan.columns, touched, out);
}

/// Works out which lines of voxels the tile reads in a slice; false if nothing attenuates in them.
#[inline(always)]
fn place_rows<T: Voxel>(
    copy: &Copy3<T>,
    plan: &Plan,
    slice: &Slice,
    first_row: usize,
    (low, high): (usize, usize),
    work: &mut Work,
) -> bool {
    let (first_line, _) = slice.row(low);
    let (last_line, _) = slice.row(high - 1);
    let rows = &mut work.rows;
    rows.lines = ((last_line - first_line) as usize + 2).min(MAX_LINES);
    work.occupied.fill(0);
    for line in 0..rows.lines {
        let (offset, occupied) = copy.row(plan.axes.slow, slice.index, plan.axes.v, first_line + line as i64);
        rows.offsets[line] = offset;
        for (all, word) in work.occupied.iter_mut().zip(occupied) {
            *all |= word;
        }
    }
    if work.occupied.iter().all(|&word| word == 0) {
        return false;
    }
    rows.rows = (low - first_row, high - first_row);
    for row in low..high {
        let (line, fraction) = slice.row(row);
        rows.line[row - first_row] = ((line - first_line) as usize).min(MAX_LINES - 2);
        rows.fraction[row - first_row] = [fraction as u16; 2 * GROUP];
    }
    rows.lane_step = slice.lane_step();
    rows.next_slice = copy.stride(plan.axes.slow);
    true
}

#[inline(always)]
fn sum_slice<T: Voxel, L: Lanes>(lanes: L, data: &[T], slice: &Slice, work: &mut Work) {
    let constants = lanes.per_slice(work.rows.lane_step);
    let line_voxels = 64 / size_of::<T>();
    let mut asked = i64::MIN;
    for group in slice.groups.0..slice.groups.1 {
        let place = slice.group(group);
        // Bit 0 stands for windows that begin before the row.
        let cell = ((place.voxel + WINDOW as i64) >> 5) as usize;
        let word = work.occupied.get(cell / 64).copied().unwrap_or(0);
        if word >> (cell % 64) & 1 == 0 {
            continue;
        }
        if place.voxel >= asked {
            // The same lines of the next slice: the positions there differ by less than a voxel or two.
            asked = place.voxel + line_voxels as i64;
            for &offset in &work.rows.offsets[..work.rows.lines] {
                lanes.prefetch(
                    data,
                    (offset + work.rows.next_slice).wrapping_add_signed(place.voxel as isize),
                );
            }
        }
        let place = GroupPlace { voxel: place.voxel, fraction: place.fraction };
        if let Some(sums) = work.sums.get_mut(group) {
            lanes.add_group(constants, data, &work.rows, place, sums);
        }
    }
}

/// Moves the 32-bit sums over into the 64-bit ones.
#[inline(always)]
fn flush(work: &mut Work, columns: usize, (first, end): (usize, usize), out: &mut [i64]) {
    for group in first..end {
        let Some(sums) = work.sums.get_mut(group) else { continue };
        for (row, sums) in sums.iter_mut().enumerate() {
            let start = row * columns + group * GROUP;
            if let Some(out) = out.get_mut(start..start + GROUP) {
                for (o, s) in out.iter_mut().zip(sums.iter_mut()) {
                    *o += i64::from(*s);
                    *s = 0;
                }
            }
        }
    }
}
