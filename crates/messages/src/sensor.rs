use super::MAX_SENSOR_VALUES;
use crate::message;

message! {
    /// One reading of a sensor in the scene. Published before the state of the tick at which it arrives, and
    /// only in scenes with a `[[sensor]]` or a `[[structure]]`. `kind` determines what the values mean;
    /// docs/sensors.md lists their order and units.
    pub struct SensorReading = "trabecula_msgs/msg/SensorReading" {
        /// `State.tick` of the state with which the reading arrives.
        tick: u64,
        /// `State.tick` of the state that it measures.
        sample_tick: u64,
        /// Sequence number of the readings of all sensors: 1, 2, 3 and so on.
        sequence: u64,
        /// Index of the sensor in the scene, from 0; of the clearances, the number of sensors.
        sensor_index: u32,
        /// 1 fbg, 2 tracker, 3 encoders, 4 load_cell, 5 force_torque, 6 clearance.
        kind: u32,
        /// 1 if the reading is valid, 0 if it dropped out or the tracker does not see its marker; the values
        /// are then 0.
        valid: u32,
        /// Number of used entries of `value`.
        value_count: u32,
        /// Measured values.
        value: [f64; MAX_SENSOR_VALUES],
    }
}

impl SensorReading {
    /// Returns the used values.
    pub fn values(&self) -> &[f64] {
        &self.value[..(self.value_count as usize).min(MAX_SENSOR_VALUES)]
    }

    /// Returns the clearances from the scene's structures, m, in their order, of a reading of kind
    /// [`Clearance`](crate::SensorKind::Clearance). In `value`, each is followed by the index of the tool's
    /// closest sphere.
    pub fn clearances_m(&self) -> impl Iterator<Item = f64> + '_ {
        self.values().iter().step_by(2).copied()
    }

    /// Returns whether the reading is valid.
    pub fn is_valid(&self) -> bool {
        self.valid == 1
    }
}
