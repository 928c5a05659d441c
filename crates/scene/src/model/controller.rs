//! `[[controller]]`: what drives the tool.

use std::collections::BTreeMap;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::built_in::{CurvedDrilling, Hold, Skiving, TensionSweep, TubeDeployment};
use super::{NAME, NAME_EXPECTED};

/// A controller of the tool. Its kind is exactly one of `curved_drilling`, `skiving`, `tension_sweep`,
/// `tube_deployment`, `hold`, `fmu`, `command` and `external`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Controller {
    /// Name within the session.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// Parts that it drives; each part, and each rigid body, has at most one driver.
    pub drives: Vec<Drives>,
    /// Name of the `[[body]]` that it drives, if `drives` lists `body`.
    pub body: Option<String>,
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
    /// An FMU for co-simulation (FMI 2.0 or 3.0), relative to the scene file's folder: a program that runs as
    /// a process of its own; see docs/fmi.md.
    #[schemars(extend("x-kind" = "path"))]
    pub fmu: Option<PathBuf>,
    /// With `fmu`: what each input gets: a field of the state, such as `bend_rad` or `joint_position_rad[3]`,
    /// or of the newest reading of a sensor, such as `sensor.fbg.value[0]`.
    #[serde(default)]
    pub inputs: BTreeMap<String, String>,
    /// With `fmu`: the output that each field of the command gets, such as `"tendon_force_n[0]" = "u"`.
    #[serde(default)]
    pub outputs: BTreeMap<String, String>,
    /// With `fmu`: fields of the command with a fixed value, such as `tendon_mode = 1`.
    #[serde(default)]
    pub constants: BTreeMap<String, f64>,
    /// With `fmu`: parameters of the FMU.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// With `fmu`: its step, a multiple of `run.dt_ms`; absent: `run.dt_ms`.
    #[schemars(range(min = 0.1, max = 10_000.0))]
    pub step_ms: Option<f64>,
    /// With `fmu`: a shared library to load before it, whose functions it uses, such as
    /// `libpython3.11.so.1.0` for an FMU of PythonFMU3.
    pub preload: Option<String>,
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
    /// True if a controller with `external`, `command` or `fmu` can join and leave at any time: the run
    /// begins without it, and a program that ends does not end the run.
    #[serde(default)]
    pub optional: bool,
    /// How many times a `command` or `fmu` that ends before the run is restarted.
    #[serde(default)]
    #[schemars(range(min = 0, max = 1000))]
    pub restarts: u32,
}

defaults!(Controller { default_connect_limit_s: f64 = 60.0 });

impl Controller {
    /// Whether the run starts a program for it: its `command`, or one that runs its `fmu`.
    pub fn is_program(&self) -> bool {
        self.command.is_some() || self.fmu.is_some()
    }
}

/// Returns how many steps are in a duration, both in the same unit; `None` if it is not a multiple of a step,
/// except for rounding.
pub fn whole_steps(duration: f64, step: f64) -> Option<u64> {
    let count = (duration / step).round();
    (count >= 1.0 && (count * step - duration).abs() <= 1e-6 * step).then_some(count as u64)
}

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
    /// The rigid body that the controller's `body` names.
    Body,
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
            Drives::Body => "body",
            Drives::CArm => "c_arm",
        }
    }
}
