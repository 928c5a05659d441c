//! Bins over simulated time, in bounded memory for a run of any length.

/// Content of a bin.
pub trait Bin: Clone {
    /// Merges the following bin into this one.
    fn merge(&mut self, later: &Self);
}

/// Bins of equal width, starting at time 0. When a time lies beyond the last possible bin, neighbouring bins
/// are merged and the width doubles until it fits: the run always covers between half and all of `capacity`
/// bins.
#[derive(Debug, Clone)]
pub struct Timeline<B> {
    capacity: usize,
    width_ns: u64,
    empty: B,
    bins: Vec<B>,
}

impl<B: Bin> Timeline<B> {
    /// Creates at most `capacity` bins (2 or more), initially `width_ns` wide; `empty` is an empty bin.
    pub fn new(capacity: usize, width_ns: u64, empty: B) -> Timeline<B> {
        Timeline { capacity: capacity.max(2), width_ns: width_ns.max(1), empty, bins: Vec::new() }
    }

    /// Returns the bin that contains a time.
    pub fn bin(&mut self, time_ns: u64) -> &mut B {
        while time_ns / self.width_ns >= self.capacity as u64 {
            self.halve();
        }
        let index = (time_ns / self.width_ns) as usize;
        if self.bins.len() <= index {
            self.bins.resize(index + 1, self.empty.clone());
        }
        &mut self.bins[index]
    }

    /// Simulated time that a bin spans, ns.
    pub fn width_ns(&self) -> u64 {
        self.width_ns
    }

    /// Returns the bins up to the last one used, in order.
    pub fn bins(&self) -> &Vec<B> {
        &self.bins
    }

    /// Returns the middle of each bin (s) and the bin, in order.
    pub fn iter(&self) -> impl Iterator<Item = (f64, &B)> {
        let width_s = self.width_ns as f64 * 1e-9;
        self.bins.iter().enumerate().map(move |(i, bin)| ((i as f64 + 0.5) * width_s, bin))
    }

    fn halve(&mut self) {
        let merged = self.bins.chunks(2).map(|pair| {
            let mut first = pair[0].clone();
            if let Some(second) = pair.get(1) {
                first.merge(second);
            }
            first
        });
        self.bins = merged.collect();
        self.width_ns = self.width_ns.saturating_mul(2);
    }
}

/// Minimum, maximum and mean of the finite samples of a bin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extremes {
    low: f64,
    high: f64,
    sum: f64,
    count: u64,
}

impl Extremes {
    /// A bin without samples.
    pub const EMPTY: Extremes = Extremes { low: f64::INFINITY, high: f64::NEG_INFINITY, sum: 0.0, count: 0 };

    /// Adds a sample; ignores non-finite ones.
    pub fn add(&mut self, value: f64) {
        if value.is_finite() {
            self.low = self.low.min(value);
            self.high = self.high.max(value);
            self.sum += value;
            self.count += 1;
        }
    }

    /// Minimum, mean and maximum; `None` without samples.
    pub fn range(&self) -> Option<[f64; 3]> {
        (self.count > 0).then(|| [self.low, self.sum / self.count as f64, self.high])
    }
}

impl Bin for Extremes {
    fn merge(&mut self, later: &Extremes) {
        self.low = self.low.min(later.low);
        self.high = self.high.max(later.high);
        self.sum += later.sum;
        self.count += later.count;
    }
}

/// The newest value of a bin.
impl<T: Copy> Bin for Option<T> {
    fn merge(&mut self, later: &Option<T>) {
        *self = later.or(*self);
    }
}

/// A count of events in a bin.
impl Bin for u64 {
    fn merge(&mut self, later: &u64) {
        *self += later;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_double_and_lose_nothing() {
        let mut line = Timeline::new(8, 10, Extremes::EMPTY);
        let mut count = Timeline::new(8, 10, 0u64);
        let mut newest = Timeline::new(8, 10, None);
        for i in 0..1000u64 {
            line.bin(i).add((i as f64 - 500.0).powi(2));
            *count.bin(i) += 1;
            *newest.bin(i) = Some(i);
        }
        line.bin(3).add(f64::NAN);
        // 10 * 2^4 * 8 >= 1000: bins of 160 ns.
        let counts: Vec<u64> = count.iter().map(|(_, n)| *n).collect();
        assert_eq!(counts, [160, 160, 160, 160, 160, 160, 40]);
        let last: Vec<u64> = newest.iter().filter_map(|(_, n)| *n).collect();
        assert_eq!(last, [159, 319, 479, 639, 799, 959, 999]);
        let ranges: Vec<[f64; 3]> = line.iter().filter_map(|(_, bin)| bin.range()).collect();
        assert_eq!((ranges[3][0], ranges[3][2], ranges[0][2]), (0.0, 139.0f64.powi(2), 250_000.0));
        // Mean of (i - 500)^2 over i = 0..160: the sum of squares of 341 to 500 over 160.
        let sum = |n: f64| n * (n + 1.0) * (2.0 * n + 1.0) / 6.0;
        assert!((ranges[0][1] - (sum(500.0) - sum(340.0)) / 160.0).abs() < 1e-6);
        assert!((line.iter().nth(1).unwrap().0 - 240e-9).abs() < 1e-18, "the middle of the second bin");
    }
}
