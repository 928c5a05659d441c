//! Counter-based random numbers: each is a pure function of a key and a counter, without generator state, so
//! the results do not depend on the order of use or the number of threads.
//!
//! Used for the noise of X-ray frames (key: seed and frame, counter: pixel) and of sensors (key: seed, sensor
//! and tick, counter: channel).
//!
//! **Boundary:** pure computation; no I/O, clock or state.
//!
//! ```
//! use counter_random::Key;
//!
//! let key = Key::of(7).and(3);
//! assert_eq!(key.word(11), Key::of(7).and(3).word(11));
//! assert_ne!(key.word(11), key.word(12));
//! assert!((0.0..1.0).contains(&key.uniform(0)));
//! ```

/// Key of a series of random numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Key(u64);

impl Key {
    /// Creates a key from a seed.
    #[inline(always)]
    pub const fn of(seed: u64) -> Key {
        Key(mix(seed))
    }

    /// Mixes one more number into the key.
    #[inline(always)]
    #[must_use]
    pub const fn and(self, number: u64) -> Key {
        Key(mix(self.0 ^ number))
    }

    /// Returns the random word for a counter.
    #[inline(always)]
    pub const fn word(self, counter: u64) -> u64 {
        mix(self.0 ^ counter)
    }

    /// Returns a uniform number in the open interval (0, 1), a multiple of 2⁻⁵⁴.
    #[inline]
    pub fn uniform(self, counter: u64) -> f64 {
        uniform(self.word(counter))
    }

    /// Returns a standard normal number (Box and Muller 1958, "A note on the generation of random normal
    /// deviates", Ann. Math. Stat. 29), at most 8.7 in magnitude. It uses the words of the counters `2 *
    /// counter` and `2 * counter + 1`, so none of these may be passed to [`Key::uniform`] of the same key.
    pub fn normal(self, counter: u64) -> f64 {
        let a = self.uniform(2 * counter);
        let b = self.uniform(2 * counter + 1);
        libm::sqrt(-2.0 * libm::log(a)) * libm::cos(core::f64::consts::TAU * b)
    }
}

/// Applies the finaliser of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number
/// generators", OOPSLA 2014; constants of D. Stafford's variant 13), including its increment.
#[inline(always)]
pub const fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ x >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ x >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ x >> 31
}

/// Converts a random word to a uniform number in the open interval (0, 1).
#[inline(always)]
pub fn uniform(word: u64) -> f64 {
    ((word >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first outputs of SplitMix64 seeded with 0, as printed by its authors' C program
    /// (prng.di.unimi.it/splitmix64.c).
    #[test]
    fn words_are_those_of_splitmix64() {
        let step = 0x9E37_79B9_7F4A_7C15_u64;
        let want = [0xE220_A839_7B1D_CDAF, 0x6E78_9E6A_A1B9_65F4, 0x06C4_5D18_8009_454F];
        assert_eq!([0, 1, 2_u64].map(|n| mix(n.wrapping_mul(step))), want);
    }

    /// Mean, variance and fourth moment of a million numbers, within four standard errors of those of the
    /// normal distribution.
    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_law() {
        let count = 1_000_000_u64;
        let key = Key::of(1);
        let mut sums = [0.0; 4];
        for i in 0..count {
            let x = key.normal(i);
            for (power, sum) in (1..).zip(&mut sums) {
                *sum += x.powi(power);
            }
        }
        let moments = sums.map(|sum| sum / count as f64);
        // Variances of xⁿ for a standard normal x: 1, 2, 15, 96.
        for ((moment, want), variance) in moments.iter().zip([0.0, 1.0, 0.0, 3.0]).zip([1.0, 2.0, 15.0, 96.0])
        {
            let error = (variance / count as f64).sqrt();
            assert!((moment - want).abs() < 4.0 * error, "{moments:?}");
        }
    }
}
