//! Contents of a scene file, one module per subject.

/// Generates the functions that give serde the defaults of a table's keys.
macro_rules! defaults {
    ($table:ident { $($name:ident: $type:ty = $value:expr),+ $(,)? }) => {
        impl $table {
            $(pub(crate) fn $name() -> $type {
                $value
            })+
        }
    };
}

mod arm;
mod body;
mod built_in;
mod controller;
mod cutting;
mod drr;
mod drr_object;
mod manipulator;
mod recording;
mod run;
mod sensor;
mod structure;
mod tolerance;
mod tool;
mod truth;
mod volume;

pub use arm::*;
pub use body::*;
pub use built_in::*;
pub use controller::*;
pub use cutting::*;
pub use drr::*;
pub use drr_object::*;
pub use manipulator::*;
pub use recording::*;
pub use run::*;
pub use sensor::*;
pub use structure::*;
pub use tolerance::Tolerance;
pub use tool::*;
pub use truth::*;
pub use volume::*;

use messages::{MAX_BODIES, MAX_CONTROLLERS, MAX_SENSORS, MAX_TENDONS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest coordinate of a point of a scene: 100 m.
pub(crate) const FARTHEST_MM: f64 = 1e5;

/// Names of controllers, sensors and bodies: regular expression and description.
const NAME: &str = "^[A-Za-z0-9_]{1,64}$";
const NAME_EXPECTED: &str = "1 to 64 letters, digits, `_`";

/// A scene's name, which is also a folder name.
const SCENE_NAME: &str = "^[A-Za-z0-9_-]{1,64}$";
const SCENE_NAME_EXPECTED: &str = "1 to 64 letters, digits, `_`, `-`";

/// A scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Name of the scene and of its output folder.
    #[schemars(regex(pattern = SCENE_NAME), extend("patternErrorMessage" = SCENE_NAME_EXPECTED))]
    pub name: String,
    /// What the scene shows.
    #[serde(default)]
    pub description: String,
    /// How it runs.
    pub run: Run,
    /// Allowed errors; absent: the standard settings. Values that the scene sets itself are kept.
    pub tolerance: Option<Tolerance>,
    /// The bone; absent: free space.
    pub volume: Option<Volume>,
    /// Holes that exist before the run.
    #[serde(default)]
    pub predrill: Vec<Predrill>,
    /// Rigid bodies beside the tool; absent: none, and no rigid-body engine.
    #[serde(default)]
    #[schemars(length(max = MAX_BODIES))]
    pub body: Vec<Body>,
    /// Gravity in the patient frame, on the tool and on free bodies. Zero by default: the tool's own weight
    /// of 7 g bends it by micrometres, and its direction depends on how the patient lies.
    #[serde(default)]
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub gravity_m_per_s2: [f64; 3],
    /// Start pose of the tool.
    pub tool: Tool,
    /// The manipulator, where it differs from the standard one.
    #[serde(default)]
    pub manipulator: Manipulator,
    /// The tendons, in command order; none: the antagonistic pair, 2.5 mm to either side.
    #[serde(default)]
    #[schemars(length(max = MAX_TENDONS))]
    pub tendon: Vec<Tendon>,
    /// Contact of the tool with bone.
    #[serde(default)]
    pub contact: Contact,
    /// Strength of bone and the burr's cutting.
    #[serde(default)]
    pub drilling: Drilling,
    /// The arm that carries the tool.
    #[serde(default)]
    pub arm: Arm,
    /// X-ray frames; absent: none.
    pub drr: Option<Drr>,
    /// Sensors of the tool; absent: none, and controllers see only the exact state.
    #[serde(default)]
    #[schemars(length(max = MAX_SENSORS))]
    pub sensor: Vec<Sensor>,
    /// Critical structures; absent: none, at no cost.
    #[serde(default)]
    #[schemars(length(max = MAX_STRUCTURES))]
    pub structure: Vec<Structure>,
    /// Controllers that drive the tool.
    #[serde(default)]
    #[schemars(length(max = MAX_CONTROLLERS))]
    pub controller: Vec<Controller>,
    /// Where the simulated world differs from the rest of the scene; absent: nowhere.
    pub truth: Option<Truth>,
    /// What is recorded.
    #[serde(default)]
    pub recording: Recording,
}
