//! Designs: distributions of a sweep's points in the unit cube.

use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

/// Maximum samples of a Sobol or Saltelli design, the length of the sequence of `sobol_burley`.
pub const MAX_SOBOL_SAMPLES: u64 = 1 << 16;

/// Distribution of the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Design {
    /// Every combination; the last parameter varies fastest.
    Grid,
    /// Independent, uniformly distributed points.
    Random,
    /// Each parameter's range is divided into as many strata as samples, with one sample each (McKay, Beckman
    /// and Conover 1979).
    LatinHypercube,
    /// A Sobol sequence, scrambled by the seed (Burley 2020, "Practical hash-based Owen scrambling").
    Sobol,
    /// Two Sobol samples A and B, and A with each column in turn taken from B: samples × (parameters + 2)
    /// points, for Sobol indices (Saltelli et al. 2010, doi 10.1016/j.cpc.2009.09.018). The points of a
    /// sample are consecutive: A, A with column 1 from B, …, B.
    Saltelli,
    /// The rows of a CSV file.
    Csv,
}

impl Design {
    /// Returns its name in a study.
    pub fn name(self) -> &'static str {
        match self {
            Design::Grid => "grid",
            Design::Random => "random",
            Design::LatinHypercube => "latin_hypercube",
            Design::Sobol => "sobol",
            Design::Saltelli => "saltelli",
            Design::Csv => "csv",
        }
    }

    /// Returns the coordinate of point `index` in dimension `dimension` of `dimensions`, in [0, 1), for
    /// designs in the unit cube.
    pub(crate) fn unit(self, index: u64, (dimension, dimensions): (usize, usize), of: Sampling) -> f64 {
        match self {
            Design::Random => of.number(index, dimension),
            Design::LatinHypercube => {
                let part = permuted(index, of.samples, of.hash(u64::MAX, dimension));
                (part as f64 + of.number(index, dimension)) / of.samples as f64
            }
            Design::Sobol => of.sobol(index, dimension),
            Design::Saltelli => {
                let (sample, member) = (index / (dimensions as u64 + 2), index % (dimensions as u64 + 2));
                // Member 0 is A, member j + 1 is A with column j from B, the last is B.
                let from_b = member == dimensions as u64 + 1 || member == dimension as u64 + 1;
                of.sobol(sample, if from_b { dimensions + dimension } else { dimension })
            }
            Design::Grid | Design::Csv => 0.0,
        }
    }
}

/// Seed and sample count of a design.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Sampling {
    pub seed: u64,
    pub samples: u64,
}

impl Sampling {
    fn hash(self, index: u64, dimension: usize) -> u64 {
        let words = [self.seed, index, dimension as u64];
        xxh3_64(&words.map(u64::to_le_bytes).concat())
    }

    /// Returns a number in [0, 1) with 53 bits.
    fn number(self, index: u64, dimension: usize) -> f64 {
        (self.hash(index, dimension) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn sobol(self, index: u64, dimension: usize) -> f64 {
        // `Study` has checked both against the limits of the sequence.
        let seed = xxh3_64(&self.seed.to_le_bytes()) as u32;
        f64::from(sobol_burley::sample(index as u32, dimension as u32, seed))
    }
}

/// Returns point `index`, below [`MAX_SOBOL_SAMPLES`], of a Sobol sequence in the unit cube, scrambled by the
/// seed.
pub fn sobol_point<const DIMENSIONS: usize>(seed: u64, index: u64) -> [f64; DIMENSIONS] {
    let sampling = Sampling { seed, samples: MAX_SOBOL_SAMPLES };
    std::array::from_fn(|dimension| sampling.sobol(index, dimension))
}

/// Permutes 0 to `count` - 1 by `key`: a Feistel network on the next power of four with cycle walking (Black
/// and Rogaway 2002, "Ciphers with arbitrary finite domains").
fn permuted(index: u64, count: u64, key: u64) -> u64 {
    let half_bits = (64 - count.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1_u64 << half_bits) - 1;
    let mut place = index;
    loop {
        let (mut left, mut right) = (place >> half_bits, place & mask);
        for round in 0..6_u64 {
            let mixed = xxh3_64(&[key, round, right].map(u64::to_le_bytes).concat());
            (left, right) = (right, left ^ (mixed & mask));
        }
        place = left << half_bits | right;
        if place < count {
            return place;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_permutation_meets_every_place_once(count in 1_u64..600, key: u64) {
            let mut met: Vec<u64> = (0..count).map(|index| permuted(index, count, key)).collect();
            met.sort_unstable();
            prop_assert_eq!(met, (0..count).collect::<Vec<u64>>());
        }
    }
}
