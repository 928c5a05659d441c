//! The samples of an intermediate image that the detector sees. Seen obliquely, the detector is a
//! quadrilateral in a rectangular image; samples outside it need not be summed.

use super::plan::{GROUP, MARGIN, TILE_ROWS};

/// For each tile of eight rows, the groups of samples within a margin around the detector's footprint,
/// half-open. The corners are given in samples: those of the first row, then those of the last.
pub(crate) fn visible_groups(corners: [[f64; 2]; 4], [columns, rows]: [usize; 2]) -> Vec<(usize, usize)> {
    let [a, b, c, d] = corners;
    let edges = [(a, b), (b, d), (d, c), (c, a)];
    (0..rows / TILE_ROWS)
        .map(|tile| {
            let top = (tile * TILE_ROWS) as f64 - MARGIN;
            let strip = (top, top + TILE_ROWS as f64 + 2.0 * MARGIN);
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            for (from, to) in edges {
                if let Some((least, most)) = crossing(from, to, strip) {
                    (low, high) = (low.min(least), high.max(most));
                }
            }
            let group =
                |x: f64| libm::floor(x / GROUP as f64).max(0.0).min((columns / GROUP) as f64) as usize;
            let (first, end) = (group(low - MARGIN), group(high + MARGIN + GROUP as f64));
            (first.min(end), end)
        })
        .collect()
}

/// Least and largest x of the part of an edge within a strip of y; `None` if there is none.
fn crossing(from: [f64; 2], to: [f64; 2], strip: (f64, f64)) -> Option<(f64, f64)> {
    let (low, high) = (from[1].min(to[1]).max(strip.0), from[1].max(to[1]).min(strip.1));
    if low > high {
        return None;
    }
    let height = to[1] - from[1];
    if height == 0.0 {
        return Some((from[0].min(to[0]), from[0].max(to[0])));
    }
    let at = |y: f64| from[0] + (to[0] - from[0]) * ((y - from[1]) / height);
    let (x, y) = (at(low), at(high));
    Some((x.min(y), x.max(y)))
}
