//! `[truth]`: where the simulated world differs from what the plan and the controllers assume.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Contact, Drilling};

/// Where the simulated world differs from the rest of the scene, to test the robustness of a controller.
/// Physics, X-ray and the final error use it; the plan and the built-in controllers do not see it. Absent:
/// the scene is true.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Truth {
    /// Registration error: displacement of the bone from its position in the plan. The scene's holes stay
    /// with the tool, which drilled them with the same registration; so do bodies.
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub registration_error_mm: [f64; 3],
    /// Rotation of the bone about `tool.burr_start_mm`: axis times angle.
    #[schemars(inner(range(min = -90.0, max = 90.0)))]
    pub registration_error_deg: [f64; 3],
    /// Model error: the true tool.
    pub manipulator: TrueManipulator,
    /// True contact: keys set here replace those of `[contact]`.
    pub contact: Contact,
    /// True bone and burr: keys set here replace those of `[drilling]`.
    pub drilling: Drilling,
}

/// Properties of the true tool that differ from `[manipulator]`. Keys set here replace those there.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "as assumed"))]
pub struct TrueManipulator {
    /// As `manipulator.stiffness_scale`.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub stiffness_scale: Option<f64>,
    /// As `manipulator.mass_scale`.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub mass_scale: Option<f64>,
    /// As `manipulator.damping_ratio`.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub damping_ratio: Option<f64>,
    /// As `manipulator.tendon_friction`.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub tendon_friction: Option<f64>,
    /// As `manipulator.mount_stiffness_n_per_m`.
    #[schemars(range(min = 1e3, max = 1e7))]
    pub mount_stiffness_n_per_m: Option<f64>,
    /// As `manipulator.lateral_stiffness_ratio`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub lateral_stiffness_ratio: Option<f64>,
    /// As `manipulator.torsion_stiffness_ratio`.
    #[schemars(range(min = 1e-3, max = 1e3))]
    pub torsion_stiffness_ratio: Option<f64>,
    /// As `manipulator.burr_stall_torque_nmm`.
    #[schemars(range(min = 0.01, max = 1e4))]
    pub burr_stall_torque_nmm: Option<f64>,
}
