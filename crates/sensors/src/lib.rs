//! Sensors: simulated measurements of the tool, in place of the exact state.
//!
//! A reading is a function of the states up to its sample, its tick and the seeds of the run and the sensor:
//! noise, bias, jitter and drop-outs are counter-based random numbers; drift and the low-pass filter are kept
//! in [`SensorArrayState`]. [`SensorArray::see`] takes every state, in order; [`SensorArray::readings`] then
//! lists the readings that arrive with it.
//!
//! [`MeasuredState`] is the receiving end: it replaces a state's exact values by readings, for controllers.
//!
//! **Boundary:** states in, readings out. It only computes. **Invariants:** readings of a sensor arrive in
//! the order of their samples; at most [`scene::MAX_READINGS_UNDERWAY`] of them are pending; a step allocates
//! nothing.
//!
//! ```
//! use std::path::Path;
//!
//! use messages::State;
//! use scene::Scene;
//! use sensors::SensorArray;
//!
//! let text = r#"
//! name = "measured"
//! [run]
//! mode = "lockstep"
//! duration_s = 1.0
//! [tool]
//! burr_start_mm = [0.0, 0.0, 0.0]
//! direction = [1.0, 0.0, 0.0]
//! bend_toward = [0.0, 0.0, 1.0]
//! [[sensor]]
//! name = "tension"
//! rate_hz = 100.0
//! delay_ms = 5.0
//! load_cell = { noise_n = 0.0 }
//! "#;
//! let scene = Scene::parse(text, Path::new("measured.toml")).unwrap();
//! let mut sensors = SensorArray::new(&scene);
//! let mut state = State { tendon_count: 2, tendon_tension_n: [3.0, 0.0, 0.0, 0.0], ..State::zeroed() };
//! let mut arrived = Vec::new();
//! for tick in 0..=15 {
//!     state.tick = tick;
//!     sensors.see(&state);
//!     let readings = sensors.readings().iter();
//!     arrived.extend(readings.map(|reading| (reading.tick, reading.sample_tick, reading.value[0])));
//! }
//! assert_eq!(arrived, [(5, 0, 3.0), (15, 10, 3.0)]);
//! ```

mod device;
mod fibre;
mod measure;
mod measured_state;
mod timing;

use messages::{SensorKind, SensorReading, State};
use scene::{MAX_READINGS_UNDERWAY, MAX_STRUCTURES, Scene};
use serde::{Deserialize, Serialize};

use device::{Device, DeviceState};
pub use fibre::{Fibre, node_curvatures, node_places, t_world_tube};
pub use measured_state::MeasuredState;

/// The sensors of a scene, in its order.
#[derive(Debug, Clone)]
pub struct SensorArray {
    devices: Vec<Device>,
    clock: Clock,
    /// Number of critical structures whose clearances are the last reading of each tick.
    structures: usize,
    clearance: SensorReading,
    arrived: Vec<SensorReading>,
}

/// State of a [`SensorArray`] between ticks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SensorArrayState {
    devices: Vec<DeviceState>,
    clock: Clock,
}

/// Progress of the sensors.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
struct Clock {
    /// `State.tick` of the last state seen; `None` before the first.
    tick: Option<u64>,
    /// Readings that arrived before that state.
    sent: u64,
}

impl Default for SensorArray {
    fn default() -> SensorArray {
        SensorArray {
            devices: Vec::new(),
            clock: Clock::default(),
            structures: 0,
            clearance: SensorReading::zeroed(),
            arrived: Vec::new(),
        }
    }
}

impl SensorArray {
    /// Creates the sensors of a scene; empty if the scene has none.
    pub fn new(scene: &Scene) -> SensorArray {
        let devices: Vec<Device> = (0..)
            .zip(&scene.sensor)
            .map(|(index, sensor)| Device::new(index, sensor, scene.run.seed, scene.dt_s()))
            .collect();
        // After a long jitter, all pending readings can arrive at once.
        let most = devices.len() * (MAX_READINGS_UNDERWAY + 2) + 1;
        let structures = scene.structure.len().min(MAX_STRUCTURES);
        let clearance = SensorReading {
            sensor_index: devices.len() as u32,
            kind: SensorKind::Clearance.code(),
            valid: 1,
            value_count: 2 * structures as u32,
            ..SensorReading::zeroed()
        };
        let arrived = Vec::with_capacity(most);
        SensorArray { devices, clock: Clock::default(), structures, clearance, arrived }
    }

    /// Sets the clearances that [`SensorArray::see`] lists with the next state: for each structure the
    /// distance, m, and the index of the tool's sphere that is closest.
    pub fn set_clearances(&mut self, clearances: impl Iterator<Item = (f64, usize)>) {
        let values = self.clearance.value.chunks_exact_mut(2).take(self.structures);
        for (value, (distance_m, sphere)) in values.zip(clearances) {
            value.copy_from_slice(&[distance_m, sphere as f64]);
        }
    }

    /// Takes the next state: samples the sensors that are due and lists the readings that arrive.
    pub fn see(&mut self, state: &State) {
        let last = self.clock.tick.replace(state.tick);
        self.clock.sent += self.arrived.len() as u64;
        for device in &mut self.devices {
            device.forget_arrived(last);
            device.see(state);
        }
        self.list();
    }

    /// Lists the readings that arrive with the last state seen.
    fn list(&mut self) {
        self.arrived.clear();
        let Some(tick) = self.clock.tick else { return };
        for mut reading in self.devices.iter().flat_map(|device| device.arrived(tick)) {
            reading.sequence = self.clock.sent + self.arrived.len() as u64 + 1;
            self.arrived.push(reading);
        }
        if self.structures > 0 {
            let sequence = self.clock.sent + self.arrived.len() as u64 + 1;
            self.arrived.push(SensorReading { tick, sample_tick: tick, sequence, ..self.clearance });
        }
    }

    /// Returns true if there are neither sensors nor structures.
    pub fn is_empty(&self) -> bool {
        self.devices.is_empty() && self.structures == 0
    }

    /// Readings that arrive with the last state, ordered by sensor.
    pub fn readings(&self) -> &[SensorReading] {
        &self.arrived
    }

    /// Returns the state between ticks.
    pub fn state(&self) -> SensorArrayState {
        let devices = self.devices.iter().map(|device| device.state.clone()).collect();
        SensorArrayState { devices, clock: self.clock }
    }

    /// Serialises the state between ticks: the same as [`SensorArray::state`], without a copy.
    pub fn serialised(&self) -> impl Serialize + '_ {
        Kept { devices: Borrowed(&self.devices), clock: self.clock }
    }

    /// Returns true if a state belongs to sensors like these.
    pub fn fits(&self, state: &SensorArrayState) -> bool {
        self.devices.len() == state.devices.len()
            && self.devices.iter().zip(&state.devices).all(|(device, state)| device.fits(state))
    }

    /// Resumes from a state that [`SensorArray::fits`].
    pub fn restore(&mut self, state: &SensorArrayState) {
        for (device, saved) in self.devices.iter_mut().zip(&state.devices) {
            device.state.clone_from(saved);
        }
        self.clock = state.clock;
        self.list();
    }

    /// Restarts at the present tick: resets filters and drift and drops pending readings. Sequence numbers
    /// continue.
    pub fn reset(&mut self) {
        self.devices.iter_mut().for_each(Device::reset);
        self.clock.sent += self.arrived.len() as u64;
        self.arrived.clear();
    }
}

/// Serialises to the same bytes as [`SensorArrayState`].
#[derive(Serialize)]
struct Kept<'a> {
    devices: Borrowed<'a>,
    clock: Clock,
}

struct Borrowed<'a>(&'a [Device]);

impl Serialize for Borrowed<'_> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(|device| &device.state))
    }
}
