//! Memory of each process over a long run: at its start, in its middle, at its end, and its growth rate.

use std::collections::BTreeMap;
use std::time::Duration;

/// Fraction of the run after which a process counts as started: caches are warm and every code path has run.
const STARTED_SHARE: f64 = 0.1;

/// A process's private memory over the run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Curve(Vec<(f64, u64)>);

/// Private memory of all processes, by name.
#[derive(Debug, Clone, Default)]
pub struct Growth(BTreeMap<String, Curve>);

/// Summary of a curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GrowthSummary {
    /// After a tenth of the run, in its middle, at its end; bytes.
    pub bytes: [u64; 3],
    /// Median of the slopes between any two samples (Theil and Sen). Hardly affected by a queue that filled
    /// once or by one bad sample; steady growth shows fully.
    pub bytes_per_minute: f64,
    /// The minimum of this slope and those of the first and second half: a single step, wherever it occurs,
    /// leaves one half flat.
    pub steady_bytes_per_minute: f64,
    /// Time between the first and the last sample.
    pub minutes: f64,
}

impl GrowthSummary {
    /// Returns the steady growth between the first and the last sample.
    pub fn growth_bytes(&self) -> f64 {
        self.steady_bytes_per_minute * self.minutes
    }
}

impl Growth {
    /// Adds a sample of a live process at a time of the run.
    pub fn add(&mut self, name: &str, at: Duration, bytes: u64) {
        self.0.entry(name.to_owned()).or_default().0.push((at.as_secs_f64() / 60.0, bytes));
    }

    /// Returns the processes, by name, that have lived longer than a tenth of the run.
    pub fn curves(&self) -> impl Iterator<Item = (&str, GrowthSummary)> {
        self.0.iter().filter_map(|(name, curve)| Some((name.as_str(), curve.summary()?)))
    }
}

impl Curve {
    fn summary(&self) -> Option<GrowthSummary> {
        let last_min = self.0.last()?.0;
        let settled: Vec<(f64, u64)> =
            self.0.iter().copied().filter(|(minute, _)| *minute >= STARTED_SHARE * last_min).collect();
        let (first, last) = (settled.first()?, settled.last()?);
        let bytes = [first.1, settled.get(settled.len() / 2)?.1, last.1];
        let (first_half, second_half) = settled.split_at(settled.len() / 2);
        let bytes_per_minute = median_slope(&settled);
        let steady_bytes_per_minute =
            [first_half, second_half].map(median_slope).into_iter().fold(bytes_per_minute, f64::min);
        Some(GrowthSummary { bytes, bytes_per_minute, steady_bytes_per_minute, minutes: last.0 - first.0 })
    }
}

/// Returns bytes per minute; 0 with fewer than two distinct times.
fn median_slope(samples: &[(f64, u64)]) -> f64 {
    let pairs = samples.iter().enumerate().flat_map(|(index, from)| {
        let later = samples[index + 1..].iter().filter(|to| to.0 > from.0);
        later.map(|to| (to.1 as f64 - from.1 as f64) / (to.0 - from.0))
    });
    let mut slopes: Vec<f64> = pairs.collect();
    if slopes.is_empty() {
        return 0.0;
    }
    let middle = slopes.len() / 2;
    *slopes.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One sample every five seconds for ten minutes.
    fn curve(of: impl Fn(u64) -> u64) -> GrowthSummary {
        let mut growth = Growth::default();
        for second in (0..=600).step_by(5) {
            growth.add("part", Duration::from_secs(second), of(second));
        }
        growth.curves().next().unwrap().1
    }

    #[test]
    fn a_start_is_no_growth() {
        let flat = curve(|second| if second < 50 { 1000 * second } else { 50_000 });
        assert_eq!((flat.bytes, flat.bytes_per_minute, flat.minutes), ([50_000; 3], 0.0, 9.0));
    }

    #[test]
    fn a_steady_growth_is_its_slope() {
        let grown = curve(|second| 1_000_000 + 500 * second);
        // 500 bytes per second; the quotient of two f64 has a relative error of 1e-16.
        assert!((grown.bytes_per_minute - 30_000.0).abs() < 1e-6, "{grown:?}");
        assert_eq!(grown.bytes, [1_030_000, 1_165_000, 1_300_000]);
        assert!((grown.growth_bytes() - 270_000.0).abs() < 1e-6, "{grown:?}");
    }

    /// Regression: growth of -4540 KiB per minute, because the last sample was of a process that had ended.
    #[test]
    fn a_wrong_last_sample_is_no_slope() {
        let ended = curve(|second| if second < 600 { 5_000_000 } else { 0 });
        assert_eq!(ended.bytes_per_minute, 0.0);
    }

    /// Regression: a queue's high-water mark of 1.03 MiB, while a compiler ran alongside, failed a soak.
    #[test]
    fn a_queue_that_once_ran_full_is_no_growth() {
        for at in [70, 330, 590] {
            let stepped = curve(|second| 20_000_000 + if second < at { 0 } else { 1_080_000 });
            assert!(stepped.growth_bytes() < 1_048_576.0, "step at {at} s: {stepped:?}");
        }
    }

    #[test]
    fn a_leak_in_steps_is_a_growth() {
        let leak = curve(|second| 20_000_000 + second / 60 * 300_000);
        assert!(leak.growth_bytes() > 2_000_000.0, "{leak:?}");
    }

    #[test]
    fn a_single_sample_has_no_slope() {
        let mut growth = Growth::default();
        growth.add("part", Duration::from_secs(3), 7);
        let curves: Vec<_> = growth.curves().collect();
        let none = GrowthSummary {
            bytes: [7; 3],
            bytes_per_minute: 0.0,
            steady_bytes_per_minute: 0.0,
            minutes: 0.0,
        };
        assert_eq!(curves, [("part", none)]);
    }
}
