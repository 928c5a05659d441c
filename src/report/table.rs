//! The live table of a run on a terminal, and its JSON line for scripts.

use std::collections::VecDeque;

use serde_json::{Value, json};

use super::live::{LiveSnapshot, progress_line};
use crate::say::merged;

/// Number of values in a sparkline.
const WIDTH: usize = 48;
const BARS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// The latest values that the table draws as sparklines.
#[derive(Debug, Clone, Default)]
pub struct History {
    step_us: VecDeque<f64>,
    late_us: VecDeque<f64>,
}

impl History {
    /// Adds an interval.
    pub fn add(&mut self, live: &LiveSnapshot) {
        let interval = &live.interval;
        for (values, quantiles) in
            [(&mut self.step_us, interval.step_us), (&mut self.late_us, interval.lateness_us)]
        {
            values.extend(quantiles.map(|q| q.p99));
            while values.len() > WIDTH {
                values.pop_front();
            }
        }
    }

    /// The table's lines: the progress line, then a sparkline of each interval's p99 with its range.
    pub fn table(&self, live: &LiveSnapshot) -> Vec<String> {
        let mut lines = vec![progress_line(live)];
        let latency = live.missed_ticks.map(|_| ("latency p99", &self.late_us));
        for (name, values) in core::iter::once(("step    p99", &self.step_us)).chain(latency) {
            let Some((low, high)) = figures::bounds(values.iter().copied()) else { continue };
            lines.push(format!(
                "  {name}  {:<WIDTH$}  {low:.0} to {high:.0} us",
                sparkline(values, low, high)
            ));
        }
        lines
    }
}

/// Draws the values with eight heights between `low` and `high`.
fn sparkline(values: &VecDeque<f64>, low: f64, high: f64) -> String {
    let height = |value: &f64| {
        let share = if high > low { (value - low) / (high - low) } else { 0.0 };
        BARS[((share * 7.0).round().clamp(0.0, 7.0)) as usize]
    };
    values.iter().map(height).collect()
}

/// One line of JSON.
pub fn json_line(live: &LiveSnapshot, phase: &str) -> Value {
    merged(json!({"phase": phase}), json!(live))
}

#[cfg(test)]
mod tests {
    use super::super::distribution::Quantiles;
    use super::super::live::LiveInterval;
    use super::*;

    fn live(step_us: f64, late_us: f64) -> LiveSnapshot {
        let quantiles = |v: f64| Some(Quantiles { count: 1, p50: v, p90: v, p99: v, p99_9: v, max: v });
        let interval =
            LiveInterval { step_us: quantiles(step_us), lateness_us: quantiles(late_us), missed: 0 };
        LiveSnapshot { interval, missed_ticks: Some(0), ..LiveSnapshot::default() }
    }

    #[test]
    fn sparklines_span_their_range_and_forget_the_oldest() {
        let mut history = History::default();
        history.add(&live(1e6, 0.0));
        for i in 0..WIDTH {
            history.add(&live(i as f64, 5.0));
        }
        let table = history.table(&live(0.0, 0.0));
        assert_eq!(table.len(), 3);
        let drawn: Vec<char> = table[1].chars().filter(|c| BARS.contains(c)).collect();
        assert_eq!((drawn.len(), drawn[0], drawn[WIDTH - 1]), (WIDTH, '▁', '█'));
        assert!(drawn.is_sorted() && table[1].ends_with("0 to 47 us"), "{}", table[1]);
        assert!(table[2].contains("▁▁▁"), "what does not change is flat: {}", table[2]);
        assert!(table.iter().all(|line| line.chars().count() < 160));
    }

    #[test]
    fn lines_for_scripts_are_json() {
        let text = json_line(&live(3.0, 4.0), "running").to_string();
        let value: Value = serde_json::from_str(&text).unwrap();
        assert_eq!((&value["phase"], &value["step_us"]["p99"]), (&json!("running"), &json!(3.0)));
        assert!(!text.contains('\n'));
        let empty =
            json_line(&LiveSnapshot { real_time_factor: f64::NAN, ..LiveSnapshot::default() }, "paused");
        assert!(empty["real_time_factor"].is_null() && empty["step_us"].is_null());
    }
}
