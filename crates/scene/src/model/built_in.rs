//! The built-in controllers: `curved_drilling`, `skiving`, `tension_sweep`, `tube_deployment`, `hold`.

use std::path::PathBuf;

use messages::MAX_DEPLOYED_M;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::FARTHEST_MM;

/// Curved drilling: advances with the burr on, pulls the tendon along a ramp, and corrects the tension by
/// feedback.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CurvedDrilling {
    /// Feed of the tool base.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Length of the feed; absent with `tool.plan`: up to the target.
    #[schemars(range(min = 0.0, max = 200.0))]
    pub insertion_mm: f64,
    /// Tension at the end of the ramp; either this or `calibration`.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub tension_n: Option<f64>,
    /// A file from `trabecula calibrate`, relative to the scene file's folder: the ramp is then in bend, up
    /// to that of the arc to `target_mm`, and the tension follows from the calibration. Either this or
    /// `tension_n`.
    #[schemars(extend("x-kind" = "path"))]
    pub calibration: Option<PathBuf>,
    /// What the tension is corrected by.
    #[serde(default)]
    pub feedback: Feedback,
    /// Inserted length at which the ramp begins.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 200.0))]
    pub ramp_start_mm: f64,
    /// Inserted length at which the ramp ends, not before its start; absent with `tool.plan`: at the target.
    #[schemars(range(min = 0.0, max = 200.0))]
    pub ramp_end_mm: f64,
    /// Burr speed.
    #[schemars(range(min = 0.0, max = 60_000.0))]
    pub burr_speed_rpm: f64,
    /// Target of the burr, patient frame; feedback corrects the tension toward the arc to it. Taken from
    /// `tool.plan`, if there is one.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub target_mm: Option<[f64; 3]>,
    /// Tension per millimetre of measured lateral error.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 10.0))]
    pub guidance_gain_n_per_mm: f64,
    /// Length by which the tool is retracted at the end, so that the tunnel becomes visible.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 200.0))]
    pub retraction_mm: f64,
    /// Speed of the retraction.
    #[serde(default = "CurvedDrilling::default_retraction_mm_per_s")]
    #[schemars(range(min = 0.01, max = 100.0))]
    pub retraction_mm_per_s: f64,
}

defaults!(CurvedDrilling { default_retraction_mm_per_s: f64 = 10.0 });

/// What corrects the tension of curved drilling toward the planned path.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Feedback {
    /// The burr as seen in X-ray frames; the feed waits for the first frame.
    #[default]
    Image,
    /// The measured shape (as by fibre Bragg gratings), 20 times per simulated second.
    Shape,
    /// Nothing: open loop.
    None,
}

/// A straight feed with the burr on. Where the bone is denser on one side, the burr skives: it deviates from
/// its line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Skiving {
    /// Feed of the tool base.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Length of the feed; absent with `tool.plan`: up to the target.
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

/// Ramps tendon 0 up and down in steps, with the arm held and the burr at rest: by tension (`most_n`,
/// `step_n`) or by displacement (`most_mm`, `step_mm`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TensionSweep {
    /// Largest tension.
    #[schemars(range(min = 0.1, max = 60.0))]
    pub most_n: Option<f64>,
    /// Tension step, at most the largest tension.
    #[schemars(range(min = 0.01, max = 60.0))]
    pub step_n: Option<f64>,
    /// Largest displacement.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub most_mm: Option<f64>,
    /// Displacement step, at most the largest displacement.
    #[schemars(range(min = 0.001, max = 20.0))]
    pub step_mm: Option<f64>,
    /// Time per level: half of it to reach it, half to settle.
    #[serde(default = "TensionSweep::default_settle_s")]
    #[schemars(range(min = 0.02, max = 60.0))]
    pub settle_s: f64,
}

impl TensionSweep {
    /// Number of steps up to the largest level; the last one ends there.
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

/// Rotates the tube inside the outer tube, then slides it out with the burr on, and finally retracts it. The
/// arm is held.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TubeDeployment {
    /// Length by which the tube slides out; at most the tool's `outer_tube.travel_mm`.
    #[schemars(range(min = 0.0, max = MAX_DEPLOYED_M * 1e3))]
    pub deployed_mm: f64,
    /// Deployment speed.
    #[schemars(range(min = 0.01, max = 20.0))]
    pub feed_mm_per_s: f64,
    /// Roll about its own axis before it slides out, from `tool.bend_toward` toward the direction across it.
    #[serde(default)]
    #[schemars(range(min = -360.0, max = 360.0))]
    pub roll_deg: f64,
    /// Burr speed.
    #[schemars(range(min = 0.0, max = 60_000.0))]
    pub burr_speed_rpm: f64,
    /// Length by which it is retracted at the end, so that the tunnel becomes visible.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = MAX_DEPLOYED_M * 1e3))]
    pub retraction_mm: f64,
}

/// Holds a tension, the tube and the arm, as far as the controller drives them, with the burr at rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Hold {
    /// Tension of tendon 0.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub tension_n: f64,
}
