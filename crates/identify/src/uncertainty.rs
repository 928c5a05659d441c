//! How well the data determine the parameters.
//!
//! With J in units of the noise and of the ranges, 1/σ is the standard deviation, as a share of the range, of
//! the combination of parameters along a right singular vector of J. A combination that the data determine no
//! better than a uniform distribution over the range, 1/σ ≥ 1/√12, counts as undetermined.

use std::ops::Range;

use libm::sqrt;
use nalgebra::DMatrix;

use crate::matrix::{eigen, gram};
use crate::parameter::Parameter;
use crate::residual::ResidualStatistics;
use crate::solver::Optimum;

/// Variance of a uniform distribution over a range of 1.
const RANGE_VARIANCE: f64 = 1.0 / 12.0;
/// Share of a parameter in undetermined combinations from which the parameter itself is undetermined.
const UNDETERMINED_SHARE: f64 = 0.01;
/// 97.5 % quantile of the standard normal distribution.
const NORMAL_QUANTILE: f64 = 1.959_963_984_540_054;

/// A combination of parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Combination {
    /// Unit vector in the unit cube.
    pub direction: Vec<f64>,
    /// Singular value: how far the residuals move, in standard deviations, per range.
    pub singular_value: f64,
    /// Whether the data determine it.
    pub is_determined: bool,
}

/// Estimate of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Value.
    pub value: f64,
    /// Standard deviation, in the parameter's unit; `None` if the data do not determine it.
    pub sd: Option<f64>,
    /// Ends of the 95 % interval; those of the range if the data do not determine it.
    pub interval: [f64; 2],
    /// Whether the data determine it.
    pub is_determined: bool,
}

/// Uncertainty of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Uncertainty {
    /// Estimates, in the order of the parameters.
    pub estimates: Vec<Estimate>,
    /// Covariance in the unit cube.
    pub covariance: DMatrix<f64>,
    /// Correlation matrix; 0 where a parameter is fixed at its bound.
    pub correlation: DMatrix<f64>,
    /// Combinations, the best determined first.
    pub combinations: Vec<Combination>,
    /// Residuals of each series.
    pub series: Vec<ResidualStatistics>,
    /// Sum of squares over degrees of freedom.
    pub reduced_chi_square: f64,
    /// Number of residuals less the number of parameters.
    pub freedom: f64,
}

/// Information about the parameters, in the unit cube: JᵀWJ plus that of the priors.
pub fn information(
    parameters: &[Parameter],
    unit: &[f64],
    columns: &[Vec<f64>],
    weights: &[f64],
) -> DMatrix<f64> {
    let mut information = gram(columns, weights);
    for (j, parameter) in parameters.iter().enumerate() {
        if let Some(prior) = parameter.prior {
            let slope = parameter.slope(unit[j]) / prior.sd;
            information[(j, j)] += slope * slope;
        }
    }
    information
}

/// Returns the combinations of an information matrix.
pub fn combinations(information: &DMatrix<f64>) -> Vec<Combination> {
    let found = eigen(information);
    let combination = |(value, direction): (f64, Vec<f64>)| Combination {
        direction,
        singular_value: sqrt(value.max(0.0)),
        is_determined: value * RANGE_VARIANCE > 1.0,
    };
    found.into_iter().map(combination).collect()
}

/// Returns the covariance of these combinations, in the unit cube. An undetermined combination has the
/// variance of its range.
pub fn covariance(combinations: &[Combination]) -> DMatrix<f64> {
    let n = combinations.len();
    let mut out = DMatrix::zeros(n, n);
    for combination in combinations {
        let square = combination.singular_value * combination.singular_value;
        let variance = if combination.is_determined { 1.0 / square } else { RANGE_VARIANCE };
        for i in 0..n {
            for j in 0..n {
                out[(i, j)] += variance * combination.direction[i] * combination.direction[j];
            }
        }
    }
    out
}

/// Returns the 97.5 % quantile of Student's distribution (Cornish-Fisher expansion, Abramowitz and Stegun
/// 26.7.5); within 1 % from 4 degrees of freedom.
fn student_quantile(freedom: f64) -> f64 {
    let x = NORMAL_QUANTILE;
    let v = freedom.max(1.0);
    let g1 = (x.powi(3) + x) / 4.0;
    let g2 = (5.0 * x.powi(5) + 16.0 * x.powi(3) + 3.0 * x) / 96.0;
    let g3 = (3.0 * x.powi(7) + 19.0 * x.powi(5) + 17.0 * x.powi(3) - 15.0 * x) / 384.0;
    x + g1 / v + g2 / (v * v) + g3 / (v * v * v)
}

impl Uncertainty {
    /// Computes the uncertainty at an optimum. `series` holds the rows of each measured column, in the order
    /// of their times. A parameter at a bound counts as fixed. Where residuals are larger than the noise or
    /// correlated, the covariance is that of White (1980, Econometrica 48) with their inflation; the
    /// roughness of the model adds to it.
    pub fn of(parameters: &[Parameter], optimum: &Optimum, series: &[Range<usize>]) -> Uncertainty {
        let n = parameters.len();
        let whole = information(parameters, &optimum.unit, &optimum.columns, &optimum.weights);
        let all = combinations(&whole);
        let free: Vec<usize> = (0..n).filter(|&j| optimum.at_bound[j].is_none()).collect();
        let reduced = DMatrix::from_fn(free.len(), free.len(), |i, j| whole[(free[i], free[j])]);
        let inverse = covariance(&combinations(&reduced));
        let statistics: Vec<ResidualStatistics> = series
            .iter()
            .map(|rows| {
                let weighted = |i: usize| optimum.residuals[i] * sqrt(optimum.weights[i]);
                ResidualStatistics::of(&rows.clone().map(weighted).collect::<Vec<f64>>())
            })
            .collect();
        let mut middle = reduced.clone();
        for (rows, statistics) in series.iter().zip(&statistics) {
            if statistics.inflation > 1.0 {
                let part = |column: &Vec<f64>| column[rows.clone()].to_vec();
                let columns: Vec<Vec<f64>> = free.iter().map(|&j| part(&optimum.columns[j])).collect();
                middle += gram(&columns, &optimum.weights[rows.clone()]) * (statistics.inflation - 1.0);
            }
        }
        if let Some(roughness) = &optimum.roughness {
            middle += DMatrix::from_fn(free.len(), free.len(), |i, j| roughness[(free[i], free[j])]);
        }
        let is_plain =
            optimum.roughness.is_none() && statistics.iter().all(|statistics| statistics.inflation <= 1.0);
        let small = if is_plain { inverse } else { product(&product(&inverse, &middle), &inverse) };
        let mut covariance = DMatrix::zeros(n, n);
        for (i, &row) in free.iter().enumerate() {
            for (j, &column) in free.iter().enumerate() {
                covariance[(row, column)] = small[(i, j)];
            }
        }
        let residuals = optimum.residuals.iter().zip(&optimum.weights);
        let square: f64 = residuals.map(|(r, w)| w * r * r).sum();
        let freedom = (optimum.residuals.len() as f64 - free.len() as f64).max(1.0);
        let quantile = student_quantile(freedom);
        let estimate = |j: usize| estimate(&parameters[j], j, optimum, &covariance, &all, quantile);
        Uncertainty {
            estimates: (0..n).map(estimate).collect(),
            correlation: correlation(&covariance),
            covariance,
            combinations: all,
            series: statistics,
            reduced_chi_square: square / freedom,
            freedom,
        }
    }
}

fn estimate(
    parameter: &Parameter,
    j: usize,
    optimum: &Optimum,
    covariance: &DMatrix<f64>,
    combinations: &[Combination],
    quantile: f64,
) -> Estimate {
    let open = combinations.iter().filter(|combination| !combination.is_determined);
    let share: f64 = open.map(|combination| combination.direction[j] * combination.direction[j]).sum();
    let is_determined = share < UNDETERMINED_SHARE;
    let (unit, value) = (optimum.unit[j], optimum.values[j]);
    let sd = sqrt(covariance[(j, j)].max(0.0));
    let interval = match is_determined {
        true => [-1.0, 1.0].map(|side| parameter.value((unit + side * quantile * sd).clamp(0.0, 1.0))),
        false => [parameter.min, parameter.max],
    };
    let sd = is_determined.then(|| sd * parameter.slope(unit).abs());
    Estimate { value, sd, interval, is_determined }
}

/// Returns the product of two matrices, with a fixed order of sums.
fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(a.nrows(), b.ncols(), |i, j| (0..a.ncols()).map(|k| a[(i, k)] * b[(k, j)]).sum())
}

fn correlation(covariance: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(covariance.nrows(), covariance.ncols(), |i, j| {
        let scale = sqrt(covariance[(i, i)] * covariance[(j, j)]);
        if scale > 0.0 { covariance[(i, j)] / scale } else { 0.0 }
    })
}

/// Returns the standard deviation of each output, given its derivatives by the coordinates.
pub fn output_sd(columns: &[Vec<f64>], covariance: &DMatrix<f64>) -> Vec<f64> {
    let rows = columns.first().map_or(0, Vec::len);
    let n = columns.len();
    let variance = |row: usize| -> f64 {
        (0..n)
            .map(|i| (0..n).map(|j| columns[i][row] * covariance[(i, j)] * columns[j][row]).sum::<f64>())
            .sum()
    };
    (0..rows).map(|row| sqrt(variance(row).max(0.0))).collect()
}

/// Draws points from the normal distribution around a point of the unit cube, cut off at the ranges.
pub fn draws(unit: &[f64], covariance: &DMatrix<f64>, count: usize, seed: u64) -> Vec<Vec<f64>> {
    let axes = eigen(covariance);
    let key = counter_random::Key::of(seed);
    let draw = |number: usize| -> Vec<f64> {
        let mut at = unit.to_vec();
        for (axis, (variance, direction)) in axes.iter().enumerate() {
            let step = sqrt(variance.max(0.0)) * key.normal((number * axes.len() + axis) as u64);
            at.iter_mut().zip(direction).for_each(|(x, d)| *x += step * d);
        }
        at.iter().map(|x| x.clamp(0.0, 1.0)).collect()
    };
    (0..count).map(draw).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;

    /// Published quantiles: 2.571, 2.228, 2.042, 1.984.
    #[test]
    fn quantiles_of_student_are_those_of_the_tables() {
        for (freedom, table) in [(5.0, 2.571), (10.0, 2.228), (30.0, 2.042), (100.0, 1.984)] {
            assert!((student_quantile(freedom) - table).abs() < 5e-3, "{freedom}");
        }
    }

    /// The sample covariance of 20000 draws has a scatter of 1 % of the variances.
    #[test]
    fn draws_have_the_covariance() {
        let covariance = DMatrix::from_row_slice(2, 2, &[4e-4, 3e-4, 3e-4, 9e-4]);
        let points = draws(&[0.5, 0.5], &covariance, 20_000, 3);
        let moment = |i: usize, j: usize| {
            points.iter().map(|p| (p[i] - 0.5) * (p[j] - 0.5)).sum::<f64>() / points.len() as f64
        };
        for (i, j) in [(0, 0), (0, 1), (1, 1)] {
            assert!((moment(i, j) - covariance[(i, j)]).abs() < 4e-5, "{i} {j}");
        }
    }
}
