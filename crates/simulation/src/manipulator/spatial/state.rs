//! The state of a spatial chain between steps.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use crate::manipulator::MAX_TENDONS;
use crate::manipulator::state::{BaseMotion, ContactResult, StepReport, places_from};
use crate::manipulator::tendon::TendonMemory;

use super::MAX_CONTACTS;

/// The complete dynamic state; restoring it reproduces the run bit for bit.
#[derive(Debug, Clone, PartialEq)]
pub struct SpatialState {
    pub(super) position: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    pub(super) base: BaseMotion,
    pub(super) tendon: [TendonMemory; MAX_TENDONS],
    /// Torque of each stop in the last step, per degree of freedom, N m. Warm-starts the next step.
    pub(super) stop_torque: Vec<f64>,
    pub(super) result_count: usize,
    /// Results of the last step, ordered by sphere. Output, and warm start of the next step.
    pub(super) results: Vec<ContactResult>,
    pub(super) report: StepReport,
    /// What the energy may rise to in free motion ([`super::energy`]), J; infinite behind a step that was not free.
    pub(super) energy_ceiling_j: f64,
}

impl SpatialState {
    /// Copies a state of the same tool without allocating.
    pub(in crate::manipulator) fn copy_from(&mut self, other: &Self) {
        let Self {
            position,
            velocity,
            base,
            tendon,
            stop_torque,
            result_count,
            results,
            report,
            energy_ceiling_j,
        } = self;
        position.clone_from(&other.position);
        velocity.clone_from(&other.velocity);
        stop_torque.clone_from(&other.stop_torque);
        let used = ..other.result_count;
        results[used].copy_from_slice(&other.results[used]);
        (*base, *tendon, *result_count, *report) =
            (other.base, other.tendon, other.result_count, other.report);
        *energy_ceiling_j = other.energy_ceiling_j;
    }

    pub(super) fn new(base: &BaseMotion, freedoms: usize, contacts: usize) -> Self {
        Self {
            position: vec![0.0; freedoms],
            velocity: vec![0.0; freedoms],
            base: *base,
            tendon: [TendonMemory::default(); MAX_TENDONS],
            stop_torque: vec![0.0; freedoms],
            result_count: 0,
            results: vec![ContactResult::none(); contacts],
            report: StepReport::none(),
            energy_ceiling_j: f64::INFINITY,
        }
    }
}

/// Writes only the used results: entries past the count are left over from earlier steps.
impl Serialize for SpatialState {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let results = &self.results[..self.result_count];
        let motion = (&self.position, &self.velocity, &self.base);
        let last = (&self.stop_torque, results, &self.report, self.energy_ceiling_j);
        (motion, &self.tendon, last).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for SpatialState {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        type Freedoms = Vec<f64>;
        type Whole = (
            (Freedoms, Freedoms, BaseMotion),
            [TendonMemory; MAX_TENDONS],
            (Freedoms, Vec<ContactResult>, StepReport, f64),
        );
        let (motion, tendon, last) = Whole::deserialize(deserializer)?;
        let ((position, velocity, base), (stop_torque, used, report, energy_ceiling_j)) = (motion, last);
        let results = places_from(&used, MAX_CONTACTS)
            .ok_or_else(|| D::Error::custom("more contacts than a step has"))?;
        let result_count = used.len();
        Ok(Self {
            position,
            velocity,
            base,
            tendon,
            stop_torque,
            result_count,
            results,
            report,
            energy_ceiling_j,
        })
    }
}
