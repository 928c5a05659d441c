//! Scenes with one sensor, and its readings of a signal.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail the test")]

use std::path::Path;

use messages::{Pose, SensorReading, State};
use scene::Scene;
use sensors::SensorArray;

/// A scene whose `[[sensor]]` has these keys; a tick is 1 ms.
pub fn scene(keys: &str) -> Scene {
    let text = format!(
        "name = \"t\"\n[run]\nmode = \"lockstep\"\nduration_s = 10.0\n[tool]\n\
         burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n[[sensor]]\nname = \"s\"\n{keys}\n"
    );
    Scene::parse(&text, Path::new("t.toml")).unwrap()
}

pub fn identity() -> Pose {
    Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] }
}

/// A state of two tendons with this tension on the first, and this flange force along x.
pub fn state(tick: u64, value: f64) -> State {
    let mut state = State { tick, tendon_count: 2, ..State::zeroed() };
    state.tendon_tension_n[0] = value;
    state.flange_wrench.force_n = [value, 0.0, 0.0];
    (state.t_world_base, state.t_world_burr, state.t_world_flange) = (identity(), identity(), identity());
    state
}

/// Readings of the scene's sensors for a signal of this many ticks.
pub fn read(scene: &Scene, ticks: u64, signal: impl Fn(u64) -> f64) -> Vec<SensorReading> {
    let mut sensors = SensorArray::new(scene);
    let mut all = Vec::new();
    for tick in 0..ticks {
        sensors.see(&state(tick, signal(tick)));
        all.extend_from_slice(sensors.readings());
    }
    all
}

/// The first value of each reading.
pub fn first(readings: &[SensorReading]) -> Vec<f64> {
    readings.iter().map(|reading| reading.value[0]).collect()
}

pub fn mean(x: &[f64]) -> f64 {
    x.iter().sum::<f64>() / x.len() as f64
}

pub fn deviation(x: &[f64]) -> f64 {
    let mean = mean(x);
    (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (x.len() - 1) as f64).sqrt()
}
