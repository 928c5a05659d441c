//! Sampling and arrival times of a sensor's readings.

use scene::Sensor;

/// Tolerance, in ticks, within which a sample is due, so that rounding of the rate does not move it to the
/// next tick.
const ROUNDING_TICKS: f64 = 1e-6;

/// Rate, delay and jitter of a sensor, in ticks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Timing {
    period_ticks: f64,
    delay_ticks: f64,
    jitter_ticks: f64,
}

impl Timing {
    pub fn new(sensor: &Sensor, dt_s: f64) -> Timing {
        let ticks = |ms: f64| ms * 1e-3 / dt_s;
        Timing {
            period_ticks: 1.0 / (sensor.rate_hz * dt_s),
            delay_ticks: ticks(sensor.delay_ms),
            jitter_ticks: ticks(sensor.jitter_ms),
        }
    }

    /// Returns true if a sample is due: sample n at the first tick at or after n periods.
    pub fn is_due(&self, tick: u64) -> bool {
        let number = libm::floor((tick as f64 + ROUNDING_TICKS) / self.period_ticks);
        libm::ceil(number * self.period_ticks - ROUNDING_TICKS) == tick as f64
    }

    /// Tick at which a sample's reading arrives; `share` is the fraction of the maximum jitter, 0 to 1.
    pub fn arrival(&self, sample_tick: u64, share: f64) -> u64 {
        let later = libm::round(self.delay_ticks + self.jitter_ticks * share);
        sample_tick.saturating_add(later as u64)
    }

    /// Time between two samples, s.
    pub fn period_s(&self, dt_s: f64) -> f64 {
        self.period_ticks * dt_s
    }
}
