//! Axes: map values to fractions of a length, with round ticks.

use super::shapes::{TextSize, text_width};

/// Tick positions within a decade.
const DIGITS: [f64; 9] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];

/// An axis with its ticks.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// What the axis shows, with the unit.
    pub title: String,
    /// Labelled ticks: value and label.
    pub ticks: Vec<(f64, String)>,
    /// Ticks that are labelled if there is room: value and label.
    pub fine: Vec<(f64, String)>,
    /// Ticks without a label.
    pub minor: Vec<f64>,
    low: f64,
    high: f64,
    logarithmic: bool,
}

impl Axis {
    /// Creates a linear axis from `low` to `high` with about `count` labelled ticks at most. An empty or
    /// non-finite range is replaced by one of width 1.
    pub fn linear(title: &str, low: f64, high: f64, count: usize) -> Axis {
        let (low, high) = widened(low, high);
        let step = round_step((high - low) / count.max(1) as f64);
        let decimals = (-step.log10().floor()).max(0.0) as usize;
        let label = |value: f64| match step {
            1e-4..1e6 => format!("{value:.decimals$}"),
            _ => format!("{value:.1e}"),
        };
        let (first, last) = ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
        let ticks = (first..=last).map(|i| i as f64 * step);
        let ticks = ticks.map(|value| (value, label(value))).collect();
        Axis {
            title: title.to_string(),
            ticks,
            fine: Vec::new(),
            minor: Vec::new(),
            low,
            high,
            logarithmic: false,
        }
    }

    /// Creates a linear axis around the values with a margin of 6 %, starting at 0 if no value is negative.
    pub fn around(title: &str, values: impl Iterator<Item = f64>, count: usize) -> Axis {
        let (low, high) = bounds(values).unwrap_or((0.0, 1.0));
        let margin = 0.06 * (high - low.min(0.0)).max(1e-9);
        Axis::linear(title, if low < 0.0 { low - margin } else { 0.0 }, high + margin, count)
    }

    /// Creates a linear axis over the values, with this share of their range as margin on both sides.
    pub fn over(title: &str, values: impl Iterator<Item = f64>, share: f64, count: usize) -> Axis {
        let (low, high) = bounds(values).unwrap_or((0.0, 1.0));
        let margin = share * (high - low).max(1e-12);
        Axis::linear(title, low - margin, high + margin, count)
    }

    /// Creates a logarithmic axis from slightly below the smallest to slightly above the largest positive
    /// value; `label` formats a tick. Ticks are powers of ten and, if there is room, two and five times
    /// these.
    pub fn logarithmic(title: &str, values: impl Iterator<Item = f64>, label: fn(f64) -> String) -> Axis {
        let (low, high) = bounds(values.filter(|&value| value > 0.0)).unwrap_or((1.0, 100.0));
        let (low, high) = (low.log10() - 0.15, high.log10() + 0.15);
        let decades = low.floor() as i32..=high.ceil() as i32;
        let (mut ticks, mut fine, mut minor) = (Vec::new(), Vec::new(), Vec::new());
        for (n, digit) in decades.flat_map(|n| DIGITS.map(|digit| (n, digit))) {
            let value = digit * 10f64.powi(n);
            if value.log10() < low || value.log10() > high {
                continue;
            }
            match digit {
                1.0 => ticks.push((value, label(value))),
                2.0 | 5.0 => fine.push((value, label(value))),
                _ => minor.push(value),
            }
        }
        Axis { title: title.to_string(), ticks, fine, minor, low, high, logarithmic: true }
    }

    /// Removes ticks for which `keep` does not hold.
    pub fn retain(&mut self, keep: impl Fn(f64) -> bool) {
        self.ticks.retain(|(value, _)| keep(*value));
        self.fine.retain(|(value, _)| keep(*value));
        self.minor.retain(|value| keep(*value));
    }

    /// Returns the axis for `length` figure units with as many labels as fit: ticks and fine ticks, only
    /// ticks, every second tick, and so on. `extent` returns the length that a label takes.
    pub fn labelled(mut self, length: f64, extent: fn(&str) -> f64) -> Axis {
        let mut all = [self.ticks.clone(), std::mem::take(&mut self.fine)].concat();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let fit = |ticks: &[(f64, String)]| {
            ticks.windows(2).all(|pair| {
                let room = (self.share(pair[1].0) - self.share(pair[0].0)) * length;
                0.5 * (extent(&pair[0].1) + extent(&pair[1].1)) <= room
            })
        };
        let thinned = |every: usize| self.ticks.iter().step_by(every).cloned().collect::<Vec<_>>();
        let tries = std::iter::once(all.clone()).chain((1..=self.ticks.len().max(1)).map(thinned));
        let shown = tries.into_iter().find(|ticks| fit(ticks)).unwrap_or_default();
        let unlabelled = all.iter().map(|(value, _)| *value);
        let minor: Vec<f64> = unlabelled.filter(|value| shown.iter().all(|(own, _)| own != value)).collect();
        self.minor.extend(minor);
        self.ticks = shown;
        self
    }

    /// Returns the length that a label takes on a horizontal axis.
    pub fn beside(label: &str) -> f64 {
        text_width(label, TextSize::Label) + 10.0
    }

    /// Returns the length that a label takes on a vertical axis.
    pub fn above(_label: &str) -> f64 {
        TextSize::Label.units() + 2.0
    }

    /// Returns the position of a value as a fraction of the length: 0 at the low end, 1 at the high end,
    /// beyond that outside. A value that a logarithmic axis cannot show maps to its low end.
    pub fn share(&self, value: f64) -> f64 {
        let value = if !self.logarithmic {
            value
        } else if value > 0.0 {
            value.log10()
        } else {
            self.low
        };
        (value - self.low) / (self.high - self.low)
    }
}

/// Returns the smallest and largest finite value.
pub fn bounds(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let start = (f64::INFINITY, f64::NEG_INFINITY);
    let (low, high) =
        values.filter(|v| v.is_finite()).fold(start, |(low, high), v| (low.min(v), high.max(v)));
    (low <= high).then_some((low, high))
}

fn widened(low: f64, high: f64) -> (f64, f64) {
    if !(low.is_finite() && high.is_finite()) || low > high {
        return (0.0, 1.0);
    }
    // On a narrower range, neighbouring tick labels would read the same.
    if high - low > 1e-9 * low.abs().max(high.abs()).max(1e-3) {
        (low, high)
    } else {
        (low - 0.5, high + 0.5)
    }
}

/// Returns the smallest of 1, 2, 5 times a power of ten that is not below `step`.
fn round_step(step: f64) -> f64 {
    let power = 10f64.powf(step.log10().floor());
    [1.0, 2.0, 5.0]
        .map(|digit| digit * power)
        .into_iter()
        .find(|s| *s >= step * (1.0 - 1e-9))
        .unwrap_or(10.0 * power)
}

/// Formats a duration in microseconds with a suitable unit.
pub fn duration_label(microseconds: f64) -> String {
    let (value, unit) = if microseconds < 1.0 {
        (microseconds * 1e3, "ns")
    } else if microseconds < 1e3 {
        (microseconds, "µs")
    } else if microseconds < 1e6 {
        (microseconds * 1e-3, "ms")
    } else {
        (microseconds * 1e-6, "s")
    };
    let decimals = if value >= 100.0 || (value - value.round()).abs() < 1e-9 { 0 } else { 1 };
    format!("{value:.decimals$} {unit}")
}

/// Formats a whole number.
pub fn count_label(value: f64) -> String {
    format!("{value:.0}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<&str> {
        axis.ticks.iter().map(|(_, label)| label.as_str()).collect()
    }

    #[test]
    fn ticks_are_round() {
        assert_eq!(labels(&Axis::linear("", 0.0, 5.0, 5)), ["0", "1", "2", "3", "4", "5"]);
        assert_eq!(labels(&Axis::linear("", -0.31, 0.32, 4)), ["-0.2", "0.0", "0.2"]);
        assert_eq!(labels(&Axis::linear("", 3.0, 3.0, 4)), ["2.5", "3.0", "3.5"]);
        assert_eq!(labels(&Axis::linear("", 0.0, 3e200, 2)), ["0.0e0", "2.0e200"]);
        assert_eq!(labels(&Axis::linear("", f64::NAN, 1.0, 2)), ["0.0", "0.5", "1.0"]);
        let axis = Axis::logarithmic("", [0.0, f64::NAN, 30.0, 2000.0].into_iter(), duration_label);
        assert_eq!(labels(&axis), ["100 µs", "1 ms"]);
        // From 30 / 1.41 to 2000 * 1.41; the ticks are 100 and 1000.
        assert_eq!((axis.minor.len(), axis.fine.len()), (12, 4));
        assert!((axis.share(30.0) + axis.share(2000.0) - 1.0).abs() < 1e-12, "the same margin on both sides");
        assert_eq!(labels(&Axis::logarithmic("", [30.0].into_iter(), count_label)), [] as [&str; 0]);
        assert_eq!(axis.share(-1.0), 0.0);
    }

    #[test]
    fn labels_are_as_many_as_fit() {
        let axis = || Axis::logarithmic("", [1.0, 1e4].into_iter(), count_label);
        let wide = |label: &str| 10.0 * label.len() as f64;
        assert_eq!(labels(&axis().labelled(2000.0, wide)).len(), 13, "1, 2, 5 … 10,000");
        assert_eq!(labels(&axis().labelled(200.0, wide)), ["1", "10", "100", "1000", "10000"]);
        assert_eq!(labels(&axis().labelled(100.0, wide)), ["1", "100", "10000"]);
        assert_eq!(labels(&axis().labelled(1.0, wide)), ["1"]);
        assert_eq!(
            axis().labelled(100.0, wide).minor.len(),
            axis().minor.len() + 8 + 2,
            "the others stay as lines"
        );
    }

    #[test]
    fn durations_read_well() {
        assert_eq!(
            [0.05, 12.34, 999.9, 1500.0, 2e6].map(duration_label),
            ["50 ns", "12.3 µs", "1000 µs", "1.5 ms", "2 s"]
        );
    }
}
