//! Traverses the voxels of a ray for labels: Siddon's exact method, slab by slab along the ray's dominant
//! axis.
//!
//! In a slab one voxel thick, a ray crosses at most one plane of each other axis, hence at most three voxels.
//! Unlike in the walk of [`siddon`](crate::siddon), slabs do not depend on each other, and eight slabs of
//! empty blocks cost one flag lookup.

use crate::grid::Grid;
use crate::ray::IndexRay;
use crate::removal::BLOCK_SHIFT;

/// Slabs in a run: the side of a block.
const RUN: usize = 1 << BLOCK_SHIFT;

/// What a walk does with a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Visit {
    /// Nothing in the block counts.
    Skip,
    /// Nothing in the block is drilled.
    Intact,
    /// Part of the block is drilled.
    Drilled,
}

/// The part of a ray in a voxel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece {
    /// The voxel's linear index.
    pub linear: usize,
    /// Ray parameter at which the ray enters the voxel.
    pub from: f64,
    /// Length as a difference of ray parameters; can be 0.
    pub length: f64,
}

/// A ray in terms of its dominant axis k and the others, u and v.
pub(crate) struct SlabWalk {
    origin: [f64; 3],
    direction: [f64; 3],
    inverse: [f64; 3],
    size: [usize; 3],
    stride: [usize; 3],
    block_stride: [usize; 3],
    enter: f64,
    leave: f64,
}

/// Index of the dominant axis in the arrays of [`SlabWalk`].
const K: usize = 2;

impl SlabWalk {
    /// Prepares the walk; `None` if the ray misses the volume.
    #[inline(always)]
    pub(crate) fn new(grid: &Grid, block_strides: [usize; 3], ray: &IndexRay) -> Option<Self> {
        let d = ray.direction.map(f64::abs);
        let axes = if d[0] >= d[1] && d[0] >= d[2] {
            [1, 2, 0]
        } else if d[1] >= d[2] {
            [0, 2, 1]
        } else {
            [0, 1, 2]
        };
        let direction = axes.map(|axis| ray.direction[axis]);
        let mut walk = Self {
            origin: axes.map(|axis| ray.origin[axis]),
            direction,
            inverse: direction.map(|d| 1.0 / d),
            size: axes.map(|axis| grid.dims()[axis]),
            stride: axes.map(|axis| grid.strides()[axis]),
            block_stride: axes.map(|axis| block_strides[axis]),
            enter: 0.0,
            leave: 1.0,
        };
        for axis in 0..3 {
            let high = walk.size[axis] as f64 - 0.5;
            if walk.direction[axis] == 0.0 {
                // On a plane, the ray counts as being in the voxel above.
                if walk.origin[axis] < -0.5 || walk.origin[axis] >= high {
                    return None;
                }
                continue;
            }
            let (a, b) = (walk.at_plane(axis, -0.5), walk.at_plane(axis, high));
            (walk.enter, walk.leave) = (walk.enter.max(a.min(b)), walk.leave.min(a.max(b)));
        }
        (walk.enter < walk.leave).then_some(walk)
    }

    /// Parameter at which the ray crosses a plane.
    #[inline(always)]
    fn at_plane(&self, axis: usize, plane: f64) -> f64 {
        (plane - self.origin[axis]) * self.inverse[axis]
    }

    /// The voxel of an axis at a parameter inside the volume.
    #[inline(always)]
    fn voxel_at(&self, axis: usize, at: f64) -> i32 {
        // Rounding can overshoot by less than a voxel; casting a value above -1 gives at least 0.
        ((self.origin[axis] + at * self.direction[axis] + 0.5) as i32).clamp(0, self.size[axis] as i32 - 1)
    }

    /// Calls `what(block)` for the blocks on the ray, and `visit(drilled, pieces)` for each slab that crosses
    /// a block that is not skipped, starting at the source.
    #[inline(always)]
    pub(crate) fn walk(&self, what: impl Fn(usize) -> Visit, mut visit: impl FnMut(bool, [Piece; 3])) {
        let (first, last) = (self.voxel_at(K, self.enter), self.voxel_at(K, self.leave));
        let forward = last >= first;
        let mut k = first;
        // Runs end at block boundaries; each pass handles one run.
        for _ in 0..self.size[K] / RUN + 2 {
            let block_first = k & !(RUN as i32 - 1);
            let end = match forward {
                true => last.min(block_first + RUN as i32 - 1),
                false => last.max(block_first),
            };
            match self.most(k, end, &what) {
                Visit::Skip => {}
                Visit::Intact => self.run(k, end, |pieces| visit(false, pieces)),
                Visit::Drilled => self.run(k, end, |pieces| visit(true, pieces)),
            }
            if end == last {
                break;
            }
            k = if forward { end + 1 } else { end - 1 };
        }
    }

    /// Parameters at which the ray enters the slab `k` and leaves it.
    #[inline(always)]
    fn slab(&self, k: i32) -> (f64, f64) {
        let half = 0.5_f64.copysign(self.direction[K]);
        let clip = |at: f64| lesser(greater(at, self.enter), self.leave);
        (clip(self.at_plane(K, f64::from(k) - half)), clip(self.at_plane(K, f64::from(k) + half)))
    }

    /// The most demanding [`Visit`] of the blocks on the slabs `k..=end`. Slopes are at most 1, so there are
    /// at most 2 x 2 blocks.
    #[inline(always)]
    fn most(&self, k: i32, end: i32, what: &impl Fn(usize) -> Visit) -> Visit {
        let (from, to) = (self.slab(k).0, self.slab(end).1);
        let blocks = |axis: usize| {
            [from, to].map(|at| (self.voxel_at(axis, at) as usize >> BLOCK_SHIFT) * self.block_stride[axis])
        };
        let ([u0, u1], [v0, v1]) = (blocks(0), blocks(1));
        let base = (k as usize >> BLOCK_SHIFT) * self.block_stride[K];
        [u0 + v0, u1 + v0, u0 + v1, u1 + v1]
            .into_iter()
            .map(|at| what(base + at))
            .max()
            .unwrap_or(Visit::Drilled)
    }

    /// Visits the slabs from `first` to `last`, at most one run.
    #[inline(always)]
    fn run(&self, first: i32, last: i32, mut visit: impl FnMut([Piece; 3])) {
        let count = (first.abs_diff(last) + 1) as usize;
        let step = if last >= first { 1 } else { -1 };
        // Branch-free, so that the compiler vectorises it.
        let mut at = [0.0; RUN + 1];
        at[0] = self.slab(first).0;
        for i in 0..RUN {
            at[i + 1] = self.slab(first + step * i as i32).1;
        }
        let mut cell = [0; RUN + 1];
        let (mut here, mut next, mut crossing) = ([[0; RUN]; 2], [[0; RUN]; 2], [[0.0; RUN]; 2]);
        for axis in 0..2 {
            for i in 0..=RUN {
                cell[i] = self.voxel_at(axis, at[i]);
            }
            let stride = self.stride[axis] as i64;
            for i in 0..RUN {
                // At most one plane is crossed; crossing a second is a rounding artefact.
                let (from, to) = (cell[i], cell[i + 1].clamp(cell[i] - 1, cell[i] + 1));
                let plane = self.at_plane(axis, f64::from(from.max(to)) - 0.5);
                crossing[axis][i] =
                    if from == to { at[i + 1] } else { lesser(greater(plane, at[i]), at[i + 1]) };
                (here[axis][i], next[axis][i]) = (i64::from(from) * stride, i64::from(to) * stride);
            }
        }
        for i in 0..count {
            let base = (first + step * i as i32) as usize * self.stride[K];
            let at_voxel = |u: i64, v: i64| base + (u + v) as usize;
            let (u, v) = (crossing[0][i], crossing[1][i]);
            let (near, far) = (lesser(u, v), greater(u, v));
            let between = match u <= v {
                true => at_voxel(next[0][i], here[1][i]),
                false => at_voxel(here[0][i], next[1][i]),
            };
            visit([
                Piece { linear: at_voxel(here[0][i], here[1][i]), from: at[i], length: near - at[i] },
                Piece { linear: between, from: near, length: far - near },
                Piece { linear: at_voxel(next[0][i], next[1][i]), from: far, length: at[i + 1] - far },
            ]);
        }
    }
}

/// The lesser of two numbers; not for NaN, so one instruction.
#[inline(always)]
fn lesser(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// The greater of two numbers; not for NaN.
#[inline(always)]
fn greater(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::siddon;

    /// Pseudo-random numbers in [0, 1): Knuth's linear congruential generator.
    fn numbers() -> impl FnMut() -> f64 {
        let mut state = 1_u64;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        }
    }

    /// Compares with the independent implementation, Siddon's walk: voxel by voxel, with divisions.
    #[test]
    fn slabs_have_the_voxels_of_siddons_walk() {
        let mut random = numbers();
        let (mut visited, mut skipped) = (0, 0);
        for round in 0..4000 {
            let dims = [0; 3].map(|_| 1 + (random() * 40.0) as usize);
            let grid = Grid::centred(dims, [1e-3; 3]).unwrap();
            let mut point = || [0, 1, 2].map(|axis| (random() * 2.0 - 0.5) * dims[axis] as f64);
            let (mut from, to) = (point(), point());
            // Rays along one or two axes, and on the planes between voxels.
            for axis in (0..3).filter(|axis| round >> axis & 1 == 1) {
                from[axis] = if round & 8 == 0 { to[axis] } else { from[axis].round() + 0.5 };
            }
            let direction = [0, 1, 2].map(|axis| to[axis] - from[axis]);
            let ray = IndexRay { origin: from, direction, length_m: 1.0 };
            let blocks = dims.map(|n| n.div_ceil(RUN));
            let what = |block: usize| [Visit::Skip, Visit::Intact, Visit::Drilled][(block / 7 + round) % 3];
            let block_of = |linear: usize| {
                let [i, j, k] = grid.voxel_of(linear).map(|v| v / RUN);
                i + blocks[0] * (j + blocks[1] * k)
            };
            let (mut found, mut wanted) = (BTreeMap::new(), BTreeMap::new());
            if let Some(walk) = SlabWalk::new(&grid, [1, blocks[0], blocks[0] * blocks[1]], &ray) {
                walk.walk(what, |drilled, pieces| {
                    for piece in pieces.into_iter().filter(|piece| piece.length != 0.0) {
                        assert!(piece.length > 0.0, "round {round}: {piece:?}");
                        let enough = drilled || what(block_of(piece.linear)) != Visit::Drilled;
                        assert!(enough || piece.length < 1e-13, "round {round}: {piece:?}");
                        *found.entry(piece.linear).or_insert(0.0) += piece.length;
                    }
                });
            }
            siddon::walk(&grid, &ray, (0.0, 1.0), |linear, a, b| {
                *wanted.entry(linear).or_insert(0.0) += b - a;
            });
            let unseen =
                |linear: &usize| what(block_of(*linear)) == Visit::Skip && !found.contains_key(linear);
            let all = wanted.len();
            wanted.retain(|linear, _| !unseen(linear));
            skipped += all - wanted.len();
            visited += wanted.len();
            for (linear, length) in wanted.iter().chain(&found) {
                let of = |lengths: &BTreeMap<usize, f64>| lengths.get(linear).copied().unwrap_or(0.0);
                let (got, want) = (of(&found), of(&wanted));
                assert!(
                    (got - want).abs() < 1e-13,
                    "round {round}, voxel {linear}: {got}, expected {want} ({length})"
                );
            }
        }
        assert!(visited > 10_000 && skipped > 5_000, "{visited} visited, {skipped} skipped");
    }
}
