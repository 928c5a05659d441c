//! The open space around a bone: what lies outside of it, before anything is drilled.
//!
//! Marrow and the pores of cancellous bone are enclosed and count as bone. A voxel is outside if it is not
//! bone and connected by such voxels to the edges of the volume, where passages narrower than
//! [`CLOSED_M`] to either side are closed: foramina and cracks of a coarse CT do not lead outside into the
//! marrow. The connection begins at the twelve edges of the volume's box and not at its faces, so that the
//! canal of a shaft that a face cuts is enclosed.
//!
//! One bit for each voxel in rows along x; a flood takes 64 voxels at a time.

use nalgebra::Vector3;

use super::grid::{GridGeometry, floor_to_i64};

/// Half the width, m, of the passages that are closed, at least one voxel: nutrient foramina of a femur are
/// 1 to 2 mm wide.
const CLOSED_M: f64 = 1e-3;

/// Bits of the voxels of a grid, in rows along x that begin with a new word.
#[derive(Debug, Clone, PartialEq)]
struct Rows {
    dims: [usize; 3],
    words: usize,
    bits: Vec<u64>,
}

impl Rows {
    fn new(dims: [usize; 3]) -> Rows {
        let words = dims[0].div_ceil(64);
        Rows { dims, words, bits: vec![0; words * dims[1] * dims[2]] }
    }

    /// Returns the bits of a word of a row that are voxels.
    fn valid(&self, word: usize) -> u64 {
        match self.dims[0] - 64 * word {
            64.. => u64::MAX,
            count => (1 << count) - 1,
        }
    }

    fn at(&self, [i, j, k]: [usize; 3]) -> bool {
        self.bits[(k * self.dims[1] + j) * self.words + i / 64] >> (i % 64) & 1 == 1
    }

    fn set(&mut self, [i, j, k]: [usize; 3]) {
        self.bits[(k * self.dims[1] + j) * self.words + i / 64] |= 1 << (i % 64);
    }

    /// Returns the distance between the words of neighbours along y and along z.
    fn strides(&self) -> [usize; 2] {
        [self.words, self.words * self.dims[1]]
    }

    /// Adds the neighbours of every bit along the given axes.
    fn widened(&self, axes: [bool; 3]) -> Rows {
        let mut wide = self.clone();
        let (words, [row, slice]) = (self.words, self.strides());
        for at in 0..self.bits.len() {
            let word = at % words;
            let mut bits = self.bits[at];
            if axes[0] {
                let below = if word > 0 { self.bits[at - 1] >> 63 } else { 0 };
                let above = if word + 1 < words { self.bits[at + 1] << 63 } else { 0 };
                bits |= bits << 1 | bits >> 1 | below | above;
            }
            let along = [
                (axes[1], row, at / row % self.dims[1], self.dims[1]),
                (axes[2], slice, at / slice, self.dims[2]),
            ];
            for (is_wide, stride, index, count) in along {
                if is_wide && index > 0 {
                    bits |= self.bits[at - stride];
                }
                if is_wide && index + 1 < count {
                    bits |= self.bits[at + stride];
                }
            }
            wide.bits[at] = bits & self.valid(word);
        }
        wide
    }

    /// Extends the bits through `open`, which contains them, as far as it is connected across faces.
    fn flood(&mut self, open: &Rows) {
        let rows = self.dims[1] * self.dims[2];
        loop {
            let mut has_grown = false;
            for row in 0..rows {
                has_grown |= self.flood_row(row, open);
            }
            for row in (0..rows).rev() {
                has_grown |= self.flood_row(row, open);
            }
            if !has_grown {
                return;
            }
        }
    }

    /// Extends a row by its neighbours and within itself; returns whether it has grown.
    fn flood_row(&mut self, row: usize, open: &Rows) -> bool {
        let (words, [along_y, along_z]) = (self.words, self.strides());
        let (j, k) = (row % self.dims[1], row / self.dims[1]);
        let from = row * words;
        if self.bits[from..from + words] == open.bits[from..from + words] {
            return false;
        }
        let mut has_grown = false;
        for at in from..from + words {
            let mut bits = self.bits[at];
            if j > 0 {
                bits |= self.bits[at - along_y];
            }
            if j + 1 < self.dims[1] {
                bits |= self.bits[at + along_y];
            }
            if k > 0 {
                bits |= self.bits[at - along_z];
            }
            if k + 1 < self.dims[2] {
                bits |= self.bits[at + along_z];
            }
            bits &= open.bits[at];
            has_grown |= bits != self.bits[at];
            self.bits[at] = bits;
        }
        // Up the row, then down, each with the bit that the word before hands on.
        let mut carry = 0;
        for at in from..from + words {
            let bits = run_up(self.bits[at] | (carry & open.bits[at]), open.bits[at]);
            has_grown |= bits != self.bits[at];
            (self.bits[at], carry) = (bits, bits >> 63);
        }
        let mut carry = 0;
        for at in (from..from + words).rev() {
            let seeds = self.bits[at] | (carry & open.bits[at]);
            let bits = run_up(seeds.reverse_bits(), open.bits[at].reverse_bits()).reverse_bits();
            has_grown |= bits != self.bits[at];
            (self.bits[at], carry) = (bits, bits << 63);
        }
        has_grown
    }
}

/// Extends seeds upward through the runs of `open` that contain them, in steps of 1, 2, 4, …, 32 bits.
fn run_up(mut seeds: u64, mut open: u64) -> u64 {
    for shift in [1, 2, 4, 8, 16, 32] {
        seeds |= open & (seeds << shift);
        open &= open << shift;
    }
    seeds
}

/// Which voxels lie outside of the bone of a CT.
#[derive(Debug, Clone, PartialEq)]
pub struct Outside {
    geometry: GridGeometry,
    rows: Rows,
}

impl Outside {
    /// Determines the outside of the voxels at or above `threshold_hu`. `hu` has one value for each voxel, x
    /// fastest.
    pub fn new(geometry: GridGeometry, hu: &[i16], threshold_hu: i16) -> Outside {
        let dims = geometry.dims;
        let mut bone = Rows::new(dims);
        for (row, values) in hu.chunks_exact(dims[0]).enumerate() {
            for (word, chunk) in values.chunks(64).enumerate() {
                let bit = |(place, value): (usize, &i16)| u64::from(*value >= threshold_hu) << place;
                bone.bits[row * bone.words + word] = chunk.iter().enumerate().map(bit).sum();
            }
        }
        let steps = geometry.spacing_m.map(|spacing_m| libm::round(CLOSED_M / spacing_m).max(1.0) as usize);
        let most = steps.into_iter().fold(0, usize::max);
        let mut closed = bone.clone();
        for step in 0..most {
            closed = closed.widened(steps.map(|count| step < count));
        }
        let mut open = Rows::new(dims);
        for (at, bits) in open.bits.iter_mut().enumerate() {
            *bits = !closed.bits[at] & closed.valid(at % closed.words);
        }
        let mut rows = Rows::new(dims);
        for_each_of_edges(dims, |voxel| {
            if open.at(voxel) {
                rows.set(voxel);
            }
        });
        rows.flood(&open);
        // Back to the surface of the bone, but not through it.
        for step in 0..most {
            rows = rows.widened(steps.map(|count| step < count));
            rows.bits.iter_mut().zip(&bone.bits).for_each(|(bits, bone)| *bits &= !bone);
        }
        Outside { geometry, rows }
    }

    /// Returns the grid.
    pub fn geometry(&self) -> &GridGeometry {
        &self.geometry
    }

    /// Returns whether a voxel is outside of the bone; `None` beyond the grid.
    pub fn voxel(&self, voxel: [i64; 3]) -> Option<bool> {
        let is_within = (0..3).all(|a| voxel[a] >= 0 && voxel[a] < self.geometry.dims[a] as i64);
        is_within.then(|| self.rows.at(voxel.map(|index| index as usize)))
    }

    /// Returns whether each voxel is outside of the bone, x fastest.
    pub fn bits(&self) -> Vec<bool> {
        let [nx, ny, nz] = self.geometry.dims;
        let voxel = |index: usize| self.rows.at([index % nx, index / nx % ny, index / (nx * ny)]);
        (0..nx * ny * nz).map(voxel).collect()
    }

    /// Returns whether a world point is outside of the bone, or of the volume.
    pub fn holds(&self, point_world_m: &Vector3<f64>) -> bool {
        let (point, h) = (self.geometry.point_to_grid(point_world_m), self.geometry.spacing_m);
        let voxel = [0, 1, 2].map(|a| floor_to_i64(point[a] / h[a] + 0.5));
        self.voxel(voxel).unwrap_or(true)
    }
}

/// Visits the voxels of the twelve edges of a box.
fn for_each_of_edges(dims: [usize; 3], mut visit: impl FnMut([usize; 3])) {
    let last = dims.map(|count| count - 1);
    for axis in 0..3 {
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        for along in 0..dims[axis] {
            for (at_b, at_c) in [(0, 0), (0, last[c]), (last[b], 0), (last[b], last[c])] {
                let mut voxel = [0; 3];
                (voxel[axis], voxel[b], voxel[c]) = (along, at_b, at_c);
                visit(voxel);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const N: usize = 71;

    fn grid(spacing_m: [f64; 3]) -> GridGeometry {
        let middle = spacing_m.map(|h| -0.5 * h * (N - 1) as f64);
        GridGeometry::axis_aligned([N; 3], spacing_m, Vector3::from(middle))
    }

    /// The outside of bone where `is_bone` holds, by the position of a voxel's centre, mm.
    fn outside(spacing_m: [f64; 3], is_bone: impl Fn([f64; 3]) -> bool) -> Outside {
        let geometry = grid(spacing_m);
        let hu = (0..N * N * N).map(|index| {
            let centre = geometry.voxel_centre_world_m(index % N, index / N % N, index / (N * N));
            if is_bone((centre * 1e3).into()) { 1000 } else { 0 }
        });
        Outside::new(geometry, &hu.collect::<Vec<i16>>(), 150)
    }

    fn mm(x: f64, y: f64, z: f64) -> Vector3<f64> {
        Vector3::new(x, y, z) * 1e-3
    }

    fn norm([x, y, z]: [f64; 3]) -> f64 {
        (x * x + y * y + z * z).sqrt()
    }

    /// A shell of 2 mm with marrow inside: voxels of 0.5 mm, and of 0.5 x 0.5 x 1 mm.
    #[test]
    fn marrow_is_not_outside_and_the_surface_is_that_of_the_bone_to_a_voxel() {
        for spacing_m in [[0.5e-3; 3], [0.5e-3, 0.5e-3, 1e-3]] {
            let shell = outside(spacing_m, |point| (8.0..=10.0).contains(&norm(point)));
            assert!(!shell.holds(&Vector3::zeros()) && !shell.holds(&mm(0.0, 9.0, 0.0)));
            for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
                let voxel_mm = 1e3 * spacing_m.iter().copied().fold(0.0, f64::max);
                assert!(shell.holds(&(axis * 1e-3 * (10.0 + voxel_mm))));
                assert!(!shell.holds(&(axis * 1e-3 * (10.0 - voxel_mm))));
            }
            assert!(shell.holds(&mm(0.0, 0.0, 1e3)), "beyond the volume");
        }
    }

    /// A hole of 1.5 mm through the shell does not lead outside into the marrow; one of 5 mm does.
    #[test]
    fn a_foramen_is_closed_and_a_wide_hole_is_not() {
        let pierced = |radius_mm: f64| {
            outside([0.5e-3; 3], |[x, y, z]| {
                (8.0..=10.0).contains(&norm([x, y, z])) && !(z > 0.0 && x.hypot(y) < radius_mm)
            })
        };
        assert!(!pierced(0.75).holds(&Vector3::zeros()));
        assert!(pierced(2.5).holds(&Vector3::zeros()));
    }

    /// A tube along z that both faces cut: its canal is inside.
    #[test]
    fn the_canal_of_a_shaft_that_the_volume_cuts_is_inside() {
        let shaft = outside([0.5e-3; 3], |[x, y, _]| (6.0..=9.0).contains(&x.hypot(y)));
        assert!(!shaft.holds(&Vector3::zeros()) && shaft.holds(&mm(12.0, 0.0, 0.0)));
    }

    /// The slow way: one voxel after the other.
    fn flooded(open: &Rows, seed: [usize; 3]) -> Rows {
        let mut found = Rows::new(open.dims);
        let mut waiting = vec![seed];
        while let Some(voxel) = waiting.pop() {
            if !open.at(voxel) || found.at(voxel) {
                continue;
            }
            found.set(voxel);
            for axis in 0..3 {
                let mut beside = voxel;
                if voxel[axis] > 0 {
                    beside[axis] = voxel[axis] - 1;
                    waiting.push(beside);
                }
                if voxel[axis] + 1 < open.dims[axis] {
                    beside[axis] = voxel[axis] + 1;
                    waiting.push(beside);
                }
            }
        }
        found
    }

    proptest! {
        #[test]
        fn a_flood_by_words_is_the_flood_by_voxels(
            dims in [1_usize..140, 1_usize..5, 1_usize..5],
            words in proptest::collection::vec([any::<u64>(), any::<u64>()], 48),
        ) {
            let mut open = Rows::new(dims);
            for (word, [one, other]) in words.into_iter().take(open.bits.len()).enumerate() {
                open.bits[word] = (one | other) & open.valid(word % open.words);
            }
            open.set([0; 3]);
            let mut found = Rows::new(dims);
            found.set([0; 3]);
            found.flood(&open);
            prop_assert_eq!(found, flooded(&open, [0; 3]));
        }
    }
}
