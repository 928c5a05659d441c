//! `[contact]` and `[drilling]`: what tool and bone do to each other.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Contact of the tool with bone, where it differs from the standard.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Contact {
    /// Friction coefficient between tool and bone.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub friction: Option<f64>,
    /// Stiffness of a contact.
    #[schemars(range(min = 1e3, max = 1e9))]
    pub stiffness_n_per_m: Option<f64>,
    /// Compressive strength of cortical bone of 1.9 g/cm³, which bounds the pressure of the tool on bone.
    #[schemars(range(min = 0.1, max = 1e5))]
    pub strength_mpa: Option<f64>,
    /// Exponent of the density in that strength.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub strength_exponent: Option<f64>,
    /// What a voxel is to the tool: `planes` is the standard; `balls` is a published way, for experiments.
    pub voxels: Option<ContactVoxels>,
}

/// What a voxel is to a sphere of the tool that touches it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ContactVoxels {
    /// A part of the bone's smoothed surface, a plane to the sphere.
    #[default]
    Planes,
    /// A ball in the voxel's middle.
    Balls,
}

/// Strength of bone and the burr's cutting, where it differs from the standard.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Drilling {
    /// Energy to remove a volume of cortical bone of 1.9 g/cm³.
    #[schemars(range(min = 1e-4, max = 10.0))]
    pub specific_energy_j_per_mm3: Option<f64>,
    /// Exponent of the density in that energy.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub density_exponent: Option<f64>,
    /// Cutting force over normal force: tangential over normal. Measured torque over thrust gives 2 to 4 for
    /// twist drills.
    #[schemars(range(min = 0.01, max = 5.0))]
    pub cutting_coefficient: Option<f64>,
    /// Pressure of the burr's edges on cortical bone of 1.9 g/cm³ below which they plough and do not cut; 0
    /// is the standard.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub edge_pressure_mpa: Option<f64>,
    /// The same as a force for each millimetre of the hole's diameter, in place of `edge_pressure_mpa`: edges
    /// have a length, and a larger burr ploughs with less pressure. 7 N/mm with an `edge_exponent` of 1.5
    /// fits published thrusts best (docs/reproduction.md).
    #[schemars(range(min = 0.0, max = 1e3))]
    pub edge_force_n_per_mm: Option<f64>,
    /// Exponent of the density in that pressure or force.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub edge_exponent: Option<f64>,
    /// Whether cutting also pushes the burr aside, with the cutting coefficient times a contact's force,
    /// across its normal and the burr's axis. For tools that bend out of the plane (`spatial`, `full`); off
    /// by default.
    pub side_force: Option<bool>,
    /// How voxels end: `energy` is the standard; the others are published rules, for experiments.
    pub removal: Option<Removal>,
}

/// How a burr removes voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Removal {
    /// By the energy that it takes to cut them.
    Energy,
    /// All that the burr touches, at once.
    Naive,
    /// At most ten touched voxels a tick, in proportion to the burr's speed.
    Capped,
    /// A strength in proportion to density, less a value in proportion to the burr's speed each tick.
    Decrement,
}
