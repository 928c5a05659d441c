//! `[[structure]]`: critical structures that the tool should keep away from.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, NAME, NAME_EXPECTED};

/// Largest number of structures of a scene.
pub const MAX_STRUCTURES: usize = 16;
/// Largest number of points of a tube.
const MOST_POINTS: usize = 1000;

/// A critical structure, in the patient frame, which moves with the bone of `[truth]`. Its shape is exactly
/// one of `ball`, `cuboid`, `tube` and `built_in`. The tool does not collide with it. Structures may overlap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Structure {
    /// Name.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// A ball.
    pub ball: Option<StructureBall>,
    /// A box.
    pub cuboid: Option<StructureCuboid>,
    /// A tube: a nerve, a vessel or a canal. Two points make a capsule.
    pub tube: Option<StructureTube>,
    /// What the volume defines.
    pub built_in: Option<BuiltInStructure>,
    /// Clearance that the tool should keep.
    #[serde(default = "Structure::default_margin_mm")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub margin_mm: f64,
    /// What happens when the clearance falls below the margin.
    #[serde(default)]
    pub on_margin: StructureAction,
    /// What happens when the tool enters the structure.
    #[serde(default)]
    pub on_breach: StructureAction,
}

defaults!(Structure { default_margin_mm: f64 = 2.0 });

/// What happens when the tool comes close to a structure or enters it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum StructureAction {
    /// An event.
    #[default]
    Event,
    /// An event, and a protective stop of the arm; the tendons keep their tension.
    Stop,
}

/// A structure that the volume defines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum BuiltInStructure {
    /// Everything outside of the bone, with its marrow and pores, as it was before the pilot holes. The
    /// tool's own entrance does not count.
    OutsideOfBone,
}

/// A ball.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureBall {
    /// Centre.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub centre_mm: [f64; 3],
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
}

/// A box.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureCuboid {
    /// Centre.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub centre_mm: [f64; 3],
    /// Half extents along its axes.
    #[schemars(inner(range(min = 0.01, max = 1000.0)))]
    pub half_extents_mm: [f64; 3],
    /// Orientation: axis times angle.
    #[serde(default)]
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_vector_deg: [f64; 3],
}

/// All points within a radius of a polyline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StructureTube {
    /// The line's points, each coordinate within 100 m.
    #[schemars(length(min = 1, max = MOST_POINTS))]
    pub points_mm: Vec<[f64; 3]>,
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
}
