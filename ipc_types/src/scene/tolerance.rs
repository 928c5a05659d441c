use serde::{Deserialize, Serialize};

/// Errors that a scene allows: the hub chooses the cheapest settings whose measured errors are below them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tolerance {
    /// Of the burr's place at rest, 0.001 to 100 mm: the physics' rung, links, integrator and step follow.
    pub tip_mm: Option<f64>,
    /// Of the burr's path, root mean square, 0.001 to 100 mm: likewise.
    pub path_mm: Option<f64>,
}
