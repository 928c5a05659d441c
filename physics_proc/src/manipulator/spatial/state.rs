//! The state of a spatial chain between steps.

use crate::manipulator::state::{BaseMotion, ContactResult, StepReport};
use crate::manipulator::tendon::TendonMemory;

/// The whole dynamic state, bit for bit.
#[derive(Debug, Clone, PartialEq)]
pub struct SpatialState {
    pub(super) position: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    pub(super) base: BaseMotion,
    pub(super) tendon: [TendonMemory; 2],
    /// Torque of each stop in the last step by freedom, N m: the warm start.
    pub(super) stop_torque: Vec<f64>,
    pub(super) result_count: usize,
    /// Results of the last step, ordered by sphere: output and warm start.
    pub(super) results: Vec<ContactResult>,
    pub(super) report: StepReport,
}

impl SpatialState {
    pub(super) fn new(base: &BaseMotion, freedoms: usize, contacts: usize) -> Self {
        Self {
            position: vec![0.0; freedoms],
            velocity: vec![0.0; freedoms],
            base: *base,
            tendon: [TendonMemory::default(); 2],
            stop_torque: vec![0.0; freedoms],
            result_count: 0,
            results: vec![ContactResult::none(); contacts],
            report: StepReport::none(),
        }
    }
}
