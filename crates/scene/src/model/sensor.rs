//! `[[sensor]]`: sensors of the tool.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{FARTHEST_MM, NAME, NAME_EXPECTED};

/// A sensor. Its kind is exactly one of `fbg`, `tracker`, `encoders`, `load_cell` and `force_torque`.
/// Controllers get its readings beside the exact state, at the tick at which they arrive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Name.
    #[schemars(regex(pattern = NAME), extend("patternErrorMessage" = NAME_EXPECTED))]
    pub name: String,
    /// Readings per second, at most one per tick.
    #[schemars(range(min = 0.1, max = 10_000.0))]
    pub rate_hz: f64,
    /// Delay from the measured state to the state with which the reading arrives.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 10_000.0))]
    pub delay_ms: f64,
    /// Additional delay, uniform between 0 and this for each reading; readings do not overtake each other.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 10_000.0))]
    pub jitter_ms: f64,
    /// Fraction of readings that drop out: they arrive with `valid` 0 and without values.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub dropout: f64,
    /// Seed of its noise, bias, drift, jitter and drop-outs, combined with `run.seed` and its index in the
    /// scene.
    #[serde(default)]
    #[schemars(range(min = 0, max = 9_007_199_254_740_991_u64))]
    pub seed: u64,
    /// Curvature along the tool by fibre-Bragg gratings.
    pub fbg: Option<Fbg>,
    /// Pose of the tool in the patient frame.
    pub tracker: Option<Tracker>,
    /// Angles of the arm's joints.
    pub encoders: Option<Encoders>,
    /// Tensions of the tendons.
    pub load_cell: Option<LoadCell>,
    /// Force and torque between flange and tool.
    pub force_torque: Option<ForceTorque>,
}

/// Fibre-Bragg gratings along the flexible part of the tool. By default three nodes, as in Ma et al. 2023
/// (arXiv 2303.03613), with noise and bias for which the tip error is about that paper's mean shape error,
/// 0.22 mm (docs/sensors.md).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Fbg {
    /// Number of nodes, evenly spaced along the flexible part.
    #[serde(default = "Fbg::default_nodes")]
    #[schemars(range(min = 1, max = 16))]
    pub nodes: u32,
    /// Length of fibre that a node averages over (assumed).
    #[serde(default = "Fbg::default_gauge_mm")]
    #[schemars(range(min = 0.1, max = 100.0))]
    pub gauge_mm: f64,
    /// Standard deviation of the noise of each curvature.
    #[serde(default = "Fbg::default_noise_per_m")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub noise_per_m: f64,
    /// Standard deviation of each curvature's constant error, drawn once per run.
    #[serde(default = "Fbg::default_bias_per_m")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub bias_per_m: f64,
}

defaults!(Fbg {
    default_nodes: u32 = 3,
    default_gauge_mm: f64 = 5.0,
    default_noise_per_m: f64 = 0.2,
    default_bias_per_m: f64 = 0.5,
});

/// A tracker: electromagnetic, or optical with a line of sight from `camera_mm`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Tracker {
    /// What carries the marker.
    #[serde(default)]
    pub on: Tracked,
    /// Standard deviation of the position along each axis; the default, an assumption, is typical of
    /// electromagnetic trackers.
    #[serde(default = "Tracker::default_position_noise_mm")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub position_noise_mm: f64,
    /// Standard deviation of the rotation about each axis of the marker, likewise.
    #[serde(default = "Tracker::default_orientation_noise_deg")]
    #[schemars(range(min = 0.0, max = 30.0))]
    pub orientation_noise_deg: f64,
    /// Position of the camera of an optical tracker, patient frame; absent: electromagnetic, which needs no
    /// line of sight.
    #[schemars(inner(range(min = -FARTHEST_MM, max = FARTHEST_MM)))]
    pub camera_mm: Option<[f64; 3]>,
    /// Direction in which the marker of an optical tracker faces, in the axes of its carrier; by default back
    /// along the tool.
    #[serde(default = "Tracker::default_marker_faces")]
    #[schemars(inner(range(min = -1000.0, max = 1000.0)))]
    pub marker_faces: [f64; 3],
    /// Largest angle between that direction and the camera at which the marker is still visible (assumed).
    #[serde(default = "Tracker::default_view_deg")]
    #[schemars(range(min = 1.0, max = 180.0))]
    pub view_deg: f64,
}

defaults!(Tracker {
    default_position_noise_mm: f64 = 0.3,
    default_orientation_noise_deg: f64 = 0.2,
    default_marker_faces: [f64; 3] = [0.0, 0.0, -1.0],
    default_view_deg: f64 = 60.0,
});

/// What carries a tracker's marker.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Tracked {
    /// The burr: its centre, axes of the last link.
    #[default]
    Burr,
    /// The start of the tool's shaft.
    Base,
    /// The arm's flange.
    Flange,
}

/// Encoders of the arm's joints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Encoders {
    /// Quantization step; 0: none. The default, an assumption, is a 17-bit encoder on the joint.
    #[serde(default = "Encoders::default_resolution_deg")]
    #[schemars(range(min = 0.0, max = 10.0))]
    pub resolution_deg: f64,
    /// Standard deviation of each angle.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 10.0))]
    pub noise_deg: f64,
}

defaults!(Encoders {
    // 360° / 2¹⁷.
    default_resolution_deg: f64 = 0.002_746_582_031_25,
});

/// Load cells at the tendons' proximal ends.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LoadCell {
    /// Standard deviation of each tension (assumed).
    #[serde(default = "LoadCell::default_noise_n")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub noise_n: f64,
    /// Standard deviation of each tension's constant error, drawn once per run.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub bias_n: f64,
    /// Quantization step; 0: none.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub resolution_n: f64,
}

defaults!(LoadCell { default_noise_n: f64 = 0.05 });

/// A six-axis force/torque sensor between flange and tool. It measures what the tool exerts on the flange,
/// about the tool's base and in its axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ForceTorque {
    /// Standard deviation of each force (assumed).
    #[serde(default = "ForceTorque::default_noise_n")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub noise_n: f64,
    /// Standard deviation of each torque (assumed).
    #[serde(default = "ForceTorque::default_noise_nm")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub noise_nm: f64,
    /// Random walk of each force: its standard deviation after one second; it grows with the square root of
    /// time.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub drift_n: f64,
    /// Random walk of each torque, likewise.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub drift_nm: f64,
    /// Corner frequency of a first-order low-pass filter before the noise; absent: none.
    #[schemars(range(min = 0.01, max = 10_000.0))]
    pub low_pass_hz: Option<f64>,
}

defaults!(ForceTorque { default_noise_n: f64 = 0.02, default_noise_nm: f64 = 0.001 });
