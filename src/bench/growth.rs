//! Memory of each process over a long run: at its start, in its middle, at its end, and how fast it grows.

use std::collections::BTreeMap;
use std::time::Duration;

/// Share of the run after which a process counts as started: caches are filled, every path has been gone.
const STARTED_SHARE: f64 = 0.1;

/// A process's own memory over the run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Curve(Vec<(f64, u64)>);

/// Own memory of all processes, by name.
#[derive(Debug, Clone, Default)]
pub struct Growth(BTreeMap<String, Curve>);

/// What a curve comes to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Course {
    /// After a tenth of the run, in its middle, at its end; bytes.
    pub bytes: [u64; 3],
    /// Slope of the straight line by least squares from the first of them on.
    pub bytes_per_minute: f64,
}

impl Growth {
    /// Takes in what a process has at a time of the run.
    pub fn add(&mut self, name: &str, at: Duration, bytes: u64) {
        self.0.entry(name.to_owned()).or_default().0.push((at.as_secs_f64() / 60.0, bytes));
    }

    /// The processes, by name, that have lived longer than a tenth of the run.
    pub fn courses(&self) -> impl Iterator<Item = (&str, Course)> {
        self.0.iter().filter_map(|(name, curve)| Some((name.as_str(), curve.course()?)))
    }
}

impl Curve {
    fn course(&self) -> Option<Course> {
        let last_min = self.0.last()?.0;
        let settled: Vec<(f64, u64)> =
            self.0.iter().copied().filter(|(minute, _)| *minute >= STARTED_SHARE * last_min).collect();
        let bytes =
            [settled.first()?, settled.get(settled.len() / 2)?, settled.last()?].map(|(_, bytes)| *bytes);
        let mean =
            |of: &dyn Fn(&(f64, u64)) -> f64| settled.iter().map(of).sum::<f64>() / settled.len() as f64;
        let (middle_min, middle_bytes) = (mean(&|(minute, _)| *minute), mean(&|(_, bytes)| *bytes as f64));
        let spread = mean(&|(minute, _)| (minute - middle_min).powi(2));
        let common = mean(&|(minute, bytes)| (minute - middle_min) * (*bytes as f64 - middle_bytes));
        Some(Course { bytes, bytes_per_minute: if spread > 0.0 { common / spread } else { 0.0 } })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn course(of: impl Fn(u64) -> u64) -> Course {
        let mut growth = Growth::default();
        for second in 0..=600 {
            growth.add("part", Duration::from_secs(second), of(second));
        }
        growth.courses().next().unwrap().1
    }

    #[test]
    fn a_start_is_no_growth() {
        let flat = course(|second| if second < 50 { 1000 * second } else { 50_000 });
        assert_eq!(flat, Course { bytes: [50_000; 3], bytes_per_minute: 0.0 });
    }

    #[test]
    fn a_steady_growth_is_its_slope() {
        let grown = course(|second| 1_000_000 + 500 * second);
        // 500 bytes a second; f64 sums of 541 samples of 1e6 bytes leave about 1e-9 of it.
        assert!((grown.bytes_per_minute - 30_000.0).abs() < 1e-3, "{grown:?}");
        assert_eq!(grown.bytes, [1_030_000, 1_165_000, 1_300_000]);
    }

    #[test]
    fn a_single_sample_has_no_slope() {
        let mut growth = Growth::default();
        growth.add("part", Duration::from_secs(3), 7);
        let courses: Vec<_> = growth.courses().collect();
        assert_eq!(courses, [("part", Course { bytes: [7; 3], bytes_per_minute: 0.0 })]);
    }
}
