//! The solver against closed forms and published problems.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::convert::Infallible;

use counter_random::Key;
use identify::wording::undetermined;
use identify::{Bound, Method, Model, Outcome, Parameter, Prior, Scale, SolveError, Stop, Uncertainty, fit};

/// Residuals as a function of the values.
struct Closed<F>(F);

impl<F: Fn(&[f64]) -> Outcome> Model for Closed<F> {
    type Error = Infallible;

    fn residuals(&mut self, points: &[Vec<f64>]) -> Result<Vec<Outcome>, Infallible> {
        Ok(points.iter().map(|point| (self.0)(point)).collect())
    }
}

fn parameter(key: &str, min: f64, max: f64) -> Parameter {
    Parameter { key: key.to_owned(), min, max, scale: Scale::Linear, start: None, step: None, prior: None }
}

const METHOD: Method = Method { starts: 1, seed: 0, iterations: 200, huber: None };

fn noise(key: u64, i: usize) -> f64 {
    Key::of(key).normal(i as u64)
}

/// Rosenbrock's function from (−1.2, 1) has its minimum 0 at (1, 1).
#[test]
fn rosenbrocks_valley_is_followed_to_its_end() {
    let mut model = Closed(|p: &[f64]| Ok(vec![10.0 * (p[1] - p[0] * p[0]), 1.0 - p[0]]));
    let parameters = [parameter("a", -2.0, 2.0), parameter("b", -2.0, 2.0)];
    let found = fit(&mut model, &parameters, &[0.2, 0.75], METHOD).unwrap();
    assert_eq!(found.best.stop, Stop::Converged);
    // The remaining objective is below the negligible decrease, 1e-9, hence |1 − a| < 5e-5.
    assert!(found.best.values.iter().all(|x| (x - 1.0).abs() < 2e-4), "{:?}", found.best.values);
}

/// With a ≤ 0.5, the minimum is at (0.5, 0.25): b is free, and a presses against its bound.
#[test]
fn a_bound_is_named_and_the_other_parameters_still_reach_their_optimum() {
    let mut model = Closed(|p: &[f64]| Ok(vec![10.0 * (p[1] - p[0] * p[0]), 1.0 - p[0]]));
    let parameters = [parameter("a", -2.0, 0.5), parameter("b", -2.0, 2.0)];
    let found = fit(&mut model, &parameters, &[0.2, 0.75], METHOD).unwrap();
    assert_eq!(found.best.at_bound, [Some(Bound::Max), None]);
    assert_eq!(found.best.values[0], 0.5);
    assert!((found.best.values[1] - 0.25).abs() < 1e-5, "{:?}", found.best.values);
}

/// A decay with known parameters: estimates scatter by the reported covariance. Of 400 intervals per
/// parameter, 95 % hold the truth; the binomial scatter is 1.1 %, and four times that is allowed.
#[test]
fn intervals_of_a_nonlinear_model_hold_the_truth_as_often_as_they_say() {
    let truth = [2.0, 0.7, 0.1];
    let curve = |p: &[f64], i: usize| p[0] * (-p[1] * 0.05 * i as f64).exp() + p[2];
    let parameters = [parameter("a", 0.5, 5.0), parameter("k", 0.1, 3.0), parameter("c", -1.0, 1.0)];
    let mut held = [0; 3];
    for study in 0..400 {
        let mut model = Closed(|p: &[f64]| {
            Ok((0..80).map(|i| (curve(p, i) - curve(&truth, i)) / 0.05 - noise(study, i)).collect())
        });
        let found = fit(&mut model, &parameters, &[0.5, 0.5, 0.5], METHOD).unwrap();
        let uncertainty = Uncertainty::of(&parameters, &found.best, std::slice::from_ref(&(0..80)));
        for ((estimate, truth), held) in uncertainty.estimates.iter().zip(truth).zip(&mut held) {
            *held += usize::from(estimate.interval[0] <= truth && truth <= estimate.interval[1]);
        }
    }
    assert!(held.iter().all(|held| (362..=398).contains(held)), "{held:?} of 400");
}

/// The normal equations of a prior N(1, 0.5²) and one measurement of 2 with noise 1: the mean of both,
/// weighted by 4 and 1, with variance 1/5.
#[test]
fn a_prior_counts_as_a_measurement() {
    let mut prior = parameter("a", -5.0, 5.0);
    prior.prior = Some(Prior { mean: 1.0, sd: 0.5 });
    let mut model = Closed(|p: &[f64]| Ok(vec![p[0] - 2.0]));
    let found = fit(&mut model, &[prior.clone()], &[0.9], METHOD).unwrap();
    assert!((found.best.values[0] - 1.2).abs() < 1e-6, "{:?}", found.best.values);
    let uncertainty = Uncertainty::of(&[prior], &found.best, std::slice::from_ref(&(0..1)));
    assert!((uncertainty.estimates[0].sd.unwrap() - 0.2_f64.sqrt()).abs() < 1e-6);
}

/// Huber's location estimate: the mean of the good data plus a bounded pull of each outlier. For k = 1
/// and the data −1, 0, 1 and 100, the condition Σ ψ = 0 gives (−1 + 0 + 1 − 3 x) + 1 = 0, x = 1/3, where
/// 1 − 1/3 and the others but −1 (clipped at −1 − 1/3) lie within k: −1 (clipped) + (0 − x) + (1 − x) + 1
/// = 0, x = 1/2.
#[test]
fn an_outlier_pulls_no_more_than_hubers_loss_allows() {
    let mut model = Closed(|p: &[f64]| Ok([-1.0, 0.0, 1.0, 100.0].map(|y| p[0] - y).to_vec()));
    let method = Method { huber: Some(1.0), ..METHOD };
    let found = fit(&mut model, &[parameter("a", -200.0, 200.0)], &[0.9], method).unwrap();
    assert!((found.best.values[0] - 0.5).abs() < 1e-4, "{:?}", found.best.values);
    let mean = fit(&mut model, &[parameter("a", -200.0, 200.0)], &[0.9], METHOD).unwrap();
    assert!((mean.best.values[0] - 25.0).abs() < 1e-4);
}

/// A cosine has many minima: from the first start the fit ends in a wrong one, from eight it does not.
#[test]
fn several_starts_find_the_best_of_several_minima() {
    let curve = |f: f64, i: usize| (f * 0.1 * i as f64).cos();
    let mut model =
        Closed(|p: &[f64]| Ok((0..100).map(|i| 10.0 * (curve(p[0], i) - curve(2.0, i))).collect()));
    let parameters = [parameter("f", 0.5, 6.0)];
    let one = fit(&mut model, &parameters, &[0.9], METHOD).unwrap();
    let many = fit(&mut model, &parameters, &[0.9], Method { starts: 8, ..METHOD }).unwrap();
    assert!((one.best.values[0] - 2.0).abs() > 0.5, "{:?}", one.best.values);
    assert!((many.best.values[0] - 2.0).abs() < 1e-5, "{:?}", many.best.values);
    assert_eq!((many.costs.len(), many.costs[0]), (8, one.costs[0]));
}

/// Only a / b enters: the direction in which both grow is named; a prior on one of them determines both.
#[test]
fn a_pair_that_only_its_ratio_enters_is_named() {
    let mut model =
        Closed(|p: &[f64]| Ok((0..50).map(|i| (p[0] / p[1] - 1.0) * i as f64 + noise(1, i)).collect()));
    let log = |key: &str| Parameter { scale: Scale::Log, ..parameter(key, 0.25, 4.0) };
    let mut parameters = [log("stiffness"), log("gain"), parameter("unused", 0.0, 1.0)];
    let start = [0.4, 0.6, 0.5];
    let found = fit(&mut model, &parameters, &start, METHOD).unwrap();
    let uncertainty = Uncertainty::of(&parameters, &found.best, std::slice::from_ref(&(0..50)));
    let said = undetermined(&parameters, &uncertainty);
    assert_eq!(said.len(), 2, "{said:?}");
    let pair = said.iter().find(|line| line.contains("`stiffness` and `gain`")).unwrap();
    assert!(
        pair.contains("`stiffness` by a factor of 1.320") && pair.contains("`gain` by a factor of 1.320"),
        "{pair}"
    );
    assert!(said.iter().any(|line| line.contains("do not determine `unused`")), "{said:?}");
    assert!(uncertainty.estimates.iter().all(|estimate| !estimate.is_determined));
    assert_eq!(uncertainty.estimates[0].interval, [0.25, 4.0]);

    parameters[1].prior = Some(Prior { mean: 1.0, sd: 0.01 });
    let found = fit(&mut model, &parameters, &start, METHOD).unwrap();
    let uncertainty = Uncertainty::of(&parameters, &found.best, std::slice::from_ref(&(0..50)));
    assert!(uncertainty.estimates[0].is_determined && uncertainty.estimates[1].is_determined);
    assert_eq!(undetermined(&parameters, &uncertainty).len(), 1);
}

#[test]
fn a_model_that_fails_beside_a_point_is_differentiated_on_the_other_side_and_one_that_fails_everywhere_is_refused()
 {
    // Fails above 1, where the optimum is.
    let mut model = Closed(|p: &[f64]| match p[0] <= 1.0 {
        true => Ok(vec![p[0] - 1.0, 2.0 * (p[0] - 1.0)]),
        false => Err("the tool leaves the bone".to_owned()),
    });
    let parameters = [parameter("a", 0.0, 2.0)];
    let found = fit(&mut model, &parameters, &[0.1], METHOD).unwrap();
    assert!((found.best.values[0] - 1.0).abs() < 1e-4, "{:?}", found.best.values);
    let refused = fit(&mut model, &parameters, &[0.9], METHOD).unwrap_err();
    assert_eq!(refused, SolveError::Start { reason: "the tool leaves the bone".to_owned() });
}

/// With a staircase of 1e-3 on top, no derivative leads to the exact minimum: the fit ends all the same,
/// near it.
#[test]
fn a_rough_model_ends_near_its_optimum() {
    let mut model = Closed(|p: &[f64]| {
        Ok((0..20).map(|i| ((1e3 * p[0]).floor() / 1e3 - 0.4) * (1.0 + i as f64)).collect())
    });
    let mut rough = parameter("a", 0.0, 1.0);
    rough.step = Some(0.02);
    let found = fit(&mut model, &[rough], &[0.9], METHOD).unwrap();
    assert!((found.best.values[0] - 0.4).abs() < 2e-3, "{:?}", found.best.values);
}

/// Ripples of 3e-4 with slopes up to 9 hide the slope of 1 from differences over 1e-5; over wider steps they
/// average out, and the fit goes on. It ends within a ripple of the optimum.
#[test]
fn ripples_on_a_model_do_not_stop_the_fit() {
    let mut model = Closed(|p: &[f64]| {
        let rippled = p[0] + 3e-4 * (3e4 * p[0]).sin();
        Ok((0..20).map(|i| 10.0 * (rippled - 0.4) * (1.0 + i as f64)).collect())
    });
    let found = fit(&mut model, &[parameter("a", 0.0, 1.0)], &[0.9], METHOD).unwrap();
    assert!((found.best.values[0] - 0.4).abs() < 1e-3, "{:?}", found.best.values);
}

/// Counts like a sensor of drilled voxels: each residual steps by 2 standard deviations of its noise when the
/// first parameter passes one of its thresholds; the second parameter enters smoothly.
fn counted(p: &[f64], i: usize) -> f64 {
    let phase = Key::of(99).uniform(i as u64);
    let slope = 10.0 + 30.0 * Key::of(98).uniform(i as u64);
    2.0 * (0.5 * slope * p[0] + phase).floor() + 10.0 * p[1] * (0.3 * i as f64).sin()
}

/// As above, of 400 intervals 362 to 398 hold the truth, and the estimates scatter by what is reported: the
/// mean of 800 squared deviations scatters by 5 %, and four times that is allowed, with 5 % for estimated
/// variances. Differences over short steps see no threshold, so they alone leave the start as it is.
#[test]
fn intervals_of_a_model_that_steps_hold_the_truth_as_often_as_they_say() {
    let parameters = [parameter("a", 0.0, 1.0), parameter("b", -1.0, 1.0)];
    let (mut held, mut square) = ([0; 2], 0.0);
    for study in 0..400 {
        let truth = [0.4 + 0.2 * Key::of(study).uniform(1000), Key::of(study).uniform(1001) - 0.5];
        let mut model = Closed(|p: &[f64]| {
            Ok((0..100).map(|i| counted(p, i) - counted(&truth, i) - noise(study, i)).collect())
        });
        let found = fit(&mut model, &parameters, &[0.5, 0.5], METHOD).unwrap();
        let uncertainty = Uncertainty::of(&parameters, &found.best, std::slice::from_ref(&(0..100)));
        for ((estimate, truth), held) in uncertainty.estimates.iter().zip(truth).zip(&mut held) {
            *held += usize::from(estimate.interval[0] <= truth && truth <= estimate.interval[1]);
            square += ((estimate.value - truth) / estimate.sd.unwrap()).powi(2) / 800.0;
        }
    }
    assert!(held.iter().all(|held| (362..=398).contains(held)), "{held:?} of 400, {square}");
    assert!((0.75..1.25).contains(&square), "{square}");
}

/// A smooth model is left to the bit where the solver ended: no plane is fitted to it.
#[test]
fn a_curved_model_is_not_called_rough() {
    for curvature in [0.0, 0.5, 3.0] {
        let mut model = Closed(|p: &[f64]| {
            Ok((0..40)
                .map(|i| 20.0 * (curvature * p[0] * 0.1 * i as f64).exp() * p[0] - noise(4, i) - 9.0)
                .collect())
        });
        let found = fit(&mut model, &[parameter("a", 0.0, 1.0)], &[0.5], METHOD).unwrap();
        assert!(found.best.roughness.is_none() && found.best.stop == Stop::Converged, "{found:?}");
    }
}
