//! Checks whether the tool's model is valid in the present state.

use messages::PastStop;

use super::Simulation;
use crate::manipulator::{AnyManipulator, ManipulatorModel, Rung};

/// Returns how far each flexure is past its stop, rad; negative before the stop. An arc of constant curvature
/// stops as a whole: its flexures count with their mean angle.
pub(super) fn past_stops(tool: &AnyManipulator) -> impl Iterator<Item = f64> {
    let limit_rad = tool.parameters().joint_limit_rad;
    let bends = tool.joint_positions_rad().iter().enumerate();
    let rest_rad: f64 = (0..tool.joint_count()).map(|i| tool.rest_rad(i)).sum();
    let mean_rad = (tool.bend_rad() - rest_rad) / tool.joint_count() as f64;
    let is_arc = tool.rung() == Rung::ConstantCurvature;
    bends.map(move |(i, q)| if is_arc { mean_rad } else { q - tool.rest_rad(i) }.abs() - limit_rad)
}

impl Simulation<'_> {
    /// Returns the flexure farthest past its stop if that makes the tool's model invalid.
    pub fn invalid_flexure(&self) -> Option<PastStop> {
        let tool = &self.manipulator;
        if tool.is_valid() {
            return None;
        }
        let (flexure, excess_rad) = past_stops(tool).enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some(PastStop { model: tool.rung().name(), flexure, excess_rad })
    }
}
