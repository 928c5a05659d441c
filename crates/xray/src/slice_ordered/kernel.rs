//! The sum over slices, eight rows of the intermediate image at a time.
//!
//! In each slice, the voxel rows are first blended into the slice's eight image rows as 16-bit integers, 32
//! voxels at a time. Groups of 16 samples are then interpolated along these rows and added to 32-bit sums,
//! which are flushed into 64-bit ones before they can overflow. Groups whose samples are known without voxels
//! are skipped ([`TileRows`]). Between the groups of one slice, the data for a later slice are prefetched
//! ([`Ahead`]). Only [`Lanes`] differs between instruction sets; all of them compute the same integers.

use super::copies::{CELL, Cell16, Copy3, LEVELS, MIXED, Voxel, voxels};
use super::plan::{
    FRACTION_MASK, GROUP, GROUP_REACH, ImagePlan, LANE_BITS, ROW_BITS, Slice, TILE_ROWS, WEIGHT_BITS,
};
use super::runs::{LevelSums, TileRows};

/// 32-bit sums of one group: eight rows of 16 samples. They are never negative, so all 32 bits count.
pub(crate) type GroupSums = [[i32; GROUP]; TILE_ROWS];

/// Number of tiles summed together, and number of slices summed into one tile before the next.
pub(crate) const TILES: usize = 4;
const BLOCK_SLICES: usize = 32;
/// Slices that are prefetched before they are summed. With fewer, memory latency is not hidden.
const SLICES_AHEAD: usize = 3;
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
    /// Voxels per row, at least 1. The same for all rows, so that the compiler emits only one bounds check
    /// per group.
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
    /// For each of [`LEVELS`] cells from `at` on, the level that all rows share, or [`MIXED`]; and one bit
    /// for each that differs from the preceding one. `before` holds the cells before these.
    fn join(self, rows: &[&[u8]], at: usize, before: &[u8; LEVELS]) -> ([u8; LEVELS], u32);
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
                let sample = i32::from(window[x]) * w[0] + i32::from(window[x + 1]) * w[1];
                sums[lane] = sums[lane].wrapping_add(sample);
            }
        }
    }

    #[inline(always)]
    fn join(self, rows: &[&[u8]], at: usize, before: &[u8; LEVELS]) -> ([u8; LEVELS], u32) {
        let of = |row: &&[u8], cell: usize| row.get(at + cell).copied().unwrap_or(MIXED);
        let shared = |cell: usize| {
            let first = rows.first().map_or(MIXED, |row| of(row, cell));
            if rows.iter().all(|row| of(row, cell) == first) { first } else { MIXED }
        };
        let joined: [u8; LEVELS] = core::array::from_fn(shared);
        let previous = before.last().into_iter().chain(&joined);
        let changed = joined.iter().zip(previous).enumerate();
        (joined, changed.fold(0, |bits, (n, (a, b))| bits | (u32::from(a != b) << n)))
    }

    #[inline(always)]
    fn prefetch<T>(self, _data: &[T], _offset: usize) {}
}

/// Prefetches the tile's data of a later slice, a few cells at a time, so that loading and summing overlap.
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
        let cells = rows.runs.iter().map(|run| run.mixed.1 - run.mixed.0).sum();
        let groups = now.runs.iter().map(|run| run.groups.1 - run.groups.0).sum();
        Self { rows, run: 0, cell: rows.runs.first().map_or(0, |run| run.mixed.0), cells, groups, due: 0 }
    }

    /// Call for each group summed.
    #[inline(always)]
    fn group<T: Voxel, L: Lanes>(&mut self, lanes: L, data: &[T::Cell]) {
        self.due += self.cells;
        while self.due >= self.groups {
            self.due -= self.groups;
            while self.rows.runs.get(self.run).is_some_and(|run| self.cell >= run.mixed.1) {
                self.run += 1;
                self.cell = self.rows.runs.get(self.run).map_or(0, |run| run.mixed.0);
            }
            for &offset in self.rows.offsets.get(..self.rows.lines).unwrap_or(&[]) {
                lanes.prefetch(data, offset + self.cell);
            }
            self.cell += 1;
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
    known: Vec<LevelSums>,
    /// Eight rows of cells, with one zero cell at either end.
    blended: Vec<Cell16>,
    /// Rows of the current slice and of the next ones.
    rows: [TileRows; 1 + SLICES_AHEAD],
}

impl Work {
    /// Takes the sizes of an image and a copy. The sums are zero between images.
    pub fn fit<T: Voxel>(&mut self, plan: &ImagePlan, copy: &Copy3<T>) {
        self.sums.resize_with(TILES, TileSums::default);
        for tile in &mut self.sums {
            tile.groups.resize(plan.columns / GROUP, [[0; GROUP]; TILE_ROWS]);
            tile.touched = (usize::MAX, 0);
        }
        self.known.resize_with(TILES, LevelSums::default);
        self.known.iter_mut().for_each(|known| known.fit(plan.columns / GROUP));
        // The cells at either end of a row stay zero.
        self.blended.clear();
        self.blended.resize(TILE_ROWS * (copy.row_cells() + 2), Cell16::default());
    }
}

/// The order of the sum: a few slices for all tiles before the next few, so that a voxel line that two tiles
/// read is loaded from memory once.
struct Order<'a> {
    slices: &'a [Slice],
    tiles: usize,
    block: usize,
    tile: usize,
    slice: usize,
}

impl<'a> Order<'a> {
    #[inline(always)]
    fn next(&mut self) -> Option<(usize, &'a Slice)> {
        loop {
            let end = (self.block + BLOCK_SLICES).min(self.slices.len());
            if self.slice < end {
                self.slice += 1;
                return Some((self.tile, self.slices.get(self.slice - 1)?));
            }
            self.tile += 1;
            if self.tile >= self.tiles {
                (self.tile, self.block) = (0, end);
                if end >= self.slices.len() {
                    return None;
                }
            }
            self.slice = self.block;
        }
    }
}

/// Sums all slices into the tiles of eight rows starting at image row `first_row`; `out` holds the tiles,
/// row-major. Sums at most `flush_after` slices in 32 bits.
#[inline(always)]
pub(crate) fn sum_tiles<T: Voxel, L: Lanes>(
    lanes: L,
    copy: &Copy3<T>,
    plan: &ImagePlan,
    flush_after: usize,
    first_row: usize,
    work: &mut Work,
    out: &mut [i64],
) {
    out.fill(0);
    let length = (TILE_ROWS * plan.columns).max(1);
    let Work { sums, known, blended, rows } = work;
    let mut order = Order { slices: &plan.slices, tiles: out.len() / length, block: 0, tile: 0, slice: 0 };
    let mut queue: [Option<(usize, &Slice)>; 1 + SLICES_AHEAD] = [None; 1 + SLICES_AHEAD];
    for now in (0..=SLICES_AHEAD).cycle().skip(1) {
        let last = (now + SLICES_AHEAD) % (1 + SLICES_AHEAD);
        rows[last].runs.clear();
        queue[last] = None;
        while let Some((tile, slice)) = order.next() {
            let from = first_row + tile * TILE_ROWS;
            let meets = slice.rows.0.max(from) < slice.rows.1.min(from + TILE_ROWS);
            let Some(known) = known.get_mut(tile).filter(|_| meets && slice.groups.0 < slice.groups.1) else {
                continue;
            };
            if rows[last].place(lanes, copy, plan, (slice, from), known) {
                queue[last] = Some((tile, slice));
                break;
            }
        }
        if let Some((tile, slice)) = queue[now]
            && let Some(tile_sums) = sums.get_mut(tile)
        {
            sum_slice(lanes, copy, slice, (&rows[now], &rows[last]), blended, tile_sums);
            if tile_sums.summed == flush_after {
                flush(tile_sums, plan.columns, out.get_mut(tile * length..).unwrap_or(&mut []));
            }
        }
        if queue.iter().all(Option::is_none) {
            break;
        }
        queue[now] = None;
    }
    for ((sums, known), out) in sums.iter_mut().zip(known).zip(out.chunks_mut(length)) {
        flush(sums, plan.columns, out);
        add_known(known, plan.columns, out);
    }
}

/// Adds the sums of the groups of one value.
#[inline(always)]
fn add_known(known: &mut LevelSums, columns: usize, out: &mut [i64]) {
    for (group, value) in known.take().enumerate().filter(|(_, value)| *value != 0) {
        for row in out.chunks_exact_mut(columns) {
            let samples = row.get_mut(group * GROUP..).and_then(|rest| rest.first_chunk_mut::<GROUP>());
            for sample in samples.into_iter().flatten() {
                *sample += value << WEIGHT_BITS;
            }
        }
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
        let (first, end) = run.mixed;
        for (row, out) in blended.chunks_exact_mut(stride).enumerate() {
            let line = |line: usize| {
                let start = rows.offsets[rows.line[row] + line] + first;
                data.get(start..start + (end - first)).unwrap_or(&[])
            };
            lanes.blend::<T>(line(0), line(1), rows.fraction[row], &mut out[first + 1..=end]);
        }
        for cell in (run.cells.0..first).chain(end..run.cells.1) {
            let level = rows.levels.get(cell).copied().unwrap_or(0);
            let level = Cell16([copy.value_of(level); CELL]);
            blended.iter_mut().skip(cell + 1).step_by(stride).for_each(|cell| *cell = level);
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
            *out = core::array::from_fn(|n| before[n] + i64::from(new[n] as u32));
            *sums = [0; GROUP];
        }
    }
    sums.touched = (usize::MAX, 0);
    sums.summed = 0;
}
