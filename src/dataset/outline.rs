//! Outlines of a mask along the edges of its pixels: filled by the even-odd rule at the pixels' centres they are the mask again, pixel by pixel.

use std::collections::{HashMap, HashSet};

/// A corner of pixels: column and row, from 0 at the image's upper left edge to its width and height.
pub type Corner = [i32; 2];

/// One closed outline for each part of a mask, row-major from the top, whose pixels hang together by their sides. A hole is cut out along a
/// line that is gone there and back, because some formats have no holes.
pub fn outlines(mask: &[bool], columns: usize) -> Vec<Vec<Corner>> {
    let pixels = Pixels { mask, columns: columns as i32, rows: (mask.len() / columns.max(1)) as i32 };
    let mut parts: Vec<Part> = Vec::new();
    let part_of = pixels.parts();
    let mut walked = HashSet::new();
    for row in 0..pixels.rows {
        for column in 0..pixels.columns {
            // Every loop has an edge that goes up or down beside a pixel of its part.
            for side in [Side::Left, Side::Right] {
                if pixels.is_edge([column, row], side) && !walked.contains(&([column, row], side)) {
                    let number = part_of[&[column, row]];
                    parts.resize_with(parts.len().max(number + 1), Part::default);
                    let outline = pixels.walk([column, row], side, &mut walked);
                    parts[number].take(outline);
                }
            }
        }
    }
    parts.into_iter().map(Part::joined).collect()
}

/// Sides of a pixel in the order in which they are gone about it, with the pixel on the right hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Side {
    Top,
    Right,
    Bottom,
    Left,
}

impl Side {
    const ALL: [Side; 4] = [Side::Top, Side::Right, Side::Bottom, Side::Left];

    /// The pixel beyond the side.
    fn beyond(self, [column, row]: Corner) -> Corner {
        match self {
            Side::Top => [column, row - 1],
            Side::Right => [column + 1, row],
            Side::Bottom => [column, row + 1],
            Side::Left => [column - 1, row],
        }
    }

    /// Where the side begins.
    fn begin(self, [column, row]: Corner) -> Corner {
        match self {
            Side::Top => [column, row],
            Side::Right => [column + 1, row],
            Side::Bottom => [column + 1, row + 1],
            Side::Left => [column, row + 1],
        }
    }

    fn turned(self, quarters: usize) -> Side {
        Side::ALL[(self as usize + quarters) % 4]
    }
}

struct Pixels<'m> {
    mask: &'m [bool],
    columns: i32,
    rows: i32,
}

impl Pixels<'_> {
    fn is_set(&self, [column, row]: Corner) -> bool {
        let inside = (0..self.columns).contains(&column) && (0..self.rows).contains(&row);
        inside && self.mask[(row * self.columns + column) as usize]
    }

    fn is_edge(&self, pixel: Corner, side: Side) -> bool {
        self.is_set(pixel) && !self.is_set(side.beyond(pixel))
    }

    /// The number of the part to which each pixel of the mask belongs, in the order of the parts' first pixels.
    fn parts(&self) -> HashMap<Corner, usize> {
        let (mut part_of, mut count, mut open) = (HashMap::new(), 0, Vec::new());
        for row in 0..self.rows {
            for column in 0..self.columns {
                if self.is_set([column, row]) && !part_of.contains_key(&[column, row]) {
                    open.push([column, row]);
                    part_of.insert([column, row], count);
                    while let Some(pixel) = open.pop() {
                        for next in Side::ALL.map(|side| side.beyond(pixel)) {
                            if self.is_set(next) && !part_of.contains_key(&next) {
                                part_of.insert(next, count);
                                open.push(next);
                            }
                        }
                    }
                    count += 1;
                }
            }
        }
        part_of
    }

    /// The corners of the loop that a side belongs to, one for each side of a pixel.
    fn walk(&self, first: Corner, first_side: Side, walked: &mut HashSet<(Corner, Side)>) -> Vec<Corner> {
        let (mut pixel, mut side, mut corners) = (first, first_side, Vec::new());
        loop {
            walked.insert((pixel, side));
            corners.push(side.begin(pixel));
            // At the side's end: about the same pixel, along the next one, or about the one across.
            let along = side.turned(1).beyond(pixel);
            let across = side.beyond(along);
            (pixel, side) = match (self.is_set(along), self.is_set(across)) {
                (false, _) => (pixel, side.turned(1)),
                (true, false) => (along, side),
                (true, true) => (across, side.turned(3)),
            };
            if (pixel, side) == (first, first_side) {
                return corners;
            }
        }
    }
}

/// The loops of a part.
#[derive(Default)]
struct Part {
    outer: Vec<Corner>,
    holes: Vec<Vec<Corner>>,
}

impl Part {
    fn take(&mut self, corners: Vec<Corner>) {
        let next = corners.iter().cycle().skip(1);
        let twice_area: i64 =
            corners.iter().zip(next).map(|(a, b)| i64::from(a[0] * b[1]) - i64::from(b[0] * a[1])).sum();
        if twice_area > 0 {
            self.outer = corners;
        } else {
            self.holes.push(corners);
        }
    }

    /// One outline of all loops, without corners that lie on a straight line.
    fn joined(self) -> Vec<Corner> {
        let Part { mut outer, mut holes } = self;
        // From a hole's leftmost corner to the left lies the outer loop, or a hole that is farther left.
        let leftmost = |hole: &[Corner]| (0..hole.len()).min_by_key(|place| hole[*place]).unwrap_or(0);
        holes.sort_by_key(|hole| hole[leftmost(hole)]);
        let mut corners: HashSet<Corner> = outer.iter().copied().collect();
        for mut hole in holes {
            let first = leftmost(&hole);
            hole.rotate_left(first);
            let [column, row] = hole[0];
            let met = (0..=column).rev().map(|column| [column, row]).find(|corner| corners.contains(corner));
            let Some(place) = met.and_then(|met| outer.iter().position(|corner| *corner == met)) else {
                continue;
            };
            corners.extend(&hole);
            let back = [hole[0], outer[place]];
            outer.splice(place + 1..place + 1, hole.into_iter().chain(back));
        }
        outer.dedup();
        straightened(&outer)
    }
}

/// The corners at which an outline changes its direction.
fn straightened(outline: &[Corner]) -> Vec<Corner> {
    let count = outline.len();
    let way = |from: Corner, to: Corner| [(to[0] - from[0]).signum(), (to[1] - from[1]).signum()];
    let turns = |place: &usize| {
        let [before, here, after] =
            [place + count - 1, *place, place + 1].map(|place| outline[place % count]);
        way(before, here) != way(here, after)
    };
    (0..count).filter(turns).map(|place| outline[place]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fills outlines by the even-odd rule: a pixel's centre is inside if an odd number of upright edges lie to its left.
    fn filled(outlines: &[Vec<Corner>], columns: usize, rows: usize) -> Vec<bool> {
        let mut mask = vec![false; columns * rows];
        for outline in outlines {
            for (from, to) in outline.iter().zip(outline.iter().cycle().skip(1)) {
                assert!(from[0] == to[0] || from[1] == to[1], "an edge is upright or level");
                for row in from[1].min(to[1])..from[1].max(to[1]) {
                    for column in from[0]..columns as i32 {
                        mask[row as usize * columns + column as usize] ^= true;
                    }
                }
            }
        }
        mask
    }

    #[test]
    fn filled_outlines_are_the_mask() {
        let mut random = fastrand::Rng::with_seed(5);
        for trial in 0..3000 {
            let (columns, rows) = (random.usize(1..14), random.usize(1..14));
            let share = [0.1, 0.5, 0.7, 0.9, 1.0][trial % 5];
            let mask: Vec<bool> = (0..columns * rows).map(|_| random.f64() < share).collect();
            let found = outlines(&mask, columns);
            assert_eq!(filled(&found, columns, rows), mask, "{columns} x {rows}: {mask:?}");
            assert!(found.iter().all(|outline| outline.len() >= 4));
        }
    }

    #[test]
    fn parts_that_touch_at_a_corner_are_two_and_a_hole_in_a_hole_is_another() {
        assert_eq!(outlines(&[true, false, false, true], 2).len(), 2);
        let rings: Vec<bool> = (0..49)
            .map(|i| [i % 7, i / 7].map(|x: i32| (x - 3).abs()).into_iter().max() != Some(2))
            .collect();
        let found = outlines(&rings, 7);
        assert_eq!(found.len(), 2, "the outer ring and the square in its hole");
        assert_eq!(outlines(&[true; 6], 3), [[[0, 0], [3, 0], [3, 2], [0, 2]]].map(Vec::from));
        assert!(outlines(&[false; 6], 3).is_empty());
    }
}
