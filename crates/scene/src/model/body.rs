//! `[[body]]`: rigid bodies beside the tool.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, NAME, NAME_EXPECTED, XRayMaterial};

/// A rigid body beside the tool. The burr does not cut it. Its shape is exactly one of `cuboid`, `ball` and
/// `capsule`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Name.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// A box.
    pub cuboid: Option<Cuboid>,
    /// A ball.
    pub ball: Option<Ball>,
    /// A capsule.
    pub capsule: Option<Capsule>,
    /// Fixed, free or driven.
    pub motion: BodyMotion,
    /// Centre, patient frame.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub position_mm: [f64; 3],
    /// Orientation: axis times angle.
    #[serde(default)]
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_vector_deg: [f64; 3],
    /// Density of a free body; cortical bone by default.
    #[serde(default = "Body::default_density_kg_per_m3")]
    #[schemars(range(min = 10.0, max = 25_000.0))]
    pub density_kg_per_m3: f64,
    /// Friction coefficient against other bodies; against the tool, the tool's applies (`[contact]`).
    #[serde(default = "Body::default_friction")]
    #[schemars(range(min = 0.0, max = 2.0))]
    pub friction: f64,
    /// Material by which X-ray frames show it; absent: they do not.
    pub material: Option<XRayMaterial>,
}

defaults!(Body { default_density_kg_per_m3: f64 = 1900.0, default_friction: f64 = 0.3 });

/// Whether a rigid body can move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BodyMotion {
    /// Does not move: a clamp.
    Fixed,
    /// Moves by forces: a bone fragment. A controller can add a wrench (`servo_cf`).
    Free,
    /// Moves as a controller commands (`servo_cp`), whatever pushes it: a table.
    Driven,
}

/// A box, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Cuboid {
    /// Half extents along the body's axes.
    #[schemars(inner(range(min = 0.1, max = 1000.0)))]
    pub half_extents_mm: [f64; 3],
}

/// A ball, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ball {
    /// Radius.
    #[schemars(range(min = 0.1, max = 1000.0))]
    pub radius_mm: f64,
}

/// A capsule along the body's z, centred at the body's position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Capsule {
    /// Half the distance between the centres of its ends.
    #[schemars(range(min = 0.1, max = 1000.0))]
    pub half_height_mm: f64,
    /// Radius.
    #[schemars(range(min = 0.1, max = 1000.0))]
    pub radius_mm: f64,
}
