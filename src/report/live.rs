//! The progress line of a run.

use ipc_types::messages::TickTiming;
use serde::Serialize;

use super::ReportError;
use super::distribution::{Distribution, Quantiles};

/// Timing of the ticks since the last progress line. Pure: no clock, no output.
#[derive(Debug, Clone)]
pub struct LiveStats {
    step: Distribution,
    lateness: Distribution,
    missed: u64,
}

/// Timing of one interval.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct LiveInterval {
    /// Time of the physics step, µs; `None` without a tick.
    pub step_us: Option<Quantiles>,
    /// How late ticks began, µs; `None` without a tick.
    pub lateness_us: Option<Quantiles>,
    /// Ticks that began more than a period late.
    #[serde(rename = "missed_in_interval")]
    pub missed: u64,
}

impl LiveStats {
    /// Creates an empty interval.
    pub fn new() -> Result<LiveStats, ReportError> {
        let duration = Distribution::new(3)?;
        Ok(LiveStats { step: duration.clone(), lateness: duration, missed: 0 })
    }

    /// Adds a tick.
    pub fn add(&mut self, timing: &TickTiming) {
        self.step.add(timing.step_ns);
        self.lateness.add(timing.wake_lateness_ns.max(0) as u64);
        self.missed += u64::from(timing.missed != 0);
    }

    /// Returns the interval so far and starts a new one.
    pub fn take(&mut self) -> LiveInterval {
        let (step_us, lateness_us) = (self.step.quantiles(1e3), self.lateness.quantiles(1e3));
        self.step.clear();
        self.lateness.clear();
        LiveInterval { step_us, lateness_us, missed: std::mem::take(&mut self.missed) }
    }
}

/// Progress of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct LiveSnapshot {
    /// Simulated time.
    pub sim_time_s: f64,
    /// Simulated over wall time in the last interval.
    pub real_time_factor: f64,
    /// `State.t_world_tip.position_m`.
    pub tip_position_m: [f64; 3],
    /// Tension of tendon 0.
    pub tension_n: f64,
    /// `State.removed_total`.
    pub removed_total: u64,
    /// Timing of the last interval.
    #[serde(flatten)]
    pub interval: LiveInterval,
    /// Frames per second of wall time in the last interval; `None` without DRR.
    pub drr_rate_hz: Option<f64>,
    /// Missed ticks since the start; `None` in lockstep.
    pub missed_ticks: Option<u64>,
}

/// Formats the progress line, shorter than 160 columns.
pub fn progress_line(live: &LiveSnapshot) -> String {
    let [x, y, z] = live.tip_position_m.map(|metres| fixed(metres * 1e3, 7, 2));
    let microseconds =
        |q: Option<Quantiles>, of: fn(&Quantiles) -> f64| fixed(q.map_or(f64::NAN, |q| of(&q)), 5, 0);
    let interval = &live.interval;
    let mut line = format!(
        "{} s  x{}  tip {x} {y} {z} mm  {} N  {} voxels  step p50 {} p99 {} us",
        fixed(live.sim_time_s, 8, 2),
        fixed(live.real_time_factor, 5, 2),
        fixed(live.tension_n, 6, 2),
        fixed(live.removed_total as f64, 7, 0),
        microseconds(interval.step_us, |q| q.p50),
        microseconds(interval.step_us, |q| q.p99),
    );
    if let Some(missed) = live.missed_ticks {
        let late = microseconds(interval.lateness_us, |q| q.p99);
        line += &format!("  late p99 {late} us  missed {}", fixed(missed as f64, 1, 0));
    }
    if let Some(rate_hz) = live.drr_rate_hz {
        line += &format!("  DRR {}/s", fixed(rate_hz, 4, 1));
    }
    line
}

/// Formats a number in `width` to max(6, `width`) columns. A number that does not fit is written with an
/// exponent, a non-finite one as a dash.
fn fixed(value: f64, width: usize, decimals: usize) -> String {
    if !value.is_finite() {
        return format!("{:>width$}", "-");
    }
    let plain = format!("{value:width$.decimals$}");
    if plain.len() <= width.max(6) { plain } else { format!("{value:width$.0e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_stays_below_160_columns() {
        let quantiles = |v: f64| Some(Quantiles { count: 1, p50: v, p90: v, p99: v, p99_9: v, max: v });
        for value in
            [0.0, -12.345, 1e-9, 3599.999, -99999.9, 123456.7, f64::NAN, f64::NEG_INFINITY, -1.79e308]
        {
            let live = LiveSnapshot {
                sim_time_s: value,
                real_time_factor: value,
                tip_position_m: [value; 3],
                tension_n: value,
                removed_total: u64::MAX,
                interval: LiveInterval {
                    step_us: quantiles(value),
                    lateness_us: quantiles(value),
                    missed: 9,
                },
                drr_rate_hz: Some(value),
                missed_ticks: Some(u64::MAX),
            };
            let line = progress_line(&live);
            assert!(line.chars().count() < 160 && !line.contains('\n'), "{} {line}", line.len());
        }
        let empty = progress_line(&LiveSnapshot::default());
        assert!(empty.contains("step p50     - p99     - us"), "{empty}");
    }
}
