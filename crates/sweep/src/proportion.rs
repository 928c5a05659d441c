//! The interval of a proportion.

use serde::Serialize;

/// Quantile of the standard normal distribution of a two-sided 95 % interval.
const Z: f64 = 1.959_963_984_540_054;

/// How many of a number of runs had a property.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Proportion {
    /// Runs that had it.
    pub count: u64,
    /// All runs.
    pub of: u64,
}

impl Proportion {
    /// Returns the 95 % interval of its probability, from 0 to 1: Wilson 1927, doi
    /// 10.1080/01621459.1927.10502953. Without a run it is the whole range.
    pub fn interval(self) -> [f64; 2] {
        if self.of == 0 {
            return [0.0, 1.0];
        }
        let (share, of) = (self.count as f64 / self.of as f64, self.of as f64);
        let middle = share + Z * Z / (2.0 * of);
        let half = Z * (share * (1.0 - share) / of + Z * Z / (4.0 * of * of)).sqrt();
        // Rounding must not leave the range.
        [middle - half, middle + half].map(|x| (x / (1.0 + Z * Z / of)).clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Newcombe 1998, Statistics in Medicine 17:857, table I, method 3.
    #[test]
    fn the_intervals_are_the_published_ones() {
        for (count, of, low, high) in [
            (81, 263, 0.2553, 0.3662),
            (15, 148, 0.0624, 0.1605),
            (0, 20, 0.0, 0.1611),
            (1, 29, 0.0061, 0.1718),
        ] {
            let [found_low, found_high] = Proportion { count, of }.interval();
            assert!((found_low - low).abs() < 5e-5 && (found_high - high).abs() < 5e-5, "{count} of {of}");
        }
        assert_eq!(Proportion { count: 0, of: 0 }.interval(), [0.0, 1.0]);
        assert_eq!(Proportion { count: 7, of: 7 }.interval()[1], 1.0);
    }
}
