//! `[tolerance]`: the errors that a scene allows.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest errors wanted. What computes is the quickest that keeps them by the errors measured in the
/// project's charts, or, for another tool than the standard one, on first use; without a key it is what the
/// scene says elsewhere.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// Of the burr's place at rest: the physics' rung, links, integrator and step follow.
    #[schemars(range(min = 1e-3, max = 100.0))]
    pub tip_mm: Option<f64>,
    /// Of the burr's path, root mean square: likewise.
    #[schemars(range(min = 1e-3, max = 100.0))]
    pub path_mm: Option<f64>,
    /// Error of the X-ray's line integrals beside Siddon's exact sum over the voxels, relative, root mean
    /// square: chooses `drr.projector` and `drr.oversampling`.
    #[schemars(range(min = 1e-9, max = 1.0))]
    pub drr_rel: Option<f64>,
}
