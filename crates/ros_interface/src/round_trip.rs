//! How long commands take: from the state that they answer to their arrival.

/// Width of a bin, s.
const BIN_S: f64 = 1e-4;
/// Number of bins; longer times fall into the last one.
const BINS: usize = 10_000;

/// Times from a state to the command that answers it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RoundTrips {
    bins: Vec<u64>,
    count: u64,
    longest_s: f64,
}

impl RoundTrips {
    /// Adds a time; one that is negative or not a number is ignored, because stamps come from others.
    pub fn add(&mut self, seconds: f64) {
        // Written so that NaN fails.
        if !(0.0..=f64::MAX).contains(&seconds) {
            return;
        }
        self.bins.resize(BINS, 0);
        self.bins[((seconds / BIN_S).round() as usize).min(BINS - 1)] += 1;
        self.count += 1;
        self.longest_s = self.longest_s.max(seconds);
    }

    /// Number of times.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The longest time, s.
    pub fn longest_s(&self) -> f64 {
        self.longest_s
    }

    /// Returns the time, s, that a share of all times does not exceed, to 0.1 ms.
    pub fn quantile_s(&self, share: f64) -> f64 {
        let most = (share * self.count as f64).ceil() as u64;
        let mut so_far = 0;
        let reached = self.bins.iter().position(|count| {
            so_far += count;
            so_far >= most
        });
        (reached.unwrap_or(0) as f64 * BIN_S).min(self.longest_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_times() {
        let mut times = RoundTrips::default();
        assert_eq!((times.count(), times.quantile_s(0.5)), (0, 0.0));
        (1..=100).for_each(|number| times.add(f64::from(number) * 1e-3));
        [f64::NAN, -1.0, f64::INFINITY].into_iter().for_each(|wrong| times.add(wrong));
        let near = |share, expected_s: f64| assert!((times.quantile_s(share) - expected_s).abs() < 1e-9);
        near(0.5, 0.05);
        near(0.99, 0.099);
        near(1.0, 0.1);
        times.add(5.0);
        assert_eq!((times.count(), times.longest_s()), (101, 5.0));
    }
}
