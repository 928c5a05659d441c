//! What a changed voxel changes in the intermediate image: exactly the products that the sum over slices adds for it.

use super::plan::{Plan, Slice, WEIGHT_BITS, weights};
use super::warp::Rect;

impl Rect {
    /// No pixels.
    pub(crate) const EMPTY: Self = Self { columns: (usize::MAX, 0), rows: (usize::MAX, 0) };

    pub(crate) fn is_empty(&self) -> bool {
        self.columns.0 >= self.columns.1 || self.rows.0 >= self.rows.1
    }

    fn include(&mut self, column: usize, row: usize) {
        self.columns = (self.columns.0.min(column), self.columns.1.max(column + 1));
        self.rows = (self.rows.0.min(row), self.rows.1.max(row + 1));
    }

    /// With as many pixels more on every side as fit into the image.
    pub(crate) fn grown(&self, by: usize, columns: usize, rows: usize) -> Self {
        Self {
            columns: (self.columns.0.saturating_sub(by), (self.columns.1 + by).min(columns)),
            rows: (self.rows.0.saturating_sub(by), (self.rows.1 + by).min(rows)),
        }
    }
}

/// Adds `delta` times the weights of a voxel to the image, and what changed to `dirty`.
pub(crate) fn splat(plan: &Plan, sums: &mut [i64], voxel: [usize; 3], delta: i32, dirty: &mut Rect) {
    let k = voxel[plan.axes.slow];
    let Some(first) = plan.slices.first() else { return };
    let Some(slice) = k.checked_sub(first.index).and_then(|n| plan.slices.get(n)) else { return };
    let (x, y) = (voxel[plan.axes.u] as i64, voxel[plan.axes.v] as i64);
    let columns = near(slice, 0, x, plan.columns);
    let rows = near(slice, 1, y, plan.rows);
    for row in rows.0..rows.1 {
        let (v, fy) = slice.row(row);
        if v != y && v != y - 1 {
            continue;
        }
        let line = row * plan.columns;
        for column in columns.0..columns.1 {
            let (u, fx) = slice.column(column);
            if u != x && u != x - 1 {
                continue;
            }
            let weight = weights(fx, fy)[(x - u) as usize + 2 * (y - v) as usize];
            if weight == 0 {
                continue;
            }
            if let Some(sum) = sums.get_mut(line + column) {
                *sum += i64::from(weight) * i64::from(delta);
                dirty.include(column, row);
            }
        }
    }
}

/// Samples along one direction of the image that may lie within a voxel of `position`, half open.
fn near(slice: &Slice, m: usize, position: i64, count: usize) -> (usize, usize) {
    // In f64 with one sample more on both sides: whoever is in the range is looked at exactly.
    let step = slice.step as f64;
    let at = |p: i64| ((p << 32) - slice.start[m]) as f64 / step;
    let clamp = |x: f64| x.clamp(0.0, count as f64) as usize;
    (clamp(libm::floor(at(position - 1)) - 1.0), clamp(libm::ceil(at(position + 1)) + 2.0))
}

/// Largest number of slices whose samples of values up to `largest` cannot overflow 32 bits.
pub(crate) fn slices_until_flush(largest: i16) -> usize {
    let most = i64::from(largest.max(1)) << WEIGHT_BITS;
    (i64::from(i32::MAX) / most) as usize
}
