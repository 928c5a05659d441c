//! Sensitivity of a result to the parameters.

use xxhash_rust::xxh3::xxh3_64;

/// How much of a result's variance a parameter explains.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Index {
    /// First-order index: effect of the parameter alone. Saltelli et al. 2010 (doi
    /// 10.1016/j.cpc.2009.09.018), table 2, estimator (b).
    pub first_order: f64,
    /// Half of its 95 % interval.
    pub first_order_interval: f64,
    /// Total index: effect of the parameter including all interactions. Jansen 1999, estimator (f) of the
    /// same table.
    pub total: f64,
    /// Half of its 95 % interval.
    pub total_interval: f64,
}

/// Number of resamples for an interval.
const RESAMPLES: u64 = 200;

/// Returns the Sobol indices of each of `dimensions` parameters from the results of a Saltelli design in
/// point order, where `None` is a run without the result, and the number of samples excluded because a run
/// has no result. Intervals are 1.96 standard deviations over 200 resamples with a fixed seed.
///
/// Returns `None` if fewer than two samples remain or the result is constant.
pub fn indices(results: &[Option<f64>], dimensions: usize) -> Option<(Vec<Index>, usize)> {
    let samples: Vec<&[Option<f64>]> = results.chunks_exact(dimensions + 2).collect();
    let whole: Vec<Vec<f64>> =
        samples.iter().filter_map(|sample| sample.iter().copied().collect::<Option<Vec<f64>>>()).collect();
    let left_out = samples.len() - whole.len();
    let count = (whole.len() * (dimensions + 2)) as f64;
    let mean = whole.iter().flatten().sum::<f64>() / count;
    // Centre the results, because the scatter of the estimators is smallest around zero.
    let whole: Vec<Vec<f64>> =
        whole.into_iter().map(|sample| sample.into_iter().map(|y| y - mean).collect()).collect();
    let all: Vec<usize> = (0..whole.len()).collect();
    if all.len() < 2 || variance(&whole, &all, dimensions) <= 0.0 {
        return None;
    }
    let drawn: Vec<Vec<usize>> = (0..RESAMPLES).map(|resample| draw(resample, whole.len())).collect();
    let of_parameter = |parameter: usize| {
        let estimates = |pick: &[usize]| estimate(&whole, pick, dimensions, parameter);
        let (first_order, total) = estimates(&all);
        let resampled: Vec<(f64, f64)> = drawn.iter().map(|pick| estimates(pick)).collect();
        let interval = |of: fn(&(f64, f64)) -> f64| 1.96 * deviation(resampled.iter().map(of));
        Index {
            first_order,
            first_order_interval: interval(|both| both.0),
            total,
            total_interval: interval(|both| both.1),
        }
    };
    Some(((0..dimensions).map(of_parameter).collect(), left_out))
}

/// Draws `count` samples with replacement.
fn draw(resample: u64, count: usize) -> Vec<usize> {
    let number = |place: usize| xxh3_64(&[resample, place as u64].map(u64::to_le_bytes).concat());
    (0..count).map(|place| (number(place) % count as u64) as usize).collect()
}

/// Returns the variance of A and B together.
fn variance(samples: &[Vec<f64>], pick: &[usize], dimensions: usize) -> f64 {
    let both = pick.iter().flat_map(|&i| [samples[i][0], samples[i][dimensions + 1]]);
    deviation(both).powi(2)
}

/// Returns the first-order and total index of a parameter.
fn estimate(samples: &[Vec<f64>], pick: &[usize], dimensions: usize, parameter: usize) -> (f64, f64) {
    let variance = variance(samples, pick, dimensions);
    let (mut first, mut total) = (0.0, 0.0);
    for &i in pick {
        let (a, ab, b) = (samples[i][0], samples[i][parameter + 1], samples[i][dimensions + 1]);
        first += b * (ab - a);
        total += 0.5 * (a - ab) * (a - ab);
    }
    let count = pick.len() as f64;
    // A resample can consist of a single repeated sample.
    if variance > 0.0 { (first / count / variance, total / count / variance) } else { (0.0, 0.0) }
}

/// Returns the population standard deviation.
fn deviation(numbers: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = numbers.clone().count() as f64;
    let mean = numbers.clone().sum::<f64>() / count;
    (numbers.map(|x| (x - mean) * (x - mean)).sum::<f64>() / count).sqrt()
}

/// Returns Spearman's rank correlation: Pearson's of the ranks, with equal numbers sharing their mean rank.
/// `None` with fewer than three pairs or if one side is constant.
pub fn spearman(pairs: &[(f64, f64)]) -> Option<f64> {
    if pairs.len() < 3 {
        return None;
    }
    let (x, y) = (ranks(pairs.iter().map(|pair| pair.0)), ranks(pairs.iter().map(|pair| pair.1)));
    let mean = (pairs.len() + 1) as f64 / 2.0;
    let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - mean) * (b - mean)).sum::<f64>();
    let scale = (sum(&x, &x) * sum(&y, &y)).sqrt();
    (scale > 0.0).then(|| sum(&x, &y) / scale)
}

/// Returns ranks from 1.
fn ranks(numbers: impl Iterator<Item = f64>) -> Vec<f64> {
    let numbers: Vec<f64> = numbers.collect();
    let mut order: Vec<usize> = (0..numbers.len()).collect();
    order.sort_by(|&a, &b| numbers[a].total_cmp(&numbers[b]));
    let mut ranks = vec![0.0; numbers.len()];
    let mut first = 0;
    while first < order.len() {
        let equal =
            order[first..].iter().take_while(|&&i| numbers[i] == numbers[order[first]]).count().max(1);
        let rank = (2 * first + equal + 1) as f64 / 2.0;
        order[first..first + equal].iter().for_each(|&i| ranks[i] = rank);
        first += equal;
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_of_equal_numbers_are_shared() {
        assert_eq!(ranks([3.0, 1.0, 3.0, 2.0].into_iter()), [3.5, 1.0, 3.5, 2.0]);
        assert_eq!(spearman(&[(0.0, 1.0), (1.0, 8.0), (2.0, 27.0)]), Some(1.0));
        assert_eq!(spearman(&[(0.0, 1.0), (1.0, 1.0), (2.0, 1.0)]), None);
    }
}
