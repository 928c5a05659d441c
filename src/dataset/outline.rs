//! Extracts the polygons of a mask by border following: S. Suzuki and K. Abe, "Topological structural
//! analysis of digitized binary images by border following", Comput. Vis. Graph. Image Process. 30 (1985) 32,
//! algorithm 1.
//!
//! Vertices are pixel centres of the mask; pixels are 8-connected. A hole is connected to the polygon around
//! it by a bridge that is traversed in both directions. Filling the polygons with the even-odd rule, edges
//! included, reproduces the mask.

use std::collections::HashMap;

/// Column and row of a pixel.
pub(super) type Corner = (i32, i32);

/// Neighbours of a pixel, clockwise from the right.
const AROUND: [Corner; 8] = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)];

/// Returns one closed polygon per connected component of true pixels, ordered by first pixel from the top.
/// The first vertex is not repeated.
pub(super) fn polygons(mask: impl Iterator<Item = bool>, columns: usize) -> Vec<Vec<Corner>> {
    let mut borders = Borders::new(mask, columns);
    borders.find();
    let Borders { borders, at, .. } = &borders;
    let mut holes: Vec<Vec<(usize, usize)>> = vec![Vec::new(); borders.len()];
    for (number, border) in borders.iter().enumerate() {
        if let Some(bridge) = border.bridge
            && let Some(&(of, place)) = at.get(&bridge)
        {
            holes[of].push((place, number));
        }
    }
    for holes in &mut holes {
        holes.sort_unstable();
    }
    let outer = (0..borders.len()).filter(|&number| borders[number].bridge.is_none());
    outer.map(|number| simplified(joined(borders, &holes, number))).collect()
}

/// A border; for that of a hole, also the pixel of an earlier border to the left of its first.
struct Border {
    corners: Vec<Corner>,
    bridge: Option<Corner>,
}

struct Borders {
    /// The mask padded with zeros: 0 outside, 1 not yet on a border, 2 on a border, -2 on a border with the
    /// right neighbour outside.
    labels: Vec<i8>,
    width: i32,
    height: i32,
    borders: Vec<Border>,
    /// The first border through a pixel, and the index within it.
    at: HashMap<Corner, (usize, usize)>,
}

impl Borders {
    fn new(mask: impl Iterator<Item = bool>, columns: usize) -> Borders {
        let width = columns + 2;
        let mut labels = vec![0; width];
        for (i, set) in mask.enumerate() {
            if i % columns == 0 {
                labels.push(0);
            }
            labels.push(i8::from(set));
            if i % columns == columns - 1 {
                labels.push(0);
            }
        }
        labels.extend(vec![0; width]);
        let height = labels.len() / width;
        Borders {
            labels,
            width: width as i32,
            height: height as i32,
            borders: Vec::new(),
            at: HashMap::new(),
        }
    }

    fn label(&mut self, (x, y): Corner) -> &mut i8 {
        &mut self.labels[(y * self.width + x) as usize]
    }

    fn find(&mut self) {
        for y in 1..self.height - 1 {
            for x in 1..self.width - 1 {
                let here = *self.label((x, y));
                if here == 1 && *self.label((x - 1, y)) == 0 {
                    self.follow((x, y), 4, None);
                } else if here > 0 && *self.label((x + 1, y)) == 0 {
                    let mut left = x;
                    while *self.label((left - 1, y)) != 0 {
                        left -= 1;
                    }
                    self.follow((x, y), 0, Some((left - 1, y - 1)));
                }
            }
        }
    }

    /// Follows the border from a pixel whose neighbour in direction `outside` is not in the mask.
    fn follow(&mut self, start: Corner, outside: usize, bridge: Option<Corner>) {
        let mut corners = Vec::new();
        // Search clockwise for the last pixel, then follow counterclockwise from there.
        let last = (1..=8).map(|turn| (outside + turn) % 8).find(|&to| *self.label(step(start, to)) != 0);
        let (mut here, mut from) = (start, last.unwrap_or(outside));
        let end = last.map(|last| step(start, last));
        // Each pixel is visited from at most four directions.
        for _ in 0..4 * self.labels.len() {
            corners.push((here.0 - 1, here.1 - 1));
            let (mut to, mut right_is_outside) = (from, false);
            for turn in 1..=8 {
                to = (from + 8 - turn) % 8;
                if *self.label(step(here, to)) != 0 {
                    break;
                }
                right_is_outside |= to == 0;
            }
            let label = self.label(here);
            match (right_is_outside, *label) {
                (true, _) => *label = -2,
                (false, 1) => *label = 2,
                _ => {}
            }
            let next = step(here, to);
            if end.is_none() || (next == start && Some(here) == end) {
                break;
            }
            (here, from) = (next, (to + 4) % 8);
        }
        let number = self.borders.len();
        for (place, &corner) in corners.iter().enumerate() {
            self.at.entry(corner).or_insert((number, place));
        }
        self.borders.push(Border { corners, bridge });
    }
}

fn step((x, y): Corner, direction: usize) -> Corner {
    let (dx, dy) = AROUND[direction];
    (x + dx, y + dy)
}

/// Joins a border with the holes bridged to it, recursively.
fn joined(borders: &[Border], holes: &[Vec<(usize, usize)>], outer: usize) -> Vec<Corner> {
    let mut all = Vec::new();
    // Stack of borders: index, next vertex, next hole.
    let mut open = vec![(outer, 0, 0)];
    while let Some((number, place, hole)) = open.pop() {
        let corners = &borders[number].corners;
        match holes[number].get(hole) {
            Some(&(at, inner)) if at < place => {
                open.push((number, place, hole + 1));
                open.push((inner, 0, 0));
            }
            _ if place < corners.len() => {
                all.push(corners[place]);
                open.push((number, place + 1, hole));
            }
            _ => {
                // Back to the first vertex of the hole, then over the bridge.
                all.extend(borders[number].bridge.map(|_| corners[0]));
                all.extend(borders[number].bridge);
            }
        }
    }
    all
}

/// Removes vertices in the middle of straight edges.
fn simplified(corners: Vec<Corner>) -> Vec<Corner> {
    let count = corners.len();
    if count < 3 {
        return corners;
    }
    let turns = |i: &usize| {
        let [(x0, y0), (x1, y1), (x2, y2)] =
            [corners[(i + count - 1) % count], corners[*i], corners[(i + 1) % count]];
        ((x1 - x0).signum(), (y1 - y0).signum()) != ((x2 - x1).signum(), (y2 - y1).signum())
            || (x1 - x0) * (y2 - y1) != (y1 - y0) * (x2 - x1)
    };
    (0..count).filter(turns).map(|i| corners[i]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fills polygons by the even-odd rule, counting crossings to the left of each pixel, edges included.
    fn filled(polygons: &[Vec<Corner>], columns: usize, rows: usize) -> Vec<bool> {
        let mut mask = vec![false; columns * rows];
        for polygon in polygons {
            let edges = || (0..polygon.len()).map(|i| (polygon[i], polygon[(i + 1) % polygon.len()]));
            for (i, set) in mask.iter_mut().enumerate() {
                let (x, y) = ((i % columns) as i32, (i / columns) as i32);
                let on = |((x0, y0), (x1, y1)): (Corner, Corner)| {
                    (x - x0) * (y1 - y0) == (y - y0) * (x1 - x0)
                        && (x0.min(x1)..=x0.max(x1)).contains(&x)
                        && (y0.min(y1)..=y0.max(y1)).contains(&y)
                };
                let crossed = |&((x0, y0), (x1, y1)): &(Corner, Corner)| {
                    (y0 <= y) != (y1 <= y)
                        && f64::from(x0) + f64::from(y - y0) / f64::from(y1 - y0) * f64::from(x1 - x0)
                            < f64::from(x)
                };
                *set |= edges().any(on) || edges().filter(crossed).count() % 2 == 1;
            }
        }
        mask
    }

    fn picture(rows: &[&str]) -> (Vec<bool>, usize) {
        (rows.iter().flat_map(|row| row.bytes().map(|b| b == b'#')).collect(), rows[0].len())
    }

    #[test]
    fn a_square_has_four_corners_and_a_pixel_one() {
        let (mask, columns) = picture(&["......", ".###..", ".###..", ".###.#"]);
        let found = polygons(mask.into_iter(), columns);
        assert_eq!(found.len(), 2);
        let mut corners = found[0].clone();
        corners.sort_unstable();
        assert_eq!(corners, [(1, 1), (1, 3), (3, 1), (3, 3)]);
        assert_eq!(found[1], [(5, 3)]);
    }

    #[test]
    fn a_ring_is_one_polygon_with_its_hole_and_an_island_another() {
        let (mask, columns) =
            picture(&["#######", "#.....#", "#.###.#", "#.#.#.#", "#.###.#", "#.....#", "#######"]);
        let found = polygons(mask.iter().copied(), columns);
        assert_eq!(found.len(), 2);
        assert_eq!(filled(&found, columns, 7), mask);
    }

    /// Filling the polygons of random masks, sparse and dense, reproduces them.
    #[test]
    fn polygons_of_any_mask_fill_it() {
        let mut state = 1_u64;
        for round in 0..600 {
            let (columns, rows) = (1 + round % 13, 1 + round % 11);
            let mask: Vec<bool> = (0..columns * rows)
                .map(|_| {
                    state =
                        state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 60) < [4, 8, 12, 15][round % 4]
                })
                .collect();
            let found = polygons(mask.iter().copied(), columns);
            assert_eq!(filled(&found, columns, rows), mask, "round {round}: {found:?}");
        }
    }
}
