//! `[truth]`: where the simulated world differs from what plan and controllers take it for.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Contact, Drilling};

/// Where the simulated world differs from what the rest of the scene says, to test how robust a controller
/// is. Physics, X-ray and the error at the end go by it; the plan and the built-in controllers do not know
/// it. Absent: the scene is true.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Truth {
    /// Registration error: how far the bone lies from where the plan has it. The scene's holes stay with the
    /// tool, which drilled them by the same registration; bodies stay, too.
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub registration_error_mm: [f64; 3],
    /// How far it is turned there, about `tool.burr_start_mm`: axis times angle.
    #[schemars(inner(range(min = -90.0, max = 90.0)))]
    pub registration_error_deg: [f64; 3],
    /// Model error: the tool as it is.
    pub manipulator: TrueManipulator,
    /// The same of contact: keys given here take the place of those of `[contact]`.
    pub contact: Contact,
    /// The same of bone and burr: keys given here take the place of those of `[drilling]`.
    pub drilling: Drilling,
}

/// What of the tool may differ from `[manipulator]`. Keys given here take the place of those there.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "as believed"))]
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
