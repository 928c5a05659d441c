//! Recession of bone under the turning burr within a step.
//!
//! What the burr cuts is known only after a step: the voxels wear by the energy of the step's forces
//! ([`crate::bone::drilling`]). If the bone were rigid within the step, the burr would press as hard as the
//! contact is stiff, cut too much, and find nothing to press on in the next step; forces would jump, more so
//! with longer steps. The burr's contacts therefore recede together within the step by what their forces will
//! cut: the cutting law for the bone touched in the last tick, implicit in the force.

use serde::{Deserialize, Serialize};

use crate::bone::GrindReport;
use crate::contact_plane::RecessionLaw;

/// The cutting law at the bone that the burr touched in the last tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct RecessionState {
    /// Force below which nothing is cut, N.
    edge_n: f64,
    /// Depth per newton above it and per radian of burr rotation, m/(N rad).
    m_per_n_rad: f64,
}

impl RecessionState {
    /// Returns the law after a tick in which the burr turned by `turned_rad`.
    pub fn after(report: &GrindReport, turned_rad: f64) -> RecessionState {
        let m_per_n_rad = if turned_rad > 0.0 { report.recession_m_per_n / turned_rad } else { 0.0 };
        RecessionState { edge_n: report.edge_force_n, m_per_n_rad }
    }

    /// Returns the recession law for a step in which the burr turns by `turned_rad`, limited to `most_m`.
    pub fn give(&self, turned_rad: f64, most_m: f64) -> RecessionLaw {
        RecessionLaw { from_n: self.edge_n, m_per_n: self.m_per_n_rad * turned_rad, most_m }
    }
}
