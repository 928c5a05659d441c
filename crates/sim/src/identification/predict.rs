//! Bands of predicted values.

use identify::{Model, Parameter, draws, output_sd};
use nalgebra::DMatrix;
use serde::Serialize;

use super::model::ExperimentModel;
use crate::error::SimError;

/// 97.5 % quantile of the standard normal distribution.
pub(super) const NORMAL_QUANTILE: f64 = 1.959_963_984_540_054;

/// Width of the 95 % band of a column's true values.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Band {
    /// Largest half width that follows from the parameters by linearisation, in the unit.
    pub linear: f64,
    /// The same by sampling; `None` where it is not sampled.
    pub sampled: Option<f64>,
    /// Half width that the error of the model adds: residuals beyond the noise.
    pub model: f64,
    /// Share of the measured values within the band of measurements; `None` for a prediction.
    pub coverage: Option<f64>,
}

/// Returns the standard deviation of each output of a model, in its unit, that follows from the parameters.
pub(super) fn linear_sd(
    model: &ExperimentModel<'_>,
    columns: &[Vec<f64>],
    covariance: &DMatrix<f64>,
) -> Vec<f64> {
    let mut sd = output_sd(columns, covariance);
    for column in &model.columns {
        sd[column.place.clone()].iter_mut().for_each(|sd| *sd *= column.noise);
    }
    sd
}

/// Returns half the width between the 2.5 % and 97.5 % quantiles of each output over draws of the
/// parameters, in units of the noise. Draws at which a scene is refused do not count.
pub(super) fn sampled_half_widths(
    model: &mut ExperimentModel<'_>,
    parameters: &[Parameter],
    unit: &[f64],
    covariance: &DMatrix<f64>,
    (count, seed): (usize, u32),
) -> Result<Vec<f64>, SimError> {
    let points: Vec<Vec<f64>> = draws(unit, covariance, count, u64::from(seed))
        .iter()
        .map(|unit| parameters.iter().zip(unit).map(|(parameter, unit)| parameter.value(*unit)).collect())
        .collect();
    let mut outputs: Vec<Vec<f64>> = Vec::new();
    // Some at a time, because the traces of a request are kept.
    for points in points.chunks(16) {
        outputs.extend(model.residuals(points)?.into_iter().flatten());
    }
    let rows = outputs.first().map_or(0, Vec::len);
    let half_width = |row: usize| {
        let mut values: Vec<f64> = outputs.iter().map(|output| output[row]).collect();
        values.sort_by(f64::total_cmp);
        0.5 * (quantile(&values, 0.975) - quantile(&values, 0.025))
    };
    Ok((0..rows).map(half_width).collect())
}

/// Returns a quantile of sorted values, linear between them (Hyndman and Fan 1996, definition 8, which is
/// median-unbiased).
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let n = sorted.len() as f64;
    let place = ((n + 1.0 / 3.0) * share + 1.0 / 3.0 - 1.0).clamp(0.0, n - 1.0);
    let (before, after) = (place.floor() as usize, place.ceil() as usize);
    sorted[before] + (place - before as f64) * (sorted[after] - sorted[before])
}
