//! Exact values and errors of each kind of sensor.

use messages::{MAX_ARM_JOINTS, MAX_SENSOR_VALUES, MAX_TENDONS, Pose, SensorKind, State};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use scene::{Encoders, Fbg, ForceTorque, LoadCell, Sensor, Tracked, Tracker};

use crate::fibre::node_curvatures;

/// Values of a pose: position, then quaternion x y z w.
const POSE_VALUES: u32 = 7;
/// Values of a wrench: force, then torque.
const WRENCH_VALUES: usize = 6;

/// Kind of sensor with its parameters, in SI units.
#[derive(Debug, Clone)]
pub(crate) enum Measure {
    Fbg(Fbg),
    Tracker(Tracker),
    Encoders(Encoders),
    LoadCell(LoadCell),
    ForceTorque(ForceTorque, Option<f64>),
}

/// The values of a sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sample {
    pub value: [f64; MAX_SENSOR_VALUES],
    pub count: u32,
    /// False if the tracker has lost its marker.
    pub is_seen: bool,
}

impl Sample {
    fn of(values: impl IntoIterator<Item = f64>) -> Sample {
        let mut sample = Sample { value: [0.0; MAX_SENSOR_VALUES], count: 0, is_seen: true };
        for (slot, value) in sample.value.iter_mut().zip(values) {
            *slot = value;
            sample.count += 1;
        }
        sample
    }
}

/// Random deviate of a channel (noise or bias), in standard deviations.
type Deviate<'a> = &'a dyn Fn(usize) -> f64;

impl Measure {
    pub fn new(sensor: &Sensor, dt_s: f64) -> Measure {
        match sensor {
            Sensor { fbg: Some(fbg), .. } => Measure::Fbg(fbg.clone()),
            Sensor { tracker: Some(tracker), .. } => Measure::Tracker(tracker.clone()),
            Sensor { encoders: Some(encoders), .. } => Measure::Encoders(encoders.clone()),
            Sensor { load_cell: Some(cell), .. } => Measure::LoadCell(cell.clone()),
            Sensor { force_torque, .. } => {
                // A validated scene has exactly one of the five.
                let wrench = force_torque.clone().unwrap_or(ForceTorque {
                    noise_n: 0.0,
                    noise_nm: 0.0,
                    drift_n: 0.0,
                    drift_nm: 0.0,
                    low_pass_hz: None,
                });
                let share = |hz: f64| 1.0 - libm::exp(-core::f64::consts::TAU * hz * dt_s);
                let low_pass = wrench.low_pass_hz.map(share);
                Measure::ForceTorque(wrench, low_pass)
            }
        }
    }

    pub fn kind(&self) -> SensorKind {
        match self {
            Measure::Fbg(_) => SensorKind::Fbg,
            Measure::Tracker(_) => SensorKind::Tracker,
            Measure::Encoders(_) => SensorKind::Encoders,
            Measure::LoadCell(_) => SensorKind::LoadCell,
            Measure::ForceTorque(..) => SensorKind::ForceTorque,
        }
    }

    /// Number of values that drift.
    pub fn drifts(&self) -> usize {
        if matches!(self, Measure::ForceTorque(..)) { WRENCH_VALUES } else { 0 }
    }

    /// Standard deviation of a value's random walk after one second.
    pub fn drift_per_root_s(&self, channel: usize) -> f64 {
        match self {
            Measure::ForceTorque(wrench, _) if channel < 3 => wrench.drift_n,
            Measure::ForceTorque(wrench, _) => wrench.drift_nm,
            _ => 0.0,
        }
    }

    /// Fraction of the distance to its input that the low-pass filter covers per tick.
    pub fn low_pass_share(&self) -> Option<f64> {
        match self {
            Measure::ForceTorque(_, share) => *share,
            _ => None,
        }
    }

    /// Returns the error-free measurement.
    pub fn exact(&self, state: &State) -> Sample {
        match self {
            Measure::Fbg(fbg) => Sample::of(node_curvatures(state, fbg.nodes, fbg.gauge_mm * 1e-3)),
            Measure::Tracker(tracker) => tracked(tracker, state),
            Measure::Encoders(_) => {
                let count = (state.arm_joint_count as usize).min(MAX_ARM_JOINTS);
                Sample::of(state.arm_joint_position_rad[..count].iter().copied())
            }
            Measure::LoadCell(_) => {
                let count = (state.tendon_count as usize).min(MAX_TENDONS);
                Sample::of(state.tendon_tension_n[..count].iter().copied())
            }
            Measure::ForceTorque(..) => {
                let to_base = rotation(&state.t_world_base).inverse();
                let force = to_base * Vector3::from(state.flange_wrench.force_n);
                let torque = to_base * Vector3::from(state.flange_wrench.torque_nm);
                Sample::of(force.iter().chain(torque.iter()).copied())
            }
        }
    }

    /// Adds noise, bias and drift, then rounds to the resolution.
    pub fn add_errors(&self, sample: &mut Sample, noise: Deviate<'_>, bias: Deviate<'_>, drift: &[f64]) {
        match self {
            Measure::Tracker(tracker) => add_pose_errors(tracker, sample, noise),
            Measure::Fbg(fbg) => {
                each(sample, |i, x| x + fbg.noise_per_m * noise(i) + fbg.bias_per_m * bias(i))
            }
            Measure::Encoders(encoders) => {
                let noise_rad = encoders.noise_deg.to_radians();
                each(sample, |i, x| rounded(x + noise_rad * noise(i), encoders.resolution_deg.to_radians()));
            }
            Measure::LoadCell(cell) => {
                let error_n = |i| cell.noise_n * noise(i) + cell.bias_n * bias(i);
                each(sample, |i, x| rounded(x + error_n(i), cell.resolution_n));
            }
            Measure::ForceTorque(wrench, _) => {
                let deviation = |i| if i < 3 { wrench.noise_n } else { wrench.noise_nm };
                each(sample, |i, x| x + deviation(i) * noise(i) + drift.get(i).copied().unwrap_or(0.0));
            }
        }
    }
}

fn each(sample: &mut Sample, change: impl Fn(usize, f64) -> f64) {
    for (i, x) in sample.value.iter_mut().enumerate().take(sample.count as usize) {
        *x = change(i, *x);
    }
}

/// Rounds to the nearest multiple of a step; no-op without a step or if the step is too fine for `f64`.
fn rounded(x: f64, step: f64) -> f64 {
    let steps = libm::round(x / step);
    if step > 0.0 && steps.is_finite() { steps * step } else { x }
}

pub(crate) fn rotation(pose: &Pose) -> UnitQuaternion<f64> {
    let [x, y, z, w] = pose.orientation_xyzw;
    UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
}

fn tracked(tracker: &Tracker, state: &State) -> Sample {
    let pose = match tracker.on {
        Tracked::Burr => &state.t_world_burr,
        Tracked::Base => &state.t_world_base,
        Tracked::Flange => &state.t_world_flange,
    };
    let mut sample = Sample::of(pose.position_m.into_iter().chain(pose.orientation_xyzw));
    debug_assert_eq!(sample.count, POSE_VALUES);
    if let Some(camera_mm) = tracker.camera_mm {
        let to_camera = Vector3::from(camera_mm) * 1e-3 - Vector3::from(pose.position_m);
        let faces = rotation(pose) * Vector3::from(tracker.marker_faces);
        let lengths = to_camera.norm() * faces.norm();
        // A marker at the camera's position counts as visible.
        let cosine = if lengths > 0.0 { to_camera.dot(&faces) / lengths } else { 1.0 };
        sample.is_seen = cosine >= libm::cos(tracker.view_deg.to_radians());
    }
    sample
}

fn add_pose_errors(tracker: &Tracker, sample: &mut Sample, noise: Deviate<'_>) {
    for (i, x) in sample.value.iter_mut().enumerate().take(3) {
        *x += tracker.position_noise_mm * 1e-3 * noise(i);
    }
    if tracker.orientation_noise_deg > 0.0 {
        let [.., x, y, z, w] = [sample.value[3], sample.value[4], sample.value[5], sample.value[6]];
        let turn = Vector3::new(noise(3), noise(4), noise(5)) * tracker.orientation_noise_deg.to_radians();
        let read = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
            * UnitQuaternion::from_scaled_axis(turn);
        sample.value[3..7].copy_from_slice(read.coords.as_slice());
    }
}
