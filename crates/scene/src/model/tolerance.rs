//! `[tolerance]`: errors that a scene allows, of its settings and of its outcome.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest allowed errors. The fastest settings that meet the first three are chosen, by the errors measured
/// in the project's charts or, for a tool other than the standard one, measured on first use; an absent key
/// leaves the scene's own settings.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// Error of the burr's position at rest: determines the physics' model, links, integrator and time step.
    #[schemars(range(min = 1e-3, max = 100.0))]
    pub tip_mm: Option<f64>,
    /// Error of the burr's path, root mean square: likewise.
    #[schemars(range(min = 1e-3, max = 100.0))]
    pub path_mm: Option<f64>,
    /// Error of the X-ray's line integrals against Siddon's exact sum over the voxels, relative, root mean
    /// square: determines `drr.projector` and `drr.oversampling`.
    #[schemars(range(min = 1e-9, max = 1.0))]
    pub drr_rel: Option<f64>,
    /// Distance of the burr from its target at the deepest insertion: a larger one, predicted or of a run, is
    /// reported, and the run's outcome is out of tolerance. Chooses no settings. Absent: reported from 2 mm.
    #[schemars(range(min = 1e-3, max = 1000.0))]
    pub target_mm: Option<f64>,
    /// Largest distance of the burr from the planned path up to the deepest insertion: likewise.
    #[schemars(range(min = 1e-3, max = 1000.0))]
    pub path_deviation_mm: Option<f64>,
}
