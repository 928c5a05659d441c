//! Durations and their quantiles.

/// Durations in nanoseconds.
#[derive(Debug, Clone, Default)]
pub struct Samples(Vec<u64>);

impl Samples {
    /// Adds a sample.
    pub fn add(&mut self, nanoseconds: u64) {
        self.0.push(nanoseconds);
    }

    /// Adds all samples of another.
    pub fn append(&mut self, other: &Samples) {
        self.0.extend_from_slice(&other.0);
    }

    /// Keeps, sample by sample, the minimum of both series, for repeated measurements of the same work.
    pub fn keep_least(&mut self, again: &Samples) {
        for (mine, other) in self.0.iter_mut().zip(&again.0) {
            *mine = (*mine).min(*other);
        }
    }

    /// Number of samples.
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// The sample at rank `fraction` (0 to 1) of the sorted samples, in microseconds; 0 without samples.
    pub fn quantile_us(&self, fraction: f64) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_unstable();
        let rank = (fraction * sorted.len().saturating_sub(1) as f64 + 0.5) as usize;
        sorted.get(rank).map_or(0.0, |nanoseconds| *nanoseconds as f64 * 1e-3)
    }

    /// Quantiles as figures.
    pub fn figures(&self) -> serde_json::Value {
        let [p50_us, p99_us, p99_9_us] = [0.5, 0.99, 0.999].map(|fraction| self.quantile_us(fraction));
        serde_json::json!({"p50_us": p50_us, "p99_us": p99_us, "p99_9_us": p99_9_us, "samples": self.count()})
    }

    /// Quantiles as a table line.
    pub fn line(&self) -> String {
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(|fraction| self.quantile_us(fraction));
        format!("p50 {p50:9.2}  p99 {p99:9.2}  p99.9 {p999:9.2} us   ({} samples)", self.count())
    }
}

/// Returns the median of some numbers; 0 if empty.
pub fn median(numbers: &[f64]) -> f64 {
    let mut sorted = numbers.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_samples_by_rank_whatever_the_order() {
        let mut samples = Samples::default();
        (0..=100).rev().for_each(|micros| samples.add(micros * 1000));
        assert_eq!(
            [0.0, 0.5, 0.99, 1.0].map(|fraction| samples.quantile_us(fraction)),
            [0.0, 50.0, 99.0, 100.0]
        );
        assert_eq!(Samples::default().quantile_us(0.5), 0.0);
        let mut least = Samples(vec![5, 1, 7]);
        least.keep_least(&Samples(vec![4, 2, 6]));
        assert_eq!(least.0, [4, 1, 6]);
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
    }
}
