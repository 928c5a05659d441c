//! A study: the validated file of an identification.

mod check;
mod target;
mod text;

use std::path::{Path, PathBuf};

use crate::parameter::Parameter;
use crate::quantity::Quantity;
use crate::signal::{Shape, Signal};
use crate::solver::Method;

pub use sweep::StudyError;
pub use target::{CommandPart, SignalPart, Target};
pub use text::ClockZero;

/// Maximum number of parameters of a study.
pub const MAX_PARAMETERS: usize = 32;
/// Maximum number of experiments of a study.
pub const MAX_EXPERIMENTS: usize = 64;
/// Maximum number of measured quantities of an experiment.
pub const MAX_MEASURED: usize = 32;
/// Maximum number of starting points.
pub const MAX_STARTS: u32 = 64;
/// Maximum number of draws of a prediction band.
pub const MAX_DRAWS: usize = 10_000;

/// A study.
#[derive(Debug, Clone, PartialEq)]
pub struct Study {
    /// Parameters.
    pub parameters: Vec<Parameter>,
    /// What each parameter sets.
    pub targets: Vec<Target>,
    /// Experiments.
    pub experiments: Vec<Experiment>,
    /// How to fit.
    pub method: Method,
    /// Number of draws of a prediction band.
    pub draws: usize,
}

/// What an experiment is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Its measurements are fitted.
    Fitted,
    /// Its measurements test the fit.
    HeldOut,
    /// It has no measurements: the fit predicts them.
    Predicted,
    /// It may be done next: `--design` says how much it would help.
    Candidate,
}

/// An experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Experiment {
    /// Name.
    pub name: String,
    /// Scene, relative to the study's folder; `None`: that of the log of its commands.
    pub scene: Option<PathBuf>,
    /// Settings of the scene, those of the study first.
    pub set: Vec<String>,
    /// Simulated time; `None`: up to the last measured row, or the scene's duration.
    pub duration_s: Option<f64>,
    /// What it is for.
    pub role: Role,
    /// What drives it.
    pub commands: Commands,
    /// Time of the measured file's clock at tick 0, s.
    pub clock_offset_s: f64,
    /// Zero of the clocks of its files.
    pub clock_zero: ClockZero,
    /// What is measured.
    pub measured: Vec<Measured>,
}

/// What drives an experiment.
#[derive(Debug, Clone, PartialEq)]
pub enum Commands {
    /// The scene's own built-in controllers.
    Scene,
    /// The commands of a log.
    Log(PathBuf),
    /// Columns of a file.
    Table(CommandTable),
}

/// Columns of a file that are a controller's commands.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandTable {
    /// Controller; `None`: the scene's only one.
    pub controller: Option<String>,
    /// Where the columns are.
    pub source: Source,
    /// Time of the file's clock at tick 0, s.
    pub clock_offset_s: f64,
    /// Codes of `tendon_mode`, `arm_mode`, `burr_mode` and `tube_mode`.
    pub modes: [u32; 4],
    /// Columns.
    pub columns: Vec<CommandColumn>,
}

/// A field of a command.
#[derive(Debug, Clone, PartialEq)]
pub struct CommandColumn {
    /// Name for `command.NAME.gain`; the field's, if the study gives none.
    pub name: String,
    /// Path of the field.
    pub field: String,
    /// Column of the file, or a constant in the unit.
    pub from: ColumnOrValue,
    /// Size of its unit in SI units.
    pub unit: f64,
    /// Factor of the column.
    pub gain: f64,
    /// Added to the column, in its unit.
    pub bias: f64,
    /// Time from a row until the plant obeys it, s.
    pub delay_s: f64,
}

/// Where a command's value comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum ColumnOrValue {
    /// A column of the file.
    Column(String),
    /// A constant.
    Value(f64),
}

/// Where columns are.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Source {
    /// CSV, Parquet, MCAP, or a rosbag2 folder; relative to the study's folder.
    pub file: PathBuf,
    /// Topic, for MCAP and rosbag2.
    pub topic: Option<String>,
    /// Column with the time; `None`: the log time of an MCAP.
    pub time: Option<String>,
    /// Name of its unit.
    pub time_unit: String,
}

/// A measured quantity.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Name of the sensor; one name in several experiments is the same sensor.
    pub name: String,
    /// What it measures.
    pub quantity: Quantity,
    /// Shape of its values.
    pub shape: Shape,
    /// Columns; an empty name: not measured.
    pub columns: Vec<String>,
    /// Name of the unit.
    pub unit_name: String,
    /// Size of the unit in SI units.
    pub unit: f64,
    /// Standard deviation of each column's noise, in the unit; `None`: estimated from the residuals.
    pub noise: Option<Vec<f64>>,
    /// Where the columns are; `None` for experiments without measurements.
    pub source: Option<Source>,
    /// The sensor's parameters, where the study does not estimate them.
    pub signal: Signal,
    /// Readings per second, for simulated and planned measurements.
    pub rate_hz: Option<f64>,
}

impl Study {
    /// Parses a study; `file` names it in errors.
    ///
    /// # Errors
    /// Not TOML, an unknown key, a value out of range, or keys that contradict each other.
    pub fn parse(text: &str, file: &Path) -> Result<Study, StudyError> {
        check::study(text, file)
    }

    /// Returns the settings `KEY=VALUE` of a scene for values of the parameters.
    pub fn settings(&self, values: &[f64]) -> Vec<String> {
        let pairs = self.targets.iter().zip(values);
        let scene = pairs.filter_map(|(target, value)| match target {
            Target::Scene(key) => Some(format!("{key}={value:?}")),
            _ => None,
        });
        scene.collect()
    }

    /// Returns the clock offset and a sensor's parameters for values of the parameters.
    pub fn signal(&self, experiment: usize, measured: &Measured, values: &[f64]) -> (f64, Signal) {
        let mut offset_s = self.experiments[experiment].clock_offset_s;
        let mut signal = measured.signal.clone();
        for (target, value) in self.targets.iter().zip(values) {
            match target {
                Target::ClockOffset { experiment: at } if *at == experiment => offset_s = *value,
                Target::Measured { name, part } if *name == measured.name => part.put(&mut signal, *value),
                _ => {}
            }
        }
        (offset_s, signal)
    }

    /// Returns gain, bias and delay in seconds of a command's column for values of the parameters.
    pub fn command(&self, column: &CommandColumn, values: &[f64]) -> (f64, f64, f64) {
        let (mut gain, mut bias, mut delay_s) = (column.gain, column.bias, column.delay_s);
        for (target, value) in self.targets.iter().zip(values) {
            if let Target::Command { name, part } = target
                && *name == column.name
            {
                match part {
                    CommandPart::Gain => gain = *value,
                    CommandPart::Bias => bias = *value,
                    CommandPart::Delay => delay_s = *value * 1e-3,
                }
            }
        }
        (gain, bias, delay_s)
    }
}
