//! Identification: parameters of a simulation from measurements, with their uncertainty.
//!
//! [`fit`] minimizes the differences between a [`Model`] and its measurements; [`Uncertainty`] says how well
//! the data determine the parameters and [`undetermined`](wording::undetermined) says in words what they do
//! not determine; [`rank`] says which further experiment would help most. A [`Study`](study::Study) is the
//! file that describes all of it: parameters, experiments, and what each column of a measured file means
//! ([`quantity`], [`mod@unit`], [`signal`]).
//!
//! **Boundary:** text and numbers in, values out. Files, threads and simulations are up to the caller
//! (`sim::identification`). **Invariant:** a result is a function of study, data and model: sums have a fixed
//! order, and random draws are functions of the seed.
//!
//! ```
//! use identify::{Method, Model, Outcome, Parameter, Uncertainty, fit};
//!
//! /// Measured: 1.0, 3.1, 4.9 at 0, 1, 2; the noise is 0.1.
//! struct Line;
//! impl Model for Line {
//!     type Error = std::convert::Infallible;
//!     fn residuals(&mut self, points: &[Vec<f64>]) -> Result<Vec<Outcome>, Self::Error> {
//!         let measured = [1.0, 3.1, 4.9];
//!         let residual = |p: &Vec<f64>, i: usize| (p[0] + p[1] * i as f64 - measured[i]) / 0.1;
//!         Ok(points.iter().map(|p| Ok((0..3).map(|i| residual(p, i)).collect())).collect())
//!     }
//! }
//!
//! let parameter = |key: &str| Parameter {
//!     key: key.to_owned(), min: -10.0, max: 10.0, scale: Default::default(), start: None, step: None,
//!     prior: None,
//! };
//! let parameters = [parameter("offset"), parameter("slope")];
//! let method = Method { starts: 1, seed: 0, iterations: 50, huber: None };
//! let found = fit(&mut Line, &parameters, &[0.5, 0.5], method).unwrap();
//! let uncertainty = Uncertainty::of(&parameters, &found.best, &[0..3]);
//! // The line of least squares, and its standard error 0.1 / √2.
//! assert!((found.best.values[1] - 1.95).abs() < 1e-6);
//! assert!((uncertainty.estimates[1].sd.unwrap() - 0.1 / 2.0_f64.sqrt()).abs() < 1e-6);
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`Parameter`], [`fit`], [`Model`] | ranges, the solver, what it fits |
//! | [`Uncertainty`], [`wording`], [`ResidualStatistics`] | covariance, identifiability, residuals |
//! | [`rank`] | expected information of candidate experiments |
//! | [`study`], [`mod@unit`], [`quantity`], [`signal`] | the study; what is measured, its unit, and when |

mod design;
mod matrix;
mod parameter;
pub mod quantity;
mod residual;
mod rough;
pub mod signal;
mod solver;
pub mod study;
mod uncertainty;
pub mod unit;
pub mod wording;

pub use design::{Gain, expected_sd, rank};
pub use matrix::gram;
pub use parameter::{Parameter, Prior, STANDARD_STEP};
pub use residual::ResidualStatistics;
pub use solver::{Bound, Fit, Method, Model, Optimum, Outcome, SolveError, Stop, fit, linearised, weight};
pub use sweep::Scale;
pub use uncertainty::{
    Combination, Estimate, Uncertainty, combinations, covariance, draws, information, output_sd,
};
