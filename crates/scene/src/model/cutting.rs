//! `[contact]` and `[drilling]`: interaction of tool and bone.

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
    /// Compressive strength of cortical bone of 1.9 g/cm³, which limits the pressure of the tool on bone.
    #[schemars(range(min = 0.1, max = 1e5))]
    pub strength_mpa: Option<f64>,
    /// Exponent of the density for that strength.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub strength_exponent: Option<f64>,
    /// How a voxel is represented in contact: `planes` is the standard; `balls` is a published method, for
    /// experiments.
    pub voxels: Option<ContactVoxels>,
}

/// How a voxel is represented to a sphere of the tool that touches it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ContactVoxels {
    /// As part of the bone's smoothed surface, locally a plane.
    #[default]
    Planes,
    /// As a ball in the voxel's centre.
    Balls,
}

/// How the burr cuts bone, where it differs from the standard.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-absent" = "standard"))]
pub struct Drilling {
    /// The law that the other keys of this table adjust.
    #[schemars(extend("x-absent" = "burr"))]
    pub law: Option<DrillingLaw>,
    /// Energy per volume to remove cortical bone of 1.9 g/cm³.
    #[schemars(range(min = 1e-4, max = 10.0))]
    pub specific_energy_j_per_mm3: Option<f64>,
    /// Exponent of the density for that energy.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub density_exponent: Option<f64>,
    /// Cutting force over normal force (tangential over normal). Measured torque over thrust gives 0.7 to 4
    /// for twist drills.
    #[schemars(range(min = 0.01, max = 5.0))]
    pub cutting_coefficient: Option<f64>,
    /// Pressure of the burr's edges on cortical bone of 1.9 g/cm³ below which they plough instead of cutting;
    /// 0 is the standard.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub edge_pressure_mpa: Option<f64>,
    /// The same as a force per millimetre of the hole's diameter, in place of `edge_pressure_mpa`: edges have
    /// a length, and a larger burr ploughs with less pressure.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub edge_force_n_per_mm: Option<f64>,
    /// Exponent of the density for that pressure or force.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub edge_exponent: Option<f64>,
    /// Distance beyond its surface to which the burr cuts: run-out and compliance. The hole is wider by twice
    /// this.
    #[schemars(range(min = 0.01, max = 1.0))]
    pub reach_mm: Option<f64>,
    /// Largest depth that a revolution of the burr can cut.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub feed_per_revolution_mm: Option<f64>,
    /// Whether cutting also pushes the burr sideways: by the cutting coefficient times a contact's force,
    /// perpendicular to its normal and to the burr's axis. For tools that bend out of the plane (`spatial`,
    /// `full`); off by default.
    pub side_force: Option<bool>,
    /// How voxels are removed: `energy` is the standard; the others are published rules, for experiments.
    pub removal: Option<Removal>,
}

/// Law by which a cutter needs force and energy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DrillingLaw {
    /// An abrasive burr: energy per volume, in proportion to force and sliding speed.
    Burr,
    /// A twist drill, from the point angle, rake and chisel edge of a tool whose `burr.shape` is `bit`. It
    /// sets energy, coefficient and edge force that neither the scene nor the tool sets.
    TwistDrill,
}

/// How a burr removes voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Removal {
    /// By the energy needed to cut them.
    Energy,
    /// All that the burr touches, immediately.
    Naive,
    /// At most ten touched voxels per tick, in proportion to the burr's speed.
    Capped,
    /// By a strength proportional to density, reduced each tick in proportion to the burr's speed.
    Decrement,
}
