//! What a scene file may say, a file per subject.

/// Writes the functions from which serde takes the defaults of a table's keys.
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
mod manipulator;
mod recording;
mod run;
mod sensor;
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
pub use manipulator::*;
pub use recording::*;
pub use run::*;
pub use sensor::*;
pub use tolerance::Tolerance;
pub use tool::*;
pub use truth::*;
pub use volume::*;

use messages::{MAX_BODIES, MAX_CONTROLLERS, MAX_SENSORS, MAX_TENDONS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Farthest coordinate of a point of a scene: 100 m.
const FARTHEST_MM: f64 = 1e5;

/// Names of controllers, sensors and bodies, as a regular expression, and in words.
const NAME: &str = "^[A-Za-z0-9_]{1,64}$";
const NAME_EXPECTED: &str = "1 to 64 letters, digits, `_`";

/// A scene's name, which is also a folder's.
const SCENE_NAME: &str = "^[A-Za-z0-9_-]{1,64}$";
const SCENE_NAME_EXPECTED: &str = "1 to 64 letters, digits, `_`, `-`";

/// A scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Name; names the output folder.
    #[schemars(regex(pattern = SCENE_NAME), extend("patternErrorMessage" = SCENE_NAME_EXPECTED))]
    pub name: String,
    /// What the scene shows.
    #[serde(default)]
    pub description: String,
    /// How it runs.
    pub run: Run,
    /// Errors that are allowed; absent: the standard settings. What the scene names itself stays.
    pub tolerance: Option<Tolerance>,
    /// The bone; absent: free space.
    pub volume: Option<Volume>,
    /// Holes that are there before the run.
    #[serde(default)]
    pub predrill: Vec<Predrill>,
    /// Rigid bodies beside the tool; absent: none, and no rigid-body engine.
    #[serde(default)]
    #[schemars(length(max = MAX_BODIES))]
    pub body: Vec<Body>,
    /// Gravity in the patient frame, on the tool and on free bodies. None by default: the tool's own weight
    /// of 7 g bends it by micrometres, and a scene says which way the patient lies.
    #[serde(default)]
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub gravity_m_per_s2: [f64; 3],
    /// Where the tool starts.
    pub tool: Tool,
    /// The manipulator, where it differs from the standard one.
    #[serde(default)]
    pub manipulator: Manipulator,
    /// The tendons, in the order of the commands; none: the antagonist pair, 2.5 mm to either side.
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
    /// What measures the tool; absent: nothing, and controllers see the exact state only.
    #[serde(default)]
    #[schemars(length(max = MAX_SENSORS))]
    pub sensor: Vec<Sensor>,
    /// Who drives the tool.
    #[serde(default)]
    #[schemars(length(max = MAX_CONTROLLERS))]
    pub controller: Vec<Controller>,
    /// Where the simulated world differs from what the scene says; absent: nowhere.
    pub truth: Option<Truth>,
    /// What is recorded.
    #[serde(default)]
    pub recording: Recording,
}
