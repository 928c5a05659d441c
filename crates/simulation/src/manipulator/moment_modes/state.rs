//! The state between steps.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use super::MAX_FREEDOMS;
use crate::manipulator::state::{BaseMotion, ContactResult, StepReport, places_from};
use crate::manipulator::tendon::TendonMemory;
use crate::manipulator::{MAX_CONTACTS, MAX_TENDONS};

/// The complete dynamic state; restoring it reproduces the run bit for bit.
#[derive(Debug, Clone, PartialEq)]
pub struct MomentModesState {
    /// Mount displacement along base x, y, z (m), then the modes' amplitudes (sqrt(J)); unused entries stay 0.
    pub(super) position: [f64; MAX_FREEDOMS],
    /// Their velocities.
    pub(super) velocity: [f64; MAX_FREEDOMS],
    pub(super) base: BaseMotion,
    pub(super) tendon: [TendonMemory; MAX_TENDONS],
    pub(super) result_count: usize,
    /// Results of the last step, ordered by sphere.
    pub(super) results: Vec<ContactResult>,
    pub(super) report: StepReport,
}

impl MomentModesState {
    /// The unloaded tool at rest on `base`.
    pub(super) fn new(base: &BaseMotion) -> Self {
        Self {
            position: [0.0; MAX_FREEDOMS],
            velocity: [0.0; MAX_FREEDOMS],
            base: *base,
            tendon: [TendonMemory::default(); MAX_TENDONS],
            result_count: 0,
            results: vec![ContactResult::none(); MAX_CONTACTS],
            report: StepReport::none(),
        }
    }

    /// Copies a state of the same tool without allocating, of the results only the used ones.
    pub(in crate::manipulator) fn copy_from(&mut self, other: &Self) {
        let used = ..other.result_count;
        self.results[used].copy_from_slice(&other.results[used]);
        (self.position, self.velocity, self.base) = (other.position, other.velocity, other.base);
        (self.tendon, self.result_count, self.report) = (other.tendon, other.result_count, other.report);
    }
}

/// Writes only the used results: entries past the count are left over from earlier steps.
impl Serialize for MomentModesState {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let results = &self.results[..self.result_count];
        (&self.position, &self.velocity, &self.base, &self.tendon, results, &self.report)
            .serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for MomentModesState {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        type Freedoms = [f64; MAX_FREEDOMS];
        type Whole =
            (Freedoms, Freedoms, BaseMotion, [TendonMemory; MAX_TENDONS], Vec<ContactResult>, StepReport);
        let (position, velocity, base, tendon, used, report) = Whole::deserialize(deserializer)?;
        let results = places_from(&used, MAX_CONTACTS)
            .ok_or_else(|| D::Error::custom("more contacts than a step has"))?;
        Ok(Self { position, velocity, base, tendon, result_count: used.len(), results, report })
    }
}
