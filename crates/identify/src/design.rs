//! Design of experiments: which candidate would shrink the intervals most.
//!
//! The information of a candidate is JᵀJ of its planned measurements at the present estimate; information
//! adds up (Fedorov 1972, "Theory of Optimal Experiments").

use libm::{log, sqrt};
use nalgebra::DMatrix;

use crate::matrix::eigen;
use crate::uncertainty::{combinations, covariance};

/// Expected effect of a candidate experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Gain {
    /// Index of the candidate.
    pub candidate: usize,
    /// Expected standard deviations with it, as shares of the ranges.
    pub sd: Vec<f64>,
    /// Factor by which the volume of the confidence region shrinks: √(det before / det after).
    pub volume: f64,
}

/// Returns the standard deviations that an information matrix leads to, as shares of the ranges.
pub fn expected_sd(information: &DMatrix<f64>) -> Vec<f64> {
    let covariance = covariance(&combinations(information));
    (0..information.nrows()).map(|j| sqrt(covariance[(j, j)])).collect()
}

/// Returns ln det of an information matrix to which the ranges contribute as uniform priors.
fn log_volume(information: &DMatrix<f64>) -> f64 {
    eigen(information).iter().map(|(value, _)| log(value.max(0.0) + 12.0)).sum()
}

/// Returns the expected effect of each candidate, the most informative first.
pub fn rank(present: &DMatrix<f64>, candidates: &[DMatrix<f64>]) -> Vec<Gain> {
    let before = log_volume(present);
    let gain = |(candidate, more): (usize, &DMatrix<f64>)| {
        let with = present + more;
        Gain { candidate, sd: expected_sd(&with), volume: libm::exp(0.5 * (before - log_volume(&with))) }
    };
    let mut gains: Vec<Gain> = candidates.iter().enumerate().map(gain).collect();
    gains.sort_by(|a, b| a.volume.total_cmp(&b.volume).then(a.candidate.cmp(&b.candidate)));
    gains
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The present data measure a + b; candidates measure a + b again, a − b, and a − b ten times better.
    #[test]
    fn the_candidate_that_measures_what_is_not_known_comes_first() {
        let along = |row: [f64; 2], weight: f64| {
            DMatrix::from_fn(2, 2, |i, j| weight * row[i] * row[j])
        };
        let present = along([1.0, 1.0], 1e4);
        let candidates = [along([1.0, 1.0], 1e4), along([1.0, -1.0], 1e4), along([1.0, -1.0], 1e6)];
        let gains = rank(&present, &candidates);
        assert_eq!(gains.iter().map(|gain| gain.candidate).collect::<Vec<_>>(), [2, 1, 0]);
        // With 1e4 along both (1, 1) and (1, −1), the information is 2e4 on each axis.
        assert!((gains[1].sd[0] - 1.0 / sqrt(2e4)).abs() < 1e-12);
        assert!(gains[2].volume > 0.7 && gains[0].volume < 1e-2);
    }
}
