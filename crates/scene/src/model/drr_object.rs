//! `[[drr.object]]`: objects that X-ray frames show.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Cuboid, FARTHEST_MM, NAME, NAME_EXPECTED, StructureMesh};

/// Largest number of objects of a scene.
pub const MAX_OBJECTS: usize = 64;
/// Largest number of balls of an object.
const MOST_BALLS: usize = 500;

/// What an object of X-ray frames is made of; coefficients are NIST's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum XRayMaterial {
    /// Stainless steel 316L, 7.99 g/cm³.
    Steel,
    /// Titanium, 4.506 g/cm³.
    Titanium,
    /// Co-28Cr-6Mo, 8.3 g/cm³.
    CobaltChromium,
    /// Tantalum, 16.65 g/cm³.
    Tantalum,
    /// Lead, 11.35 g/cm³.
    Lead,
    /// Aluminium, 2.699 g/cm³.
    Aluminium,
    /// Polymethyl methacrylate, 1.19 g/cm³.
    Pmma,
}

/// What an object of X-ray frames moves with.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ObjectFrame {
    /// Nothing: the patient frame.
    #[default]
    World,
    /// The bone, which `[truth]` can displace; as planned, the patient frame.
    Anatomy,
    /// The arm's flange: the flange's frame.
    Flange,
    /// The tool's base: the frame of the tool's base, z along the tool.
    Tool,
}

/// An object that X-ray frames show and nothing collides with: a wire, a screw, marker balls. Its shape is
/// exactly one of `balls`, `cylinder`, `cuboid` and `mesh`, in the object's own frame. It displaces the
/// anatomy, except a mesh, which adds to it. Where two objects overlap, both attenuate; it neither scatters
/// nor stops scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DrrObject {
    /// Name.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// Marker balls, whose projected centres are labels.
    pub balls: Option<ObjectBalls>,
    /// A wire, a pin, the shank of a screw; a tube with `inner_radius_mm`.
    pub cylinder: Option<ObjectCylinder>,
    /// A box.
    pub cuboid: Option<Cuboid>,
    /// A closed surface. A file that states no patient frame is taken as it is.
    pub mesh: Option<StructureMesh>,
    /// Material.
    pub material: XRayMaterial,
    /// What it moves with.
    #[serde(default)]
    pub attached: ObjectFrame,
    /// Origin of the object's frame in that of `attached`.
    #[serde(default)]
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub position_mm: [f64; 3],
    /// Orientation of the object's frame there: axis times angle.
    #[serde(default)]
    #[schemars(inner(range(min = -360.0, max = 360.0)))]
    pub rotation_vector_deg: [f64; 3],
}

impl DrrObject {
    /// Returns the names of its balls as markers: its own, with a number from 1 if there are several.
    pub fn marker_names(&self) -> Vec<String> {
        let count = self.balls.as_ref().map_or(0, |balls| balls.centres_mm.len());
        match count {
            1 => vec![self.name.clone()],
            _ => (1..=count).map(|number| format!("{}_{number}", self.name)).collect(),
        }
    }
}

/// Equal balls.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectBalls {
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
    /// Their centres, each coordinate within 100 m.
    #[serde(default = "ObjectBalls::default_centres_mm")]
    #[schemars(length(min = 1, max = MOST_BALLS))]
    pub centres_mm: Vec<[f64; 3]>,
}

defaults!(ObjectBalls { default_centres_mm: Vec<[f64; 3]> = vec![[0.0; 3]] });

/// A cylinder with flat ends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectCylinder {
    /// Centre of one end.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub start_mm: [f64; 3],
    /// Centre of the other end.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub end_mm: [f64; 3],
    /// Radius.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub radius_mm: f64,
    /// Radius of a canal along the axis, less than `radius_mm`; it holds air.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub inner_radius_mm: f64,
}
