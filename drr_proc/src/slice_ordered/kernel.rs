//! The sum over slices, eight rows of the intermediate image at a time.
//!
//! In each slice the rows of voxels are first blended into the eight rows that the image has there, as 16-bit integers, 32 voxels at a
//! time; then groups of 16 samples are interpolated along these rows and added to 32-bit sums, which go over into 64-bit ones
//! before they can overflow. Cells in which nothing attenuates are left out. [`Lanes`] is the part that instruction sets do differently;
//! all of them compute the same integers.

use super::copies::{CELL, Cell16, Copy3, Voxel, voxels};
use super::plan::{FRACTION_MASK, GROUP, LANE_BITS, Plan, ROW_BITS, Slice, TILE_ROWS, WEIGHT_BITS};

/// 32-bit sums of one group: eight rows of 16 samples.
pub(crate) type GroupSums = [[i32; GROUP]; TILE_ROWS];

/// Most rows of voxels that the eight image rows of a tile read: the step is at most one voxel.
const MAX_LINES: usize = TILE_ROWS + 2;
/// Runs of cells with fewer empty ones between them are joined: a group of samples then reads one run only.
const JOINED: usize = 2;
/// Voxels that a group's window holds from the one on in which the group begins.
pub(crate) const WINDOW: usize = 32;

/// One group of samples in a slice: the blended voxel and the 27-bit fraction at which it begins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupPlace {
    pub first: usize,
    pub fraction: u32,
}

/// The blended rows of a tile, of equal length.
pub(crate) type BlendedRows<'a> = [&'a [i16]; TILE_ROWS];

/// An instruction set.
pub(crate) trait Lanes: Copy {
    /// Constants of a slice, kept in registers.
    type PerSlice: Copy;
    /// Works out the constants of a slice.
    fn per_slice(self, lane_step: u32) -> Self::PerSlice;
    /// Writes the row at a 15-bit fraction between two rows of voxels.
    fn blend<T: Voxel>(self, upper: &[T::Cell], lower: &[T::Cell], fraction: i16, out: &mut [Cell16]);
    /// Adds one group of samples of eight rows to its sums.
    fn add_group(
        self,
        constants: Self::PerSlice,
        rows: &BlendedRows<'_>,
        place: GroupPlace,
        sums: &mut GroupSums,
    );
    /// Asks for a cache line.
    fn prefetch<T>(self, data: &[T], offset: usize);
}

/// A voxel between two rows: `a + (b - a) fraction`, rounded to the nearest integer, halves up.
#[inline(always)]
pub(crate) fn between(a: i16, b: i16, fraction: i16) -> i16 {
    // Values are 0 to 32767, so the difference fits.
    let product = i32::from(b.wrapping_sub(a)) * i32::from(fraction);
    a.wrapping_add(((product + (1 << (ROW_BITS - 1))) >> ROW_BITS) as i16)
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
    fn blend<T: Voxel>(self, upper: &[T::Cell], lower: &[T::Cell], fraction: i16, out: &mut [Cell16]) {
        for ((out, upper), lower) in out.iter_mut().zip(upper).zip(lower) {
            let (a, b) = (T::widen(upper), T::widen(lower));
            for n in 0..CELL {
                out.0[n] = between(a[n], b[n], fraction);
            }
        }
    }

    #[inline(always)]
    fn add_group(self, lane_step: u32, rows: &BlendedRows<'_>, place: GroupPlace, sums: &mut GroupSums) {
        let mut offsets = [0_usize; GROUP];
        let mut weights = [[0_i32; 2]; GROUP];
        for lane in 0..GROUP {
            let position = place.fraction + lane as u32 * lane_step;
            let fraction = (position >> (LANE_BITS - WEIGHT_BITS)) & FRACTION_MASK;
            // Within the window: the step is at most one voxel.
            offsets[lane] = ((position >> LANE_BITS) as usize).min(GROUP);
            weights[lane] = [(1 << WEIGHT_BITS) - fraction as i32, fraction as i32];
        }
        for (row, sums) in rows.iter().zip(sums) {
            let Some(window) = window(row, place.first) else { return };
            for lane in 0..GROUP {
                let (x, w) = (offsets[lane], weights[lane]);
                sums[lane] += i32::from(window[x]) * w[0] + i32::from(window[x + 1]) * w[1];
            }
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, _data: &[T], _offset: usize) {}
}

/// The window of a group in a blended row; the cells before and behind the row rule out that there is none.
#[inline(always)]
pub(crate) fn window(row: &[i16], first: usize) -> Option<&[i16; WINDOW]> {
    row.get(first..).and_then(|rest| rest.first_chunk())
}

/// How a tile's rows lie in a slice.
#[derive(Debug, Default)]
struct TileRows {
    /// For each image row its first line, and the 15-bit fraction to the next.
    line: [usize; TILE_ROWS],
    fraction: [i16; TILE_ROWS],
    /// First cells of the lines in the copy.
    offsets: [usize; MAX_LINES],
    lines: usize,
}

/// Work space of a thread.
pub(crate) struct Work {
    sums: Vec<GroupSums>,
    /// Eight rows of cells, with one of zeros on either side.
    blended: Vec<Cell16>,
    occupied: Vec<u64>,
    rows: TileRows,
}

impl Work {
    pub fn new<T: Voxel>(plan: &Plan, copy: &Copy3<T>) -> Self {
        Self {
            sums: vec![[[0; GROUP]; TILE_ROWS]; plan.columns / GROUP],
            blended: vec![Cell16::default(); TILE_ROWS * (copy.row_cells() + 2)],
            occupied: vec![0; copy.words_per_row()],
            rows: TileRows::default(),
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
        if !place_rows(copy, plan, slice, first_row, work) {
            continue;
        }
        sum_slice(lanes, copy, plan, slice, work, &mut touched);
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
    work: &mut Work,
) -> bool {
    let (first_line, _) = slice.row(first_row);
    let (last_line, _) = slice.row(first_row + TILE_ROWS - 1);
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
    for row in 0..TILE_ROWS {
        let (line, fraction) = slice.row(first_row + row);
        rows.line[row] = ((line - first_line) as usize).min(MAX_LINES - 2);
        rows.fraction[row] = fraction;
    }
    true
}

/// The first run of occupied cells from `from` on, half open.
#[inline(always)]
fn next_run(occupied: &[u64], from: usize) -> Option<(usize, usize)> {
    let next = |from: usize, wanted: bool| {
        let mut word = from / 64;
        let mut skip = u64::MAX << (from % 64);
        while let Some(&bits) = occupied.get(word) {
            let found = if wanted { bits } else { !bits } & skip;
            if found != 0 {
                return word * 64 + found.trailing_zeros() as usize;
            }
            word += 1;
            skip = u64::MAX;
        }
        occupied.len() * 64
    };
    let first = next(from, true);
    if first >= occupied.len() * 64 {
        return None;
    }
    let mut end = next(first, false);
    loop {
        let again = next(end, true);
        if again >= occupied.len() * 64 || again - end > JOINED {
            return Some((first, end));
        }
        end = next(again, false);
    }
}

#[inline(always)]
fn sum_slice<T: Voxel, L: Lanes>(
    lanes: L,
    copy: &Copy3<T>,
    plan: &Plan,
    slice: &Slice,
    work: &mut Work,
    touched: &mut (usize, usize),
) {
    let Work { sums, blended, occupied, rows } = work;
    let (data, row_cells) = (copy.data(), copy.row_cells());
    let stride = row_cells + 2;
    let next_slice = copy.stride(plan.axes.slow);
    let constants = lanes.per_slice(slice.lane_step());
    let mut from = 0;
    while let Some((first, end)) = next_run(occupied, from) {
        from = end;
        let end = end.min(row_cells);
        let (low, high) = slice.groups_reading((first * CELL) as i64, (end * CELL) as i64);
        if low >= high {
            continue;
        }
        // The same lines of the next slice: the positions there differ by less than a voxel or two.
        for &offset in &rows.offsets[..rows.lines] {
            for cell in first..end {
                lanes.prefetch(data, offset + next_slice + cell);
            }
        }
        for (row, out) in blended.chunks_exact_mut(stride).enumerate() {
            let line = |line: usize| {
                let start = rows.offsets[rows.line[row] + line] + first;
                data.get(start..start + (end - first)).unwrap_or(&[])
            };
            out[first] = Cell16::default();
            out[end + 1] = Cell16::default();
            lanes.blend::<T>(line(0), line(1), rows.fraction[row], &mut out[first + 1..=end]);
        }
        let blended = voxels::<i16>(blended);
        let length = stride * CELL;
        let rows: BlendedRows<'_> =
            core::array::from_fn(|row| blended.get(row * length..(row + 1) * length).unwrap_or(&[]));
        let groups = sums.get_mut(low..high).unwrap_or(&mut []);
        for (n, sums) in groups.iter_mut().enumerate() {
            let start = slice.group(low + n);
            // One cell of zeros lies before the row.
            let place = GroupPlace { first: (start.voxel + CELL as i64) as usize, fraction: start.fraction };
            lanes.add_group(constants, &rows, place, sums);
        }
        *touched = (touched.0.min(low), touched.1.max(high));
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
