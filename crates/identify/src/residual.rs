//! Statistics of the residuals of a measured column.

use libm::sqrt;
use serde::Serialize;

/// Lags of the test for whiteness, if there are enough residuals.
const LAGS: usize = 10;
/// Standard normal quantile of 99.99 %: about one white series in ten thousand is called correlated, more of
/// short ones.
const QUANTILE: f64 = 3.719_016_485_455_709;

/// Statistics of a series of residuals in units of the noise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ResidualStatistics {
    /// Number of residuals.
    pub count: usize,
    /// Mean.
    pub mean: f64,
    /// Root of the mean square; 1 if the noise is as stated and the model is right.
    pub rms: f64,
    /// Correlation of neighbours.
    pub lag_one: f64,
    /// Whether they are uncorrelated: Ljung-Box test (Ljung and Box 1978, Biometrika 65) at 99.99 %.
    pub is_white: bool,
    /// Factor of the variance of estimates because residuals are larger than the noise, or correlated; 1 if
    /// they are neither.
    pub inflation: f64,
}

impl ResidualStatistics {
    /// Computes the statistics of residuals in the order of their times.
    pub fn of(residuals: &[f64]) -> ResidualStatistics {
        let count = residuals.len();
        let n = count as f64;
        let square: f64 = residuals.iter().map(|r| r * r).sum::<f64>() / n.max(1.0);
        let mean = residuals.iter().sum::<f64>() / n.max(1.0);
        let correlation = |lag: usize| -> f64 {
            let pairs = residuals.iter().zip(&residuals[lag..]);
            let sum: f64 = pairs.map(|(a, b)| a * b).sum();
            if square > 0.0 { sum / (n * square) } else { 0.0 }
        };
        // About zero, not the mean: a constant error of the model is a correlation too.
        let lags = LAGS.min(count / 4);
        let correlations: Vec<f64> = (1..=lags).map(correlation).collect();
        let box_sum: f64 =
            correlations.iter().enumerate().map(|(i, rho)| rho * rho / (n - (i + 1) as f64)).sum();
        let is_white = lags == 0 || n * (n + 2.0) * box_sum <= chi_square_quantile(lags as f64, QUANTILE);
        let is_large = square * n > chi_square_quantile(n.max(1.0), QUANTILE);
        let time = if is_white { 1.0 } else { correlation_time(count, &correlation) };
        ResidualStatistics {
            count,
            mean,
            rms: sqrt(square),
            lag_one: correlations.first().copied().unwrap_or(0.0),
            is_white,
            inflation: time * if is_large { square } else { 1.0 },
        }
    }
}

/// Returns the quantile of χ² for one of the standard normal distribution (Wilson and Hilferty 1931, PNAS
/// 17); within 1 % from 10 degrees of freedom.
fn chi_square_quantile(freedom: f64, normal: f64) -> f64 {
    let a = 2.0 / (9.0 * freedom);
    let root = 1.0 - a + normal * sqrt(a);
    freedom * root * root * root
}

/// Returns 1 + 2 Σ ρ up to the first pair of lags with a negative sum (Geyer 1992, "Practical Markov chain
/// Monte Carlo", Stat. Sci. 7): how many residuals count as one.
fn correlation_time(count: usize, correlation: &impl Fn(usize) -> f64) -> f64 {
    let mut sum = 0.0;
    for pair in 0..count / 4 {
        let next = correlation(2 * pair + 1) + correlation(2 * pair + 2);
        if next <= 0.0 {
            break;
        }
        sum += next;
    }
    (1.0 + 2.0 * sum).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use counter_random::Key;

    fn noise(key: u64, count: u64) -> Vec<f64> {
        (0..count).map(|i| Key::of(key).normal(i)).collect()
    }

    /// Two tests at 99.99 %, the first of which rejects more often at 200 residuals: about 1 of 1000 on
    /// average.
    #[test]
    fn white_noise_is_called_white_and_leaves_intervals_as_they_are() {
        let called = (0..1000).map(|key| ResidualStatistics::of(&noise(key, 200)));
        let wrong = called.filter(|it| !it.is_white || it.inflation != 1.0).count();
        assert!(wrong <= 5, "{wrong} of 1000");
    }

    /// For a first-order process with correlation a, a count of (1 + a) / (1 − a) residuals counts as one: 19
    /// for a = 0.9, with a scatter of some 20 % at 5000 residuals.
    #[test]
    fn a_correlated_series_is_named_and_widens_intervals_by_its_correlation_time() {
        let mut series = Vec::new();
        let mut last = 0.0;
        for white in noise(7, 5000) {
            last = 0.9 * last + sqrt(1.0 - 0.81) * white;
            series.push(last);
        }
        let found = ResidualStatistics::of(&series);
        assert!(!found.is_white && (found.lag_one - 0.9).abs() < 0.03, "{found:?}");
        assert!((12.0..27.0).contains(&found.inflation), "{found:?}");
    }

    #[test]
    fn a_constant_error_is_not_white() {
        let shifted: Vec<f64> = noise(3, 100).iter().map(|x| x + 2.0).collect();
        let found = ResidualStatistics::of(&shifted);
        assert!(!found.is_white && found.inflation > 5.0 && (found.mean - 2.0).abs() < 0.4, "{found:?}");
    }

    /// 45.31 is the published 99.9 % quantile for 20 degrees of freedom, 29.59 that for 10; the formula
    /// is good to 1 %.
    #[test]
    fn quantiles_are_those_of_the_tables() {
        assert!((chi_square_quantile(20.0, 3.0902) - 45.31).abs() < 0.45);
        assert!((chi_square_quantile(10.0, 3.0902) - 29.59).abs() < 0.3);
    }
}
