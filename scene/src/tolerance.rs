//! `[tolerance]`: the errors that a scene allows.

use serde::{Deserialize, Serialize};

/// Largest errors wanted. What computes is the quickest that keeps them by the errors measured in the project's charts;
/// without a key it is what the scene says elsewhere.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// Of the burr's place at rest, 0.001 to 100 mm: the physics' rung, links, integrator and step follow.
    pub tip_mm: Option<f64>,
    /// Of the burr's path, root mean square, 0.001 to 100 mm: likewise.
    pub path_mm: Option<f64>,
    /// Error of the X-ray's line integrals beside Siddon's exact sum over the voxels, relative, root mean square, 1e-9 to 1: chooses
    /// `drr.projector` and `drr.oversampling`.
    pub drr_rel: Option<f64>,
}
