//! One sensor: its samples, errors and pending readings.

use std::collections::VecDeque;

use counter_random::Key;
use messages::{MAX_SENSOR_VALUES, SensorReading, State};
use scene::{MAX_READINGS_UNDERWAY, Sensor};
use serde::{Deserialize, Serialize};

use crate::measure::{Measure, Sample};
use crate::timing::Timing;

/// Replaces the tick as counter for values drawn once per run.
const ONCE: u64 = u64::MAX;
/// Counters of a sample's random words. A normal deviate takes two, so noise uses 0 to 63 and drift 64 to
/// 127.
const DRIFT: u64 = 32;
const JITTER: u64 = 128;
const DROPOUT: u64 = 129;

/// A sensor and its state.
#[derive(Debug, Clone)]
pub(crate) struct Device {
    index: u32,
    measure: Measure,
    timing: Timing,
    dropout: f64,
    key: Key,
    dt_s: f64,
    pub state: DeviceState,
}

/// State of a sensor between ticks.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct DeviceState {
    /// Random walk of each value.
    drift: Vec<f64>,
    /// Output of the low-pass filter; `None` before the first state.
    filtered: Option<Vec<f64>>,
    underway: VecDeque<PendingReading>,
    /// Tick at which the last sample arrives.
    last_arrival: u64,
}

/// A sample that had not arrived by the previous state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct PendingReading {
    arrival: u64,
    sample_tick: u64,
    is_valid: bool,
    count: u32,
    value: [f64; MAX_SENSOR_VALUES],
}

impl Device {
    pub fn new(index: u32, sensor: &Sensor, run_seed: u64, dt_s: f64) -> Device {
        let measure = Measure::new(sensor, dt_s);
        let state = DeviceState {
            drift: vec![0.0; measure.drifts()],
            filtered: None,
            underway: VecDeque::with_capacity(MAX_READINGS_UNDERWAY + 2),
            last_arrival: 0,
        };
        let key = Key::of(run_seed).and(sensor.seed).and(u64::from(index));
        Device {
            index,
            timing: Timing::new(sensor, dt_s),
            dropout: sensor.dropout,
            measure,
            key,
            dt_s,
            state,
        }
    }

    pub fn fits(&self, state: &DeviceState) -> bool {
        let filtered = state.filtered.as_ref().is_none_or(|filtered| filtered.len() == MAX_SENSOR_VALUES);
        state.drift.len() == self.measure.drifts()
            && filtered
            && state.underway.len() <= MAX_READINGS_UNDERWAY + 2
            && state.underway.iter().all(|sample| sample.count as usize <= MAX_SENSOR_VALUES)
    }

    /// Resets to the start of a run.
    pub fn reset(&mut self) {
        self.state.drift.fill(0.0);
        self.state.filtered = None;
        self.state.underway.clear();
        self.state.last_arrival = 0;
    }

    /// Takes a state: updates the filter, and samples if a sample is due.
    pub fn see(&mut self, state: &State) {
        let share = self.measure.low_pass_share();
        let is_due = self.timing.is_due(state.tick);
        if !is_due && share.is_none() {
            return;
        }
        let mut sample = self.measure.exact(state);
        if let Some(share) = share {
            self.filter(&mut sample, share);
        }
        if is_due {
            self.sample(state.tick, sample);
        }
    }

    /// Applies a first-order low-pass filter: y += (1 − e^(−2π f dt)) (x − y), exact for an input that is
    /// constant within a tick.
    fn filter(&mut self, sample: &mut Sample, share: f64) {
        match &mut self.state.filtered {
            Some(filtered) => {
                for (y, x) in filtered.iter_mut().zip(&sample.value) {
                    *y += share * (x - *y);
                }
                sample.value.copy_from_slice(filtered);
            }
            // The only allocation of a sensor, at its first state.
            none => *none = Some(sample.value.to_vec()),
        }
    }

    fn sample(&mut self, tick: u64, mut sample: Sample) {
        let now = self.key.and(tick);
        let root_s = libm::sqrt(self.timing.period_s(self.dt_s));
        for (channel, drift) in (0..).zip(&mut self.state.drift) {
            *drift += self.measure.drift_per_root_s(channel) * root_s * now.normal(DRIFT + channel as u64);
        }
        let once = self.key.and(ONCE);
        let noise = |channel: usize| now.normal(channel as u64);
        let bias = |channel: usize| once.normal(channel as u64);
        self.measure.add_errors(&mut sample, &noise, &bias, &self.state.drift);
        let is_valid = sample.is_seen && now.uniform(DROPOUT) >= self.dropout;
        let arrival = self.timing.arrival(tick, now.uniform(JITTER)).max(self.state.last_arrival);
        self.state.last_arrival = arrival;
        let value = if is_valid { sample.value } else { [0.0; MAX_SENSOR_VALUES] };
        let underway = PendingReading { arrival, sample_tick: tick, is_valid, count: sample.count, value };
        self.state.underway.push_back(underway);
    }

    /// Returns the readings that have arrived by this tick, without sequence numbers.
    pub fn arrived(&self, tick: u64) -> impl Iterator<Item = SensorReading> + '_ {
        let arrived = self.state.underway.iter().take_while(move |sample| sample.arrival <= tick);
        arrived.map(move |sample| SensorReading {
            tick,
            sample_tick: sample.sample_tick,
            sequence: 0,
            sensor_index: self.index,
            kind: self.measure.kind().code(),
            valid: u32::from(sample.is_valid),
            value_count: sample.count,
            value: sample.value,
        })
    }

    /// Drops readings that had arrived by the last state.
    pub fn forget_arrived(&mut self, last: Option<u64>) {
        let Some(last) = last else { return };
        while self.state.underway.front().is_some_and(|sample| sample.arrival <= last) {
            self.state.underway.pop_front();
        }
    }
}
