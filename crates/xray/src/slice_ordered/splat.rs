//! The effect of a changed voxel on the intermediate image: exactly the products that the sum over slices
//! adds for it.

use super::copies::{Copy3, Voxel};
use super::kernel::between;
use super::plan::{ImagePlan, Slice, WEIGHT_BITS};
use super::warp::Rect;

impl Rect {
    fn area(&self) -> usize {
        (self.columns.1 - self.columns.0) * (self.rows.1 - self.rows.0)
    }

    fn joined(&self, other: &Self) -> Self {
        let hull = |a: (usize, usize), b: (usize, usize)| (a.0.min(b.0), a.1.max(b.1));
        Self { columns: hull(self.columns, other.columns), rows: hull(self.rows, other.rows) }
    }

    /// Grown by `by` pixels on every side, within the image.
    pub(crate) fn grown(&self, by: usize, columns: usize, rows: usize) -> Self {
        Self {
            columns: (self.columns.0.saturating_sub(by), (self.columns.1 + by).min(columns)),
            rows: (self.rows.0.saturating_sub(by), (self.rows.1 + by).min(rows)),
        }
    }
}

/// Rectangles that cover all changed pixels.
#[derive(Debug, Default)]
pub(crate) struct Dirty {
    rects: Vec<Rect>,
}

impl Dirty {
    /// Maximum number of rectangles: each adds a margin of pixels around it.
    const MOST: usize = 8;
    /// Number of pixels by which a rectangle can grow to absorb another one.
    const SLACK: usize = 1024;

    /// The rectangles.
    pub fn rects(&self) -> &[Rect] {
        &self.rects
    }

    /// Adds changed pixels.
    #[inline(always)]
    fn include(&mut self, new: Rect) {
        let growth = |rect: &Rect| rect.joined(&new).area() - rect.area();
        // Voxels arrive in removal order, so they mostly fall into the last rectangle.
        if let Some(last) = self.rects.last_mut()
            && growth(last) <= Self::SLACK
        {
            *last = last.joined(&new);
            return;
        }
        let least = (0..self.rects.len()).min_by_key(|&n| growth(&self.rects[n]));
        match least.filter(|&n| self.rects.len() == Self::MOST || growth(&self.rects[n]) <= Self::SLACK) {
            None => self.rects.push(new),
            Some(n) => {
                let joined = self.rects.swap_remove(n).joined(&new);
                self.rects.push(joined);
            }
        }
    }
}

/// Workspace: the columns that sample a voxel, and their weights.
#[derive(Default)]
pub(crate) struct Splatter {
    columns: Vec<(usize, i64)>,
}

impl Splatter {
    /// Updates the image for a voxel that changes to `value`, and adds the changed pixels to `dirty`. Call
    /// before the change is applied to the copy that the image was summed from.
    #[inline(always)]
    pub fn splat<T: Voxel>(
        &mut self,
        copy: &Copy3<T>,
        plan: &ImagePlan,
        sums: &mut [i64],
        voxel: [usize; 3],
        value: i16,
        dirty: &mut Dirty,
    ) {
        let k = voxel[plan.axes.slow];
        let Some(first) = plan.slices.first() else { return };
        let Some(slice) = k.checked_sub(first.index).and_then(|n| plan.slices.get(n)) else { return };
        let (x, y) = (voxel[plan.axes.u] as i64, voxel[plan.axes.v] as i64);
        let columns = near(slice, 0, x, plan.columns);
        self.columns.clear();
        for column in columns.0..columns.1 {
            let (u, fraction) = slice.column(column);
            let fraction = i64::from(fraction);
            if u == x {
                self.columns.push((column, (1 << WEIGHT_BITS) - fraction));
            } else if u == x - 1 && fraction > 0 {
                self.columns.push((column, fraction));
            }
        }
        let (Some(&(left, _)), Some(&(right, _))) = (self.columns.first(), self.columns.last()) else {
            return;
        };
        let (before, after) = (copy.wide(voxel), T::store(value).value() * T::UNIT);
        let beside = |step: isize| {
            let mut beside = voxel;
            beside[plan.axes.v] = beside[plan.axes.v].wrapping_add_signed(step);
            copy.wide_or_zero(beside)
        };
        let (above, below) = (beside(-1), beside(1));
        let rows = near(slice, 1, y, plan.rows);
        let mut changed = (usize::MAX, 0);
        for row in rows.0..rows.1 {
            let (v, fraction) = slice.row(row);
            let change = if v == y {
                i64::from(between(after, below, fraction)) - i64::from(between(before, below, fraction))
            } else if v == y - 1 {
                i64::from(between(above, after, fraction)) - i64::from(between(above, before, fraction))
            } else {
                0
            };
            let summed = plan.summed_columns(slice, row);
            if change == 0 || summed.1 <= left || right < summed.0 {
                continue;
            }
            let line = sums.get_mut(row * plan.columns..(row + 1) * plan.columns).unwrap_or(&mut []);
            let summed = |&&(column, _): &&(usize, i64)| summed.0 <= column && column < summed.1;
            for &(column, weight) in self.columns.iter().filter(summed) {
                if let Some(sum) = line.get_mut(column) {
                    *sum += weight * change;
                }
            }
            changed = (changed.0.min(row), row + 1);
        }
        if changed.0 < changed.1 {
            dirty.include(Rect { columns: (left, right + 1), rows: changed });
        }
    }
}

/// Samples along one image direction that can read a voxel at `position`, half-open.
#[inline(always)]
fn near(slice: &Slice, m: usize, position: i64, count: usize) -> (usize, usize) {
    // Computed in f64 with one extra sample on both sides: the caller checks each sample exactly.
    let at = |p: i64| ((p << 32) - slice.start[m]) as f64 * slice.samples_per_position;
    let clamp = |x: f64| x.clamp(0.0, count as f64) as usize;
    (clamp(at(position - 1) - 1.0), clamp(at(position + 1) + 2.0))
}

/// Maximum number of slices whose samples, with values up to `largest`, cannot overflow 32 bits.
pub(crate) fn slices_until_flush(largest: i16) -> usize {
    let most = i64::from(largest.max(1)) << WEIGHT_BITS;
    (i64::from(u32::MAX) / most) as usize
}
