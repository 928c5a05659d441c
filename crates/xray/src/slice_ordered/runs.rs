//! Selects the groups of a tile's samples that are interpolated in a slice; groups whose voxels all have one
//! value need no voxel reads.

use super::copies::{CELL, Copy3, LEVELS, MIXED, Voxel};
use super::kernel::{GroupSums, Lanes};
use super::plan::{GROUP, ImagePlan, MAX_LINES, Slice, TILE_ROWS};

/// Prefetch distance in the levels; those of later slices follow one another in memory.
const LEVELS_AHEAD: usize = 4 * LEVELS;

/// A run of groups interpolated at once, and the cells that they read; both half-open.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub cells: (usize, usize),
    pub groups: (usize, usize),
    /// From the first to the last of these cells whose voxels differ; the others need not be loaded.
    pub mixed: (usize, usize),
}

/// Contribution of groups of one value to a tile's samples: the sum of their values, as differences from
/// group to group. A weighted sum of equal voxels is exactly that voxel times the sum of the weights.
#[derive(Debug, Default)]
pub(super) struct LevelSums {
    steps: Vec<i64>,
}

impl LevelSums {
    /// Takes the size of an image.
    pub fn fit(&mut self, groups: usize) {
        self.steps.resize(groups + 1, 0);
    }

    #[inline(always)]
    fn add(&mut self, groups: (usize, usize), value: i16) {
        if let Some(step) = self.steps.get_mut(groups.0) {
            *step += i64::from(value);
        }
        if let Some(step) = self.steps.get_mut(groups.1) {
            *step -= i64::from(value);
        }
    }

    /// The sum of each group; zero afterwards.
    #[inline(always)]
    pub fn take(&mut self) -> impl Iterator<Item = i64> {
        let mut sum = 0;
        self.steps.iter_mut().map(move |step| {
            sum += core::mem::take(step);
            sum
        })
    }
}

/// Position of a tile's rows in a slice, and the runs to be interpolated along them.
#[derive(Debug, Default)]
pub(super) struct TileRows {
    /// For each image row, its first voxel line and the 15-bit fraction to the next.
    pub line: [usize; TILE_ROWS],
    pub fraction: [i16; TILE_ROWS],
    /// First cells of the lines in the copy.
    pub offsets: [usize; MAX_LINES],
    pub lines: usize,
    /// For each cell, the level of all its voxels in all the lines, or [`MIXED`].
    pub levels: Vec<u8>,
    pub runs: Vec<Run>,
    pub summed: TileColumns,
}

/// The samples of a tile that are summed in a slice; ranges are half-open.
#[derive(Debug, Default)]
pub(super) struct TileColumns {
    /// Columns of each row.
    pub columns: [(usize, usize); TILE_ROWS],
    /// Groups with any of these columns, and groups whose rows all have all columns.
    pub any: (usize, usize),
    pub whole: (usize, usize),
}

impl TileColumns {
    #[inline(always)]
    fn of(plan: &ImagePlan, slice: &Slice, first_row: usize) -> Self {
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

    /// Adds a group's samples that are within the summed columns.
    #[inline(always)]
    pub fn add(&self, group: usize, samples: &GroupSums, sums: &mut GroupSums) {
        for ((sums, samples), columns) in sums.iter_mut().zip(samples).zip(&self.columns) {
            for lane in 0..GROUP {
                let column = group * GROUP + lane;
                let kept = columns.0 <= column && column < columns.1;
                sums[lane] = sums[lane].wrapping_add(if kept { samples[lane] } else { 0 });
            }
        }
    }
}

impl TileRows {
    /// Finds the voxels that the tile reads in a slice, and adds groups that need none to `known`; false if
    /// nothing has to be read.
    #[inline(always)]
    pub fn place<T: Voxel, L: Lanes>(
        &mut self,
        lanes: L,
        copy: &Copy3<T>,
        plan: &ImagePlan,
        (slice, first_row): (&Slice, usize),
        known: &mut LevelSums,
    ) -> bool {
        self.runs.clear();
        self.levels.clear();
        self.summed = TileColumns::of(plan, slice, first_row);
        if self.summed.any.0 >= self.summed.any.1 {
            return false;
        }
        let (first_line, _) = slice.row(first_row);
        let (last_line, _) = slice.row(first_row + TILE_ROWS - 1);
        self.lines = ((last_line - first_line) as usize + 2).min(MAX_LINES);
        let mut levels: [&[u8]; MAX_LINES] = [&[]; MAX_LINES];
        let of_slice = copy.rows(plan.axes.slow, slice.index);
        let lines = self.offsets.iter_mut().zip(&mut levels).take(self.lines);
        for (line, (offset, levels)) in (first_line..).zip(lines) {
            (*offset, *levels) = copy.row(&of_slice, line);
            lanes.prefetch(levels, LEVELS_AHEAD);
        }
        self.find_runs(lanes, copy, slice, levels.get(..self.lines).unwrap_or(&[]), known);
        if self.runs.is_empty() {
            return false;
        }
        self.find_mixed();
        for row in 0..TILE_ROWS {
            let (line, fraction) = slice.row(first_row + row);
            self.line[row] = ((line - first_line) as usize).min(MAX_LINES - 2);
            self.fraction[row] = fraction;
        }
        true
    }

    /// Splits the groups into those of one value, which are added to `known`, and runs to be interpolated.
    /// `lines` holds the levels of each line.
    #[inline(always)]
    fn find_runs<T: Voxel, L: Lanes>(
        &mut self,
        lanes: L,
        copy: &Copy3<T>,
        slice: &Slice,
        lines: &[&[u8]],
        known: &mut LevelSums,
    ) {
        let (any, row_cells) = (self.summed.any, copy.row_cells());
        // Only levels of whole groups.
        let within = (self.summed.whole.0.max(any.0), self.summed.whole.1.min(any.1));
        let reach = slice.reach();
        // Air precedes the first cell.
        let (mut before, mut level, mut from, mut next) = ([0; LEVELS], 0, within.0, any.0);
        for at in (0..copy.levels_per_row()).step_by(LEVELS) {
            let (joined, mut changes) = lanes.join(lines, at, &before);
            before = joined;
            self.levels.extend_from_slice(&joined);
            while changes != 0 {
                let cell = changes.trailing_zeros() as usize;
                changes &= changes - 1;
                let voxel = ((at + cell) * CELL) as i64;
                if level != MIXED {
                    let to = slice.first_group_from(voxel - reach, within);
                    if from < to {
                        self.run(slice, (next, from), row_cells);
                        known.add((from, to), copy.value_of(level));
                        next = to;
                    }
                }
                level = joined.get(cell).copied().unwrap_or(MIXED);
                from = slice.first_group_from(voxel, within);
            }
        }
        // Air also follows the last cell.
        let to = match level {
            MIXED => from,
            0 => within.1,
            _ => slice.first_group_from((copy.levels_per_row() * CELL) as i64 - reach, within),
        };
        if from < to {
            self.run(slice, (next, from), row_cells);
            known.add((from, to), copy.value_of(level));
            next = to;
        }
        self.run(slice, (next, any.1), row_cells);
    }

    /// Finds the cells that each run has to load.
    #[inline(always)]
    fn find_mixed(&mut self) {
        for run in &mut self.runs {
            let levels = self.levels.get(run.cells.0..run.cells.1).unwrap_or(&[]);
            let first = levels.iter().position(|level| *level == MIXED).unwrap_or(0);
            let end = levels.iter().rposition(|level| *level == MIXED).map_or(first, |last| last + 1);
            run.mixed = (run.cells.0 + first, run.cells.0 + end);
        }
    }

    #[inline(always)]
    fn run(&mut self, slice: &Slice, groups: (usize, usize), row_cells: usize) {
        if groups.0 < groups.1 {
            let cells = slice.cells_read(groups, row_cells);
            self.runs.push(Run { cells, groups, mixed: cells });
        }
    }
}
