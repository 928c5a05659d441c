//! The sum over slices, eight rows of the intermediate image at a time.
//!
//! In each slice, the voxel rows are first blended into the slice's eight image rows as 16-bit integers, 32 voxels at a time. Groups of
//! 16 samples are then interpolated along these rows and added to 32-bit sums, which are flushed into 64-bit ones before they can
//! overflow. Cells in which nothing attenuates are skipped. Between the groups of one slice, the data for the next slice are prefetched
//! ([`Ahead`]). Only [`Lanes`] differs between instruction sets; all of them compute the same integers.

use super::copies::{CELL, Cell16, Copy3, Voxel, voxels};
use super::plan::{
    FRACTION_MASK, GROUP, GROUP_REACH, LANE_BITS, MAX_LINES, Plan, ROW_BITS, Slice, TILE_ROWS, WEIGHT_BITS,
};

/// 32-bit sums of one group: eight rows of 16 samples.
pub(crate) type GroupSums = [[i32; GROUP]; TILE_ROWS];

/// Number of tiles summed together, and number of slices summed into one tile before the next.
pub(crate) const TILES: usize = 4;
const BLOCK_SLICES: usize = 32;
/// Runs separated by at most this many empty cells are merged, so that a group of samples reads only one run.
const JOINED: usize = 2;
/// Number of voxels in a group's window, which starts at the group's first voxel.
pub(crate) const WINDOW: usize = 32;

/// Start of one group of samples in a slice: the blended voxel and a 27-bit fraction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroupPlace {
    pub first: usize,
    pub fraction: u32,
}

/// The blended rows of a tile, concatenated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BlendedRows<'a> {
    voxels: &'a [i16],
    /// Voxels per row, at least 1. The same for all rows, so that the compiler emits only one bounds check per group.
    length: usize,
}

impl<'a> BlendedRows<'a> {
    /// The windows of a group. The cells before and after the rows guarantee that it exists.
    #[inline(always)]
    pub fn windows(self, first: usize) -> impl Iterator<Item = &'a [i16; WINDOW]> {
        self.voxels
            .chunks_exact(self.length)
            .map_while(move |row| row.get(first..first + WINDOW).and_then(|window| window.first_chunk()))
    }
}

/// An instruction set.
pub(crate) trait Lanes: Copy {
    /// Constants of a slice, held in registers.
    type PerSlice: Copy;
    /// Computes the constants of a slice.
    fn per_slice(self, lane_step: u32) -> Self::PerSlice;
    /// Interpolates the row at a 15-bit fraction between two voxel rows.
    fn blend<T: Voxel>(self, upper: &[T::Cell], lower: &[T::Cell], fraction: i16, out: &mut [Cell16]);
    /// Adds one group of samples from eight rows to its sums.
    fn add_group(
        self,
        constants: Self::PerSlice,
        rows: BlendedRows<'_>,
        place: GroupPlace,
        sums: &mut GroupSums,
    );
    /// Prefetches a cache line.
    fn prefetch<T>(self, data: &[T], offset: usize);
}

/// Interpolates between two rows: `a + (b - a) fraction`, rounded to nearest, halves up.
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
    fn add_group(self, lane_step: u32, rows: BlendedRows<'_>, place: GroupPlace, sums: &mut GroupSums) {
        let mut offsets = [0_usize; GROUP];
        let mut weights = [[0_i32; 2]; GROUP];
        for lane in 0..GROUP {
            let position = place.fraction + lane as u32 * lane_step;
            let fraction = (position >> (LANE_BITS - WEIGHT_BITS)) & FRACTION_MASK;
            // Always within the window; `min` proves it to the compiler.
            offsets[lane] = ((position >> LANE_BITS) as usize).min(GROUP_REACH as usize);
            weights[lane] = [(1 << WEIGHT_BITS) - fraction as i32, fraction as i32];
        }
        for (window, sums) in rows.windows(place.first).zip(sums) {
            for lane in 0..GROUP {
                let (x, w) = (offsets[lane], weights[lane]);
                sums[lane] += i32::from(window[x]) * w[0] + i32::from(window[x + 1]) * w[1];
            }
        }
    }

    #[inline(always)]
    fn prefetch<T>(self, _data: &[T], _offset: usize) {}
}

/// A run of cells summed at once, and the groups that read them; both half-open.
#[derive(Debug, Clone, Copy)]
struct Run {
    cells: (usize, usize),
    groups: (usize, usize),
}

/// Position of a tile's rows in a slice, and which of their cells are occupied.
#[derive(Debug, Default)]
struct TileRows {
    /// For each image row, its first voxel line and the 15-bit fraction to the next.
    line: [usize; TILE_ROWS],
    fraction: [i16; TILE_ROWS],
    /// First cells of the lines in the copy.
    offsets: [usize; MAX_LINES],
    lines: usize,
    /// Occupancy of the lines' cells, one bit each: set if any line's cell is occupied.
    occupied: Vec<u64>,
    runs: Vec<Run>,
    summed: Summed,
}

/// The samples of a tile that are summed in a slice; ranges are half-open.
#[derive(Debug, Default)]
struct Summed {
    /// Columns of each row.
    columns: [(usize, usize); TILE_ROWS],
    /// Groups with any of these columns, and groups of which all rows have all columns.
    any: (usize, usize),
    whole: (usize, usize),
}

impl Summed {
    #[inline(always)]
    fn of(plan: &Plan, slice: &Slice, first_row: usize) -> Self {
        if !plan.meets_detector(slice, first_row) {
            let all = plan.seen_columns(first_row);
            let groups = ((all.0 / GROUP).max(slice.groups.0), (all.1 / GROUP).min(slice.groups.1));
            return Self { columns: [all; TILE_ROWS], any: groups, whole: groups };
        }
        let columns: [(usize, usize); TILE_ROWS] =
            core::array::from_fn(|row| plan.summed_columns(slice, first_row + row));
        let filled = || columns.iter().filter(|row| row.0 < row.1);
        let any = filled().fold((usize::MAX, 0), |all, row| (all.0.min(row.0), all.1.max(row.1)));
        let whole = columns.iter().fold((0, usize::MAX), |all, row| (all.0.max(row.0), all.1.min(row.1)));
        let any = ((any.0 / GROUP).max(slice.groups.0), any.1.div_ceil(GROUP).min(slice.groups.1));
        Self { columns, any, whole: (whole.0.div_ceil(GROUP), whole.1 / GROUP) }
    }

    /// Adds those of a group's samples that are summed.
    #[inline(always)]
    fn add(&self, group: usize, samples: &GroupSums, sums: &mut GroupSums) {
        for ((sums, samples), columns) in sums.iter_mut().zip(samples).zip(&self.columns) {
            for lane in 0..GROUP {
                let column = group * GROUP + lane;
                let kept = columns.0 <= column && column < columns.1;
                sums[lane] += if kept { samples[lane] } else { 0 };
            }
        }
    }
}

impl TileRows {
    /// Finds the voxel lines that the tile reads in a slice; false if nothing attenuates in them.
    #[inline(always)]
    fn place<T: Voxel>(&mut self, copy: &Copy3<T>, plan: &Plan, slice: &Slice, first_row: usize) -> bool {
        self.runs.clear();
        self.summed = Summed::of(plan, slice, first_row);
        if self.summed.any.0 >= self.summed.any.1 {
            return false;
        }
        let (first_line, _) = slice.row(first_row);
        let (last_line, _) = slice.row(first_row + TILE_ROWS - 1);
        self.lines = ((last_line - first_line) as usize + 2).min(MAX_LINES);
        self.occupied.fill(0);
        for line in 0..self.lines {
            let (offset, occupied) = copy.row(plan.axes.slow, slice.index, first_line + line as i64);
            self.offsets[line] = offset;
            for (all, word) in self.occupied.iter_mut().zip(occupied) {
                *all |= word;
            }
        }
        let (mut from, read_end) = slice.cells_read(self.summed.any, copy.row_cells());
        while let Some((first, end)) = next_run(&self.occupied, from).filter(|run| run.0 < read_end) {
            from = end;
            let end = end.min(read_end);
            let groups = slice.groups_reading((first * CELL) as i64, (end * CELL) as i64, self.summed.any);
            if groups.0 < groups.1 {
                self.runs.push(Run { cells: (first, end), groups });
            }
        }
        if self.runs.is_empty() {
            return false;
        }
        for row in 0..TILE_ROWS {
            let (line, fraction) = slice.row(first_row + row);
            self.line[row] = ((line - first_line) as usize).min(MAX_LINES - 2);
            self.fraction[row] = fraction;
        }
        true
    }
}

/// Prefetches the tile's data of the next slice, a few cells at a time, so that loading and summing overlap.
struct Ahead<'a> {
    rows: &'a TileRows,
    run: usize,
    cell: usize,
    /// Columns of cells to prefetch, and number of groups summed meanwhile.
    cells: usize,
    groups: usize,
    due: usize,
}

impl<'a> Ahead<'a> {
    #[inline(always)]
    fn new(now: &TileRows, rows: &'a TileRows) -> Self {
        let cells = rows.runs.iter().map(|run| run.cells.1 - run.cells.0).sum();
        let groups = now.runs.iter().map(|run| run.groups.1 - run.groups.0).sum();
        Self { rows, run: 0, cell: rows.runs.first().map_or(0, |run| run.cells.0), cells, groups, due: 0 }
    }

    /// Call for each group summed.
    #[inline(always)]
    fn group<T: Voxel, L: Lanes>(&mut self, lanes: L, data: &[T::Cell]) {
        self.due += self.cells;
        while self.due >= self.groups {
            self.due -= self.groups;
            let Some(run) = self.rows.runs.get(self.run) else { return };
            for &offset in self.rows.offsets.get(..self.rows.lines).unwrap_or(&[]) {
                lanes.prefetch(data, offset + self.cell);
            }
            self.cell += 1;
            if self.cell >= run.cells.1 {
                self.run += 1;
                self.cell = self.rows.runs.get(self.run).map_or(0, |run| run.cells.0);
            }
        }
    }
}

/// 32-bit sums of a tile.
#[derive(Default)]
struct TileSums {
    groups: Vec<GroupSums>,
    /// Number of slices summed so far, and the groups that are not zero.
    summed: usize,
    touched: (usize, usize),
}

/// Per-thread workspace.
#[derive(Default)]
pub(crate) struct Work {
    sums: Vec<TileSums>,
    /// Eight rows of cells, with one zero cell at either end.
    blended: Vec<Cell16>,
    /// Of the current slice and of the next one.
    rows: [TileRows; 2],
}

impl Work {
    /// Takes the sizes of an image and a copy. The sums are zero between images.
    pub fn fit<T: Voxel>(&mut self, plan: &Plan, copy: &Copy3<T>) {
        self.sums.resize_with(TILES, TileSums::default);
        for tile in &mut self.sums {
            tile.groups.resize(plan.columns / GROUP, [[0; GROUP]; TILE_ROWS]);
        }
        self.blended.resize(TILE_ROWS * (copy.row_cells() + 2), Cell16::default());
        for rows in &mut self.rows {
            rows.occupied.resize(copy.words_per_row(), 0);
        }
    }
}

/// Sums all slices into the tiles of eight rows starting at image row `first_row`; `out` holds the tiles, row-major. Sums at most
/// `flush_after` slices in 32 bits.
///
/// Processes a few slices for all tiles before the next few, so that a voxel line that two tiles read is loaded from memory once.
#[inline(always)]
pub(crate) fn sum_tiles<T: Voxel, L: Lanes>(
    lanes: L,
    copy: &Copy3<T>,
    plan: &Plan,
    flush_after: usize,
    first_row: usize,
    work: &mut Work,
    out: &mut [i64],
) {
    out.fill(0);
    let length = (TILE_ROWS * plan.columns).max(1);
    let tiles = out.len() / length;
    let Work { sums, blended, rows: [now, next] } = work;
    let mut slices = plan
        .slices
        .chunks(BLOCK_SLICES)
        .flat_map(|block| (0..tiles).flat_map(move |tile| block.iter().map(move |slice| (tile, slice))));
    let mut find = |rows: &mut TileRows| {
        slices.find(|(tile, slice)| {
            let from = first_row + tile * TILE_ROWS;
            let meets = slice.rows.0.max(from) < slice.rows.1.min(from + TILE_ROWS);
            meets && slice.groups.0 < slice.groups.1 && rows.place(copy, plan, slice, from)
        })
    };
    let mut current = find(now);
    while let Some((tile, slice)) = current {
        next.runs.clear();
        current = find(next);
        if let Some(tile_sums) = sums.get_mut(tile) {
            sum_slice(lanes, copy, slice, (&*now, &*next), blended, tile_sums);
            if tile_sums.summed == flush_after {
                flush(tile_sums, plan.columns, out.get_mut(tile * length..).unwrap_or(&mut []));
            }
        }
        core::mem::swap(now, next);
    }
    for (sums, out) in sums.iter_mut().zip(out.chunks_mut(length)) {
        flush(sums, plan.columns, out);
    }
}

/// The first run of occupied cells at or after `from`, half-open.
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
    slice: &Slice,
    (rows, next): (&TileRows, &TileRows),
    blended: &mut [Cell16],
    sums: &mut TileSums,
) {
    let data = copy.data();
    let stride = copy.row_cells() + 2;
    let constants = lanes.per_slice(slice.lane_step());
    let mut ahead = Ahead::new(rows, next);
    for run in &rows.runs {
        let (first, end) = run.cells;
        for (row, out) in blended.chunks_exact_mut(stride).enumerate() {
            let line = |line: usize| {
                let start = rows.offsets[rows.line[row] + line] + first;
                data.get(start..start + (end - first)).unwrap_or(&[])
            };
            out[first] = Cell16::default();
            out[end + 1] = Cell16::default();
            lanes.blend::<T>(line(0), line(1), rows.fraction[row], &mut out[first + 1..=end]);
        }
        let lines = BlendedRows { voxels: voxels(blended), length: stride * CELL };
        let (low, high) = run.groups;
        let groups = sums.groups.get_mut(low..high).unwrap_or(&mut []);
        for (n, sums) in groups.iter_mut().enumerate() {
            let start = slice.group(low + n);
            // One zero cell precedes the row.
            let place = GroupPlace { first: (start.voxel + CELL as i64) as usize, fraction: start.fraction };
            if rows.summed.whole.0 <= low + n && low + n < rows.summed.whole.1 {
                lanes.add_group(constants, lines, place, sums);
            } else {
                let mut samples = [[0; GROUP]; TILE_ROWS];
                lanes.add_group(constants, lines, place, &mut samples);
                rows.summed.add(low + n, &samples, sums);
            }
            ahead.group::<T, L>(lanes, data);
        }
        sums.touched = (sums.touched.0.min(low), sums.touched.1.max(high));
    }
    sums.summed += 1;
}

/// Flushes the 32-bit sums into the 64-bit ones.
#[inline(always)]
fn flush(sums: &mut TileSums, columns: usize, out: &mut [i64]) {
    for group in sums.touched.0..sums.touched.1 {
        let Some(sums) = sums.groups.get_mut(group) else { continue };
        for (row, sums) in sums.iter_mut().enumerate() {
            let start = row * columns + group * GROUP;
            let Some(out) = out.get_mut(start..).and_then(|rest| rest.first_chunk_mut::<GROUP>()) else {
                continue;
            };
            // Reading both before writing lets the compiler vectorise.
            let (before, new) = (*out, *sums);
            *out = core::array::from_fn(|n| before[n] + i64::from(new[n]));
            *sums = [0; GROUP];
        }
    }
    sums.touched = (usize::MAX, 0);
    sums.summed = 0;
}
