//! One field over a complete log: minimum, maximum and mean over equal time spans. Pure: no clock, no files.

use run_log::timeline::{Bin, Extremes, Timeline};
use serde::Serialize;

/// Maximum number of bins of one field: 4 MiB. An hour at 1 kHz then has bins of 32 ms.
pub const MOST_BINS: usize = 1 << 17;

/// A field's values. A bin covers one tick at first; if there are more ticks than bins, bins are merged in
/// pairs, so that memory is bounded and no peak is lost.
#[derive(Debug, Clone)]
pub struct Bins {
    begin_ns: u64,
    end_ns: u64,
    /// Starts at `begin_ns`.
    line: Timeline<Extremes>,
}

/// Values for a plot: only the non-empty columns, in ascending order.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Columns {
    /// Column numbers, from 0.
    pub at: Vec<u32>,
    /// Minimum in each column.
    pub low: Vec<f32>,
    /// Maximum in each column.
    pub high: Vec<f32>,
    /// Mean of the samples.
    pub mean: Vec<f32>,
    /// Simulated time that a bin spans, ns. Between neighbours farther apart than this there is a gap.
    pub width_ns: u64,
}

impl Bins {
    /// Creates empty bins for a log from `begin_ns` to `end_ns`, with a tick of `dt_ns` and at most `most`
    /// bins (at least 2).
    pub fn new(begin_ns: u64, end_ns: u64, dt_ns: u64, most: usize) -> Bins {
        Bins { begin_ns, end_ns, line: Timeline::new(most, dt_ns, Extremes::EMPTY) }
    }

    /// Returns the simulated time that a bin spans, ns.
    pub fn width_ns(&self) -> u64 {
        self.line.width_ns()
    }

    /// Adds a sample. Skips values that are not finite or outside the log's bounds; they show as gaps.
    pub fn add(&mut self, time_ns: u64, value: f64) {
        if !value.is_finite() || time_ns < self.begin_ns || time_ns > self.end_ns {
            return;
        }
        self.line.bin(time_ns - self.begin_ns).add(value);
    }

    /// Returns minimum, maximum and mean of each of `columns` equal columns between two times.
    pub fn columns(&self, from_ns: u64, to_ns: u64, columns: u32) -> Columns {
        let mut found = Columns { width_ns: self.width_ns(), ..Columns::default() };
        let (span, count) = (u128::from(to_ns.saturating_sub(from_ns)), u128::from(columns));
        if span == 0 || columns == 0 || to_ns < self.begin_ns {
            return found;
        }
        let first = from_ns.saturating_sub(self.begin_ns) / self.width_ns();
        let last = (to_ns - self.begin_ns) / self.width_ns();
        let bins = self.line.bins();
        let mut current: Option<(u32, Extremes)> = None;
        for index in first..=last.min((bins.len() as u64).saturating_sub(1)) {
            let Some(bin) = bins.get(index as usize).filter(|bin| bin.range().is_some()) else { continue };
            let time_ns = self.begin_ns + index * self.width_ns();
            let here = u128::from(time_ns.saturating_sub(from_ns)) * count / span;
            let column = here.min(count - 1) as u32;
            match &mut current {
                Some((at, merged)) if *at == column => merged.merge(bin),
                _ => {
                    found.push(current.replace((column, *bin)));
                }
            }
        }
        found.push(current);
        found
    }
}

impl Columns {
    fn push(&mut self, column: Option<(u32, Extremes)>) {
        let Some((at, Some([low, mean, high]))) = column.map(|(at, bin)| (at, bin.range())) else { return };
        self.at.push(at);
        self.low.push(low as f32);
        self.high.push(high as f32);
        self.mean.push(mean as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Minimum, maximum and mean of the samples of each column, straight from the definition.
    fn by_definition(samples: &[(u64, f64)], from: u64, to: u64, columns: u32) -> Vec<(u32, f64, f64, f64)> {
        let column =
            |time: u64| ((time - from) * u64::from(columns) / (to - from)).min(u64::from(columns) - 1);
        let mut rows = Vec::new();
        for number in 0..columns {
            let inside =
                |(time, _): &&(u64, f64)| (from..=to).contains(time) && column(*time) == u64::from(number);
            let values: Vec<f64> = samples.iter().filter(inside).map(|(_, value)| *value).collect();
            if !values.is_empty() {
                let low = values.iter().copied().fold(f64::INFINITY, f64::min);
                let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                rows.push((number, low, high, values.iter().sum::<f64>() / values.len() as f64));
            }
        }
        rows
    }

    #[test]
    fn any_zoom_has_the_least_the_greatest_and_the_mean_of_every_sample_in_it() {
        let samples: Vec<(u64, f64)> = (0..5000)
            .filter(|k| !(2000..2300).contains(k))
            .map(|k| (k * 10, f64::from((k * 7919 % 1013) as u32)))
            .collect();
        let mut bins = Bins::new(0, 50_000, 10, MOST_BINS);
        samples.iter().for_each(|(time, value)| bins.add(*time, *value));
        for (from, to, columns) in
            [(0, 50_000, 100), (0, 50_000, 1), (12_340, 13_370, 40), (100, 200, 1000), (19_000, 24_000, 25)]
        {
            let found = bins.columns(from, to, columns);
            let expected = by_definition(&samples, from, to, columns);
            assert_eq!(
                found.at,
                expected.iter().map(|row| row.0).collect::<Vec<_>>(),
                "{from} {to} {columns}"
            );
            for (i, (_, low, high, mean)) in expected.iter().enumerate() {
                assert_eq!((f64::from(found.low[i]), f64::from(found.high[i])), (*low, *high));
                assert!((f64::from(found.mean[i]) - mean).abs() <= 1e-4 * mean.abs().max(1.0), "f32");
            }
        }
        assert_eq!(bins.columns(20_000, 22_990, 300).at, Vec::<u32>::new(), "a gap in the log stays a gap");
    }

    #[test]
    fn a_long_log_takes_bounded_memory_and_keeps_its_peaks() {
        let mut bins = Bins::new(0, u64::MAX, 1, 64);
        for time in 0..100_000u64 {
            bins.add(time, if time == 77_777 { 5.0 } else { 1.0 });
        }
        assert!(bins.line.bins().len() <= 64 && bins.line.bins().capacity() < 1000);
        let whole = bins.columns(0, 100_000, 10);
        assert_eq!(whole.at, (0..10).collect::<Vec<_>>());
        assert_eq!(whole.high.iter().filter(|high| **high == 5.0).count(), 1);
        assert_eq!(whole.high[7], 5.0);
    }

    #[test]
    fn hostile_times_and_values_and_zooms_to_nothing_are_holes() {
        let mut bins = Bins::new(1000, 2000, 0, 4);
        for time in [0, 999, 2001, u64::MAX] {
            bins.add(time, 1.0);
        }
        for value in [f64::NAN, f64::INFINITY] {
            bins.add(1500, value);
        }
        assert_eq!(bins.columns(0, u64::MAX, 1000).at, Vec::<u32>::new());
        bins.add(2000, 3.0);
        bins.add(1000, 1.0);
        for (from, to) in [(5, 5), (9, 3), (0, 10), (u64::MAX, u64::MAX), (u64::MAX - 1, u64::MAX)] {
            assert_eq!(bins.columns(from, to, 100).at, Vec::<u32>::new(), "{from} {to}");
        }
        assert_eq!(bins.columns(0, u64::MAX, 0).at, Vec::<u32>::new());
        assert_eq!(bins.columns(0, u64::MAX, u32::MAX).low, [1.0]);
        let mut endless = Bins::new(0, u64::MAX, 1, 4);
        [0, u64::MAX, 1].iter().for_each(|time| endless.add(*time, 2.0));
        assert_eq!(endless.columns(0, u64::MAX, 2).at, [0, 1]);
    }
}
