//! The built-in controllers: `curved_drilling`, `skiving`, `tension_sweep`, `tube_deployment`, `hold`.

use std::path::PathBuf;

use messages::MAX_DEPLOYED_M;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::FARTHEST_MM;

/// Curved drilling: advance with the burr on, pull the tendon along a ramp, and correct the tension by what
/// is measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CurvedDrilling {
    /// Feed of the tool base.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Length of the feed; absent beside `tool.plan`: up to the target.
    #[schemars(range(min = 0.0, max = 200.0))]
    pub insertion_mm: f64,
    /// Tension at the end of the ramp; either this or `calibration`.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub tension_n: Option<f64>,
    /// A file of `trabecula calibrate`, from the scene file's folder: the ramp is then one of the bend up to
    /// that of the arc to `target_mm`, and the tension follows from the calibration. Either this or
    /// `tension_n`.
    #[schemars(extend("x-kind" = "path"))]
    pub calibration: Option<PathBuf>,
    /// What corrects the tension.
    #[serde(default)]
    pub feedback: Feedback,
    /// Inserted length at which the ramp begins.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 200.0))]
    pub ramp_start_mm: f64,
    /// Inserted length at which the ramp ends, more than its begin; absent beside `tool.plan`: at the target.
    #[schemars(range(min = 0.0, max = 200.0))]
    pub ramp_end_mm: f64,
    /// Burr speed.
    #[schemars(range(min = 0.0, max = 60_000.0))]
    pub burr_speed_rpm: f64,
    /// Where the burr is to end, patient frame; the feedback corrects the tension toward the arc to it. From
    /// `tool.plan`, if there is one.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub target_mm: Option<[f64; 3]>,
    /// Tension per millimetre of sideways error measured.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 10.0))]
    pub guidance_gain_n_per_mm: f64,
    /// Length by which the tool is drawn back at the end, so that the tunnel shows.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 200.0))]
    pub retraction_mm: f64,
    /// Speed of that.
    #[serde(default = "CurvedDrilling::default_retraction_mm_per_s")]
    #[schemars(range(min = 0.01, max = 100.0))]
    pub retraction_mm_per_s: f64,
}

defaults!(CurvedDrilling { default_retraction_mm_per_s: f64 = 10.0 });

/// What corrects the tension of curved drilling toward the planned path.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Feedback {
    /// The burr seen in X-ray frames; the feed waits for the first frame.
    #[default]
    Image,
    /// The measured shape (as by fibre Bragg gratings), 20 times a simulated second.
    Shape,
    /// Nothing: open loop.
    None,
}

/// A straight feed with the burr on. Where the bone is denser on one side, the burr skives: it leaves its
/// line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Skiving {
    /// Feed of the tool base.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Length of the feed; absent beside `tool.plan`: up to the target.
    #[schemars(range(min = 0.1, max = 200.0))]
    pub depth_mm: f64,
    /// Tension of both tendons, which stiffens the tool.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 60.0))]
    pub tension_n: f64,
    /// Burr speed.
    #[schemars(range(min = 0.0, max = 60_000.0))]
    pub burr_speed_rpm: f64,
}

/// Pulls tendon 0 in steps up and down again, with the arm held and the burr at rest. By tension (`most_n`,
/// `step_n`) or by displacement (`most_mm`, `step_mm`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TensionSweep {
    /// Greatest tension.
    #[schemars(range(min = 0.1, max = 60.0))]
    pub most_n: Option<f64>,
    /// Step of the tension, at most the greatest tension.
    #[schemars(range(min = 0.01, max = 60.0))]
    pub step_n: Option<f64>,
    /// Greatest displacement.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub most_mm: Option<f64>,
    /// Step of the displacement, at most the greatest displacement.
    #[schemars(range(min = 0.001, max = 20.0))]
    pub step_mm: Option<f64>,
    /// Time of each level: half of it to go there, half to settle.
    #[serde(default = "TensionSweep::default_settle_s")]
    #[schemars(range(min = 0.02, max = 60.0))]
    pub settle_s: f64,
}

impl TensionSweep {
    /// Whole steps up to the greatest level, the last one to it.
    pub fn steps(&self) -> usize {
        let most_and_step = self.most_n.zip(self.step_n).or(self.most_mm.zip(self.step_mm));
        let (most, step) = most_and_step.unwrap_or((0.0, 1.0));
        ((most / step) * (1.0 - 1e-9)).ceil().max(1.0) as usize
    }

    /// Simulated time of all levels, up and down again.
    pub fn duration_s(&self) -> f64 {
        self.settle_s * (2 * self.steps() + 1) as f64
    }
}

defaults!(TensionSweep { default_settle_s: f64 = 0.5 });

/// Turns the tube in the outer tube, then slides it out with the burr on, and at the end draws it back. The
/// arm is held.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TubeDeployment {
    /// How far the tube slides out; the tool's `outer_tube.travel_mm` at most.
    #[schemars(range(min = 0.0, max = MAX_DEPLOYED_M * 1e3))]
    pub deployed_mm: f64,
    /// Speed of that.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Angle about its own axis that it has first, from `tool.bend_toward` toward the direction across it.
    #[serde(default)]
    #[schemars(range(min = -360.0, max = 360.0))]
    pub roll_deg: f64,
    /// Burr speed.
    #[schemars(range(min = 0.0, max = 60_000.0))]
    pub burr_speed_rpm: f64,
    /// Length by which it is drawn back at the end, so that the tunnel shows.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = MAX_DEPLOYED_M * 1e3))]
    pub retraction_mm: f64,
}

/// Holds a tension, the tube and the arm, with the burr at rest; of these, what the controller drives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Hold {
    /// Tension of tendon 0.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub tension_n: f64,
}
