//! Distributions of durations.

use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};

use super::ReportError;
use super::timeline::Bin;

/// Longest duration, 1000 s; longer ones are counted as this.
const LONGEST_NS: u64 = 1_000_000_000_000;

/// Durations in nanoseconds, counted in bins of a fixed relative width.
#[derive(Debug, Clone)]
pub struct Distribution(Histogram<u64>);

/// Quantiles of a distribution, in the unit that the owning field's name gives.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Number of samples.
    pub count: u64,
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// 99th percentile.
    pub p99: f64,
    /// 99.9th percentile.
    pub p99_9: f64,
    /// Longest.
    pub max: f64,
}

impl Quantiles {
    /// Median, 90th, 99th and 99.9th percentile, and the longest.
    pub fn values(&self) -> [f64; 5] {
        [self.p50, self.p90, self.p99, self.p99_9, self.max]
    }
}

impl Distribution {
    /// Creates an empty distribution. Values keep `significant_digits` (1 to 5) decimal digits.
    pub fn new(significant_digits: u8) -> Result<Distribution, ReportError> {
        let histogram = Histogram::new_with_bounds(1, LONGEST_NS, significant_digits);
        histogram.map(Distribution).map_err(|source| ReportError::Histogram { source })
    }

    /// Adds a duration; anything above 1000 s is counted as 1000 s.
    pub fn add(&mut self, nanoseconds: u64) {
        self.0.saturating_record(nanoseconds);
    }

    /// Removes all samples.
    pub fn clear(&mut self) {
        self.0.reset();
    }

    /// Number of samples.
    pub fn count(&self) -> u64 {
        self.0.len()
    }

    /// Returns the quantiles in units of `unit_ns`, at most half a bin (0.05 % with 3 digits) too high, or
    /// `None` without samples.
    pub fn quantiles(&self, unit_ns: f64) -> Option<Quantiles> {
        let at = |quantile: f64| self.0.value_at_quantile(quantile) as f64 / unit_ns;
        let max = self.0.max() as f64 / unit_ns;
        let count = self.count();
        (count > 0).then(|| Quantiles {
            count,
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            p99_9: at(0.999),
            max,
        })
    }

    /// Returns each recorded value with its sample count, ascending, without empty bins.
    pub fn recorded(&self) -> impl Iterator<Item = (u64, u64)> {
        self.0.iter_recorded().map(|step| (step.value_iterated_to(), step.count_at_value()))
    }
}

impl Bin for Distribution {
    fn merge(&mut self, later: &Distribution) {
        // Both have the same bounds, so no value of one is too large for the other.
        let _ = self.0.add(&later.0);
    }
}
