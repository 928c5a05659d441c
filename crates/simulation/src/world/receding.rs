//! How bone recedes under the turning burr while a step lasts.
//!
//! What the burr cuts is known after a step: the voxels wear by the energy of the step's forces
//! ([`crate::bone::drilling`]). A step that takes bone for rigid meanwhile presses as hard as the contact is
//! stiff, cuts too much, and finds nothing to press on in the next; the forces jump, and the more, the longer
//! the step. So the contacts of the burr recede within the step, together, by what their forces will cut: the
//! cutting law at the bone that was touched in the last tick, implicit in the force.

use serde::{Deserialize, Serialize};

use crate::bone::GrindReport;
use crate::contact_plane::Give;

/// The cutting law at the bone that the burr touched in the last tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Receding {
    /// Force below which nothing is cut, N.
    edge_n: f64,
    /// Depth for each newton above it and each radian that the burr turns, m/(N rad).
    m_per_n_rad: f64,
}

impl Receding {
    /// After a tick in which the burr turned by `turned_rad`.
    pub fn after(report: &GrindReport, turned_rad: f64) -> Receding {
        let m_per_n_rad = if turned_rad > 0.0 { report.recession_m_per_n / turned_rad } else { 0.0 };
        Receding { edge_n: report.edge_force_n, m_per_n_rad }
    }

    /// How the bone gives way in a step in which the burr turns by `turned_rad`, at most by `most_m`.
    pub fn give(&self, turned_rad: f64, most_m: f64) -> Give {
        Give { from_n: self.edge_n, m_per_n: self.m_per_n_rad * turned_rad, most_m }
    }
}
