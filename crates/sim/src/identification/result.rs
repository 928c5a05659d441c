//! Results of an identification.

use identify::signal::RowCount;
use identify::{Bound, ResidualStatistics, Stop};
use serde::Serialize;

use super::predict::Band;

/// Estimate of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ParameterReport {
    /// Key.
    pub key: String,
    /// Estimate, in the key's unit.
    pub value: f64,
    /// Its standard deviation; `None` if the data do not determine it, or it is at a bound.
    pub sd: Option<f64>,
    /// Ends of the 95 % interval; those of the range if the data do not determine it.
    pub interval: [f64; 2],
    /// Whether the data determine it.
    pub is_determined: bool,
    /// Bound that it is pressed against.
    pub at_bound: Option<Bound>,
    /// Value at the first starting point.
    pub start: f64,
    /// Range.
    pub range: [f64; 2],
}

/// A measured column.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ColumnReport {
    /// Name in the file.
    pub name: String,
    /// Standard deviation of its noise, in the unit.
    pub noise: f64,
    /// Whether the noise was estimated from the residuals.
    pub noise_is_estimated: bool,
    /// Root mean square of simulated minus measured, in the unit; `None` for a prediction.
    pub rms: Option<f64>,
    /// Statistics of the residuals in units of the noise; `None` for a prediction.
    pub residuals: Option<ResidualStatistics>,
    /// Band of the true values.
    pub band: Band,
}

/// A measured quantity.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasuredReport {
    /// Name of the sensor.
    pub name: String,
    /// Unit of all numbers.
    pub unit: String,
    /// What became of the rows of its file.
    pub rows: RowCount,
    /// Columns.
    pub columns: Vec<ColumnReport>,
}

/// An experiment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExperimentReport {
    /// Name.
    pub name: String,
    /// `fitted`, `held_out`, `predicted` or `candidate`.
    pub role: &'static str,
    /// Simulated time, s.
    pub simulated_s: f64,
    /// Measured quantities.
    pub measured: Vec<MeasuredReport>,
}

/// A column over time, for figures.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name of the experiment.
    pub experiment: String,
    /// Role of the experiment.
    pub role: &'static str,
    /// Name of the sensor.
    pub sensor: String,
    /// Name of the column.
    pub column: String,
    /// Unit.
    pub unit: String,
    /// Times on the clock of the file, s.
    pub times_s: Vec<f64>,
    /// Measured values; empty for a prediction.
    pub measured: Vec<f64>,
    /// Simulated values.
    pub simulated: Vec<f64>,
    /// Standard deviation of the true value around the simulated one.
    pub sd: Vec<f64>,
    /// Standard deviation of the noise.
    pub noise: f64,
}

/// A finished identification.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FitReport {
    /// Estimates, in the order of the study.
    pub parameters: Vec<ParameterReport>,
    /// Covariance in the parameters' units.
    pub covariance: Vec<Vec<f64>>,
    /// Correlation matrix.
    pub correlation: Vec<Vec<f64>>,
    /// What the data do not determine, in words.
    pub undetermined: Vec<String>,
    /// What deserves attention.
    pub cautions: Vec<String>,
    /// Why the fit ended.
    pub stop: Stop,
    /// Steps of the fit.
    pub iterations: u32,
    /// Points at which the experiments were evaluated.
    pub evaluations: u64,
    /// Simulated time in all, s.
    pub simulated_s: f64,
    /// Half the sum of squares in units of the noise, before and after the fit, with the priors.
    pub cost: [f64; 2],
    /// The same reached from each starting point.
    pub costs: Vec<Option<f64>>,
    /// Sum of squares over degrees of freedom.
    pub reduced_chi_square: f64,
    /// Number of residuals.
    pub residual_count: usize,
    /// Experiments.
    pub experiments: Vec<ExperimentReport>,
    /// Estimated scene keys as TOML.
    pub toml: String,
    /// Estimated scene keys as `KEY=VALUE`.
    pub settings: Vec<String>,
    /// Columns over time.
    #[serde(skip)]
    pub series: Vec<Series>,
}

/// A comparison without a fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckReport {
    /// Number of parameters.
    pub parameters: usize,
    /// Number of residuals.
    pub residual_count: usize,
    /// Starting point.
    pub start: Vec<(String, f64)>,
    /// Sum of squares over the number of residuals at the starting point.
    pub mean_square: f64,
    /// Experiments.
    pub experiments: Vec<ExperimentReport>,
    /// Notes about the scenes.
    pub notes: Vec<String>,
}

/// A candidate experiment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CandidateReport {
    /// Name.
    pub name: String,
    /// Expected half widths of the 95 % intervals with it, in the parameters' units.
    pub half_widths: Vec<f64>,
    /// Factor by which the volume of the confidence region shrinks.
    pub volume: f64,
}

/// A ranking of candidate experiments.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DesignReport {
    /// Keys of the parameters.
    pub parameters: Vec<String>,
    /// Values at which the experiments are linearised.
    pub values: Vec<f64>,
    /// Half widths of the present 95 % intervals.
    pub half_widths: Vec<f64>,
    /// Candidates, the best first.
    pub candidates: Vec<CandidateReport>,
}
