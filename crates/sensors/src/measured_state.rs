//! The state as a controller knows it from its sensors.

use messages::{MAX_TENDONS, Pose, SensorKind, SensorReading, State, Wrench};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use scene::{Scene, Tracked};
use serde::{Deserialize, Serialize};

use crate::fibre::{Fibre, t_world_tube};
use crate::measure::rotation;

/// Replaces a state's exact values by the newest readings of the selected sensors. Values that none of them
/// measures stay exact.
///
/// | kind | replaces |
/// |---|---|
/// | `fbg` | `t_world_burr`, `t_world_tip`, `bend_rad`; from the exact `t_world_base` and the dimensions |
/// | `tracker` | the pose of the body that carries the marker; on the burr also `t_world_tip` |
/// | `encoders` | `arm_joint_position_rad` |
/// | `load_cell` | `tendon_tension_n` |
/// | `force_torque` | `flange_wrench` |
///
/// A controller that uses a sensor waits for its first valid reading: see [`MeasuredState::is_complete`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MeasuredState {
    used: Vec<Used>,
    fibre: Option<Fibre>,
}

/// A sensor and its newest valid reading.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Used {
    index: u32,
    on: Tracked,
    #[serde(with = "as_bytes")]
    newest: Option<SensorReading>,
}

impl MeasuredState {
    /// Selects the sensors with these names; unknown names are ignored (a validated scene has none).
    pub fn new(scene: &Scene, names: &[String]) -> MeasuredState {
        let used = |name: &String| {
            let (index, sensor) = (0..).zip(&scene.sensor).find(|(_, sensor)| sensor.name == *name)?;
            let on = sensor.tracker.as_ref().map_or(Tracked::default(), |tracker| tracker.on);
            Some(Used { index, on, newest: None })
        };
        MeasuredState { used: names.iter().filter_map(used).collect(), fibre: None }
    }

    /// Takes a reading of any sensor. A reading without values is ignored: the previous measurement is kept.
    pub fn see(&mut self, reading: &SensorReading) {
        let used = self.used.iter_mut().find(|used| used.index == reading.sensor_index);
        if let Some(used) = used.filter(|_| reading.is_valid()) {
            used.newest = Some(*reading);
        }
    }

    /// Drops measurements from before a tick to which the run was reset.
    pub fn forget_before(&mut self, tick: u64) {
        for used in &mut self.used {
            used.newest = used.newest.filter(|reading| reading.sample_tick >= tick);
        }
    }

    /// Returns true if every sensor has a measurement.
    pub fn is_complete(&self) -> bool {
        self.used.iter().all(|used| used.newest.is_some())
    }

    /// Returns the measured state.
    pub fn of(&mut self, exact: &State) -> State {
        let mut state = *exact;
        let fibre = *self.fibre.get_or_insert_with(|| Fibre::of(exact));
        for used in &self.used {
            let Some(reading) = &used.newest else { continue };
            match reading.kind() {
                Ok(SensorKind::Fbg) => put_shape(&mut state, &fibre, reading.values()),
                Ok(SensorKind::Tracker) => put_pose(&mut state, used.on, reading.values()),
                Ok(SensorKind::Encoders) => copy(&mut state.arm_joint_position_rad, reading.values()),
                Ok(SensorKind::LoadCell) => {
                    copy(&mut state.tendon_tension_n[..MAX_TENDONS], reading.values())
                }
                Ok(SensorKind::ForceTorque) => put_wrench(&mut state, reading.values()),
                Ok(SensorKind::Clearance) | Err(_) => {}
            }
        }
        state
    }
}

fn copy(into: &mut [f64], values: &[f64]) {
    into.iter_mut().zip(values).for_each(|(slot, value)| *slot = *value);
}

fn put_shape(state: &mut State, fibre: &Fibre, curvatures_per_m: &[f64]) {
    let nodes = curvatures_per_m.len() / 2;
    if nodes == 0 {
        return;
    }
    let sum: f64 = curvatures_per_m.iter().step_by(2).sum();
    state.bend_rad = sum * fibre.length_m / nodes as f64;
    let burr = fibre.burr(&t_world_tube(state), curvatures_per_m);
    put_burr(state, burr);
}

/// Sets the burr's pose, and moves the tip with it, keeping its distance in front.
fn put_burr(state: &mut State, burr: Pose) {
    let front = Vector3::from(state.t_world_tip.position_m) - Vector3::from(state.t_world_burr.position_m);
    let ahead = rotation(&burr) * Vector3::new(0.0, 0.0, front.norm());
    let position = Vector3::from(burr.position_m) + ahead;
    state.t_world_tip = Pose { position_m: position.into(), ..burr };
    state.t_world_burr = burr;
}

fn put_pose(state: &mut State, on: Tracked, values: &[f64]) {
    let [px, py, pz, x, y, z, w] = *values else { return };
    let turn: UnitQuaternion<f64> = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let orientation_xyzw = [turn.i, turn.j, turn.k, turn.w];
    let pose = Pose { position_m: [px, py, pz], orientation_xyzw };
    match on {
        Tracked::Burr => put_burr(state, pose),
        Tracked::Base => state.t_world_base = pose,
        Tracked::Flange => state.t_world_flange = pose,
    }
}

fn put_wrench(state: &mut State, values: &[f64]) {
    let [fx, fy, fz, tx, ty, tz] = *values else { return };
    let to_world = rotation(&state.t_world_base);
    state.flange_wrench = Wrench {
        force_n: (to_world * Vector3::new(fx, fy, fz)).into(),
        torque_nm: (to_world * Vector3::new(tx, ty, tz)).into(),
    };
}

/// Serialises a reading as its bytes.
mod as_bytes {
    use messages::SensorReading;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};
    use zerocopy::{FromBytes, IntoBytes};

    pub fn serialize<S: Serializer>(newest: &Option<SensorReading>, into: S) -> Result<S::Ok, S::Error> {
        newest.as_ref().map(SensorReading::as_bytes).serialize(into)
    }

    pub fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<Option<SensorReading>, D::Error> {
        let bytes = Option::<Vec<u8>>::deserialize(from)?;
        let read = |bytes: Vec<u8>| {
            let reading = SensorReading::read_from_bytes(&bytes);
            reading.map_err(|_| D::Error::custom("a sensor reading of another size"))
        };
        bytes.map(read).transpose()
    }
}
