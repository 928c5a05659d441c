//! `[[controller]]`: what drives the tool.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::built_in::{CurvedDrilling, Hold, Skiving, TensionSweep, TubeDeployment};
use super::{NAME, NAME_EXPECTED};

/// A controller of the tool. Its kind is exactly one of `curved_drilling`, `skiving`, `tension_sweep`,
/// `tube_deployment`, `hold`, `command` and `external`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Controller {
    /// Name within the session.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// Parts that it drives; each part has at most one driver.
    pub drives: Vec<Drives>,
    /// Names of sensors that a built-in controller uses: their readings replace the exact state.
    #[serde(default)]
    pub sensors: Vec<String>,
    /// The built-in curved drilling.
    pub curved_drilling: Option<CurvedDrilling>,
    /// The built-in skiving test: a straight feed that reports how far the burr deviates from its line.
    pub skiving: Option<Skiving>,
    /// The built-in tendon sweep, from which `trabecula calibrate` writes a calibration.
    pub tension_sweep: Option<TensionSweep>,
    /// The built-in controller that rotates the tube and slides it out of the outer tube.
    pub tube_deployment: Option<TubeDeployment>,
    /// The built-in controller that holds a tension.
    pub hold: Option<Hold>,
    /// A program to start, with its arguments; it finds the session's folder in the environment variable
    /// `TRABECULA_SESSION` and its own name in `TRABECULA_CONTROLLER`.
    pub command: Option<Vec<String>>,
    /// True if it is started by hand or by another program.
    #[serde(default)]
    pub external: bool,
    /// How long the start of the run waits for an external controller.
    #[serde(default = "Controller::default_connect_limit_s")]
    #[schemars(range(min = 1.0, max = 3600.0))]
    pub connect_limit_s: f64,
    /// True if a controller with `external` or `command` can join and leave at any time: the run begins
    /// without it, and a `command` that ends does not end the run.
    #[serde(default)]
    pub optional: bool,
    /// How many times a `command` that ends before the run is restarted.
    #[serde(default)]
    #[schemars(range(min = 0, max = 1000))]
    pub restarts: u32,
}

defaults!(Controller { default_connect_limit_s: f64 = 60.0 });

/// A part of the tool that a controller drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Drives {
    /// The tendons.
    Tendon,
    /// The arm.
    Arm,
    /// The burr.
    Burr,
    /// The tube that slides out of the tool's outer tube.
    Tube,
    /// The C-arm: only its driver can request frames from a pose of its own. If undriven, any controller can.
    CArm,
}

impl Drives {
    /// Returns its name in a scene.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Drives::Tendon => "tendon",
            Drives::Arm => "arm",
            Drives::Burr => "burr",
            Drives::Tube => "tube",
            Drives::CArm => "c_arm",
        }
    }
}
