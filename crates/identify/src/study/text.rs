//! The study as TOML.

use std::path::PathBuf;

use serde::Deserialize;

use crate::parameter::Parameter;
use crate::quantity::{Body, Frame, Kind};

/// A value for all columns, or one for each.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub(super) enum OneOrEach {
    One(f64),
    Each(Vec<f64>),
}

impl OneOrEach {
    pub(super) fn each(&self, count: usize) -> Option<Vec<f64>> {
        match self {
            OneOrEach::One(value) => Some(vec![*value; count]),
            OneOrEach::Each(values) => (values.len() == count).then(|| values.clone()),
        }
    }
}

/// Loss functions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Loss {
    #[default]
    Squares,
    Huber,
}

/// Zero of a file's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClockZero {
    /// The clock's own.
    #[default]
    Clock,
    /// The first row of the commands; without commands, of the measured file.
    FirstRow,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Text {
    #[serde(default)]
    pub set: Vec<String>,
    pub starts: Option<u32>,
    #[serde(default)]
    pub seed: u32,
    pub iterations: Option<u32>,
    #[serde(default)]
    pub loss: Loss,
    pub huber_sd: Option<f64>,
    pub draws: Option<usize>,
    #[serde(default)]
    pub parameter: Vec<Parameter>,
    #[serde(default)]
    pub experiment: Vec<ExperimentText>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ExperimentText {
    pub name: String,
    pub scene: Option<PathBuf>,
    #[serde(default)]
    pub set: Vec<String>,
    pub duration_s: Option<f64>,
    #[serde(default)]
    pub held_out: bool,
    #[serde(default)]
    pub candidate: bool,
    pub file: Option<PathBuf>,
    pub time: Option<String>,
    pub time_unit: Option<String>,
    #[serde(default)]
    pub clock_offset_s: f64,
    #[serde(default)]
    pub clock_zero: ClockZero,
    pub commands: Option<CommandsText>,
    #[serde(default)]
    pub measured: Vec<MeasuredText>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CommandsText {
    pub log: Option<PathBuf>,
    pub controller: Option<String>,
    pub file: Option<PathBuf>,
    pub topic: Option<String>,
    pub time: Option<String>,
    pub time_unit: Option<String>,
    pub clock_offset_s: Option<f64>,
    pub tendon_mode: Option<String>,
    pub arm_mode: Option<String>,
    #[serde(default)]
    pub column: Vec<CommandColumnText>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CommandColumnText {
    pub name: Option<String>,
    pub field: String,
    pub column: Option<String>,
    pub value: Option<f64>,
    pub unit: Option<String>,
    pub gain: Option<f64>,
    pub bias: Option<f64>,
    pub delay_ms: Option<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MeasuredText {
    pub name: String,
    pub of: Kind,
    #[serde(default)]
    pub body: Option<Body>,
    pub link: Option<usize>,
    pub point_mm: Option<[f64; 3]>,
    pub frame: Option<Frame>,
    pub field: Option<String>,
    pub gauge_mm: Option<f64>,
    pub columns: Vec<String>,
    pub unit: String,
    pub noise: Option<OneOrEach>,
    pub file: Option<PathBuf>,
    pub topic: Option<String>,
    pub time: Option<String>,
    pub time_unit: Option<String>,
    pub delay_ms: Option<f64>,
    pub gain: Option<f64>,
    pub bias: Option<OneOrEach>,
    pub frame_mm: Option<[f64; 3]>,
    pub frame_deg: Option<[f64; 3]>,
    pub rate_hz: Option<f64>,
}
