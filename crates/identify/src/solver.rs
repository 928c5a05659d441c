//! The fit: a bounded Levenberg-Marquardt method with projection onto the range.
//!
//! It minimizes F = ½ Σ ρ(r) + ½ Σ ((x − mean) / sd)² over the unit cube (Kanzow, Yamashita and Fukushima
//! 2004, "Levenberg-Marquardt methods with strong local convergence properties for solving nonlinear
//! equations with convex constraints", J. Comput. Appl. Math. 172). ρ(r) is r², or Huber's function
//! (Huber 1964, "Robust estimation of a location parameter", Ann. Math. Stat. 35). Derivatives are finite
//! differences: one-sided far from the optimum, central near it. All points of a Jacobian, and both trial
//! steps, are one request to the model, so that it can compute them at once.

use nalgebra::DMatrix;

use crate::matrix::{gradient, gram, solve};
use crate::parameter::Parameter;

/// Residuals at a point in units of the noise, or why there are none: the scene is refused, or fails.
pub type Outcome = Result<Vec<f64>, String>;

/// What is fitted.
pub trait Model {
    /// A failure that ends the fit, such as too little memory.
    type Error;

    /// Returns the residuals at each of these points, simulated minus measured over the noise. A point holds
    /// a value for each parameter. The order of residuals is the same at every point.
    ///
    /// # Errors
    /// A failure of the machine.
    fn residuals(&mut self, points: &[Vec<f64>]) -> Result<Vec<Outcome>, Self::Error>;
}

/// How a fit is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Method {
    /// Number of starting points.
    pub starts: u32,
    /// Seed of the starting points after the first.
    pub seed: u32,
    /// Maximum number of steps from each starting point.
    pub iterations: u32,
    /// Residual, in standard deviations, from which Huber's loss grows linearly; `None`: least squares.
    pub huber: Option<f64>,
}

/// Why a fit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Stop {
    /// No step would change the estimate noticeably.
    Converged,
    /// No step decreases the residuals although the derivatives say so: the simulation is not smooth there.
    Rough,
    /// The maximum number of steps is reached.
    Iterations,
}

/// End of a range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Bound {
    /// `min`.
    Min,
    /// `max`.
    Max,
}

/// An optimum.
#[derive(Debug, Clone, PartialEq)]
pub struct Optimum {
    /// Coordinates in the unit cube.
    pub unit: Vec<f64>,
    /// Values, in the parameters' units.
    pub values: Vec<f64>,
    /// Which bound each parameter is pressed against.
    pub at_bound: Vec<Option<Bound>>,
    /// Objective F.
    pub cost: f64,
    /// Residuals in units of the noise.
    pub residuals: Vec<f64>,
    /// Weight of each residual: 1, or less under Huber's loss.
    pub weights: Vec<f64>,
    /// Derivatives of the residuals by each coordinate.
    pub columns: Vec<Vec<f64>>,
    /// Step of each derivative in the unit cube.
    pub steps: Vec<f64>,
    /// Covariance of the gradient in the unit cube by the model's roughness; `None` where it is smooth.
    pub roughness: Option<DMatrix<f64>>,
    /// Steps that were taken.
    pub iterations: u32,
    /// Why it ended.
    pub stop: Stop,
}

/// A finished fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// The best optimum.
    pub best: Optimum,
    /// Objective reached from each starting point; `None` if the model fails there.
    pub costs: Vec<Option<f64>>,
    /// Objective at the first starting point.
    pub first_cost: f64,
    /// Number of points at which the model was evaluated.
    pub evaluations: u64,
}

/// Why there is no fit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SolveError<E> {
    /// The model failed for a reason that ends the fit.
    Model(E),
    /// The model has no residuals at the starting points.
    Start {
        /// Its reason at the first.
        reason: String,
    },
    /// The model has no residuals beside a point, so it has no derivative.
    Derivative {
        /// Key of the parameter.
        key: String,
        /// The model's reason.
        reason: String,
    },
}

impl<E> From<E> for SolveError<E> {
    fn from(error: E) -> Self {
        SolveError::Model(error)
    }
}

/// Decrease of F that no further step is taken for. In units of F, which is half a χ², it corresponds to
/// 4e-6 standard deviations of a parameter.
const NEGLIGIBLE_DECREASE: f64 = 1e-11;
/// Decrease of F below which one-sided differences give way to central ones.
const NEAR_DECREASE: f64 = 1e-2;
/// A step must achieve this share of the decrease that the linear model predicts.
const LEAST_SHARE: f64 = 1e-4;
/// Damping after which a step, a ten-thousandth of the undamped one, is too short to help: the objective
/// is not smooth.
const MOST_DAMPING: f64 = 1e4;

/// Largest factor on the steps of finite differences, and the largest step that it may lead to.
const MOST_WIDENING: f64 = 1000.0;
const MOST_STEP: f64 = 0.05;

/// A point with its residuals.
#[derive(Debug, Clone)]
pub(crate) struct Point {
    pub unit: Vec<f64>,
    pub residuals: Vec<f64>,
    pub cost: f64,
}

impl Point {
    pub(crate) fn of(optimum: &Optimum) -> Point {
        Point { unit: optimum.unit.clone(), residuals: optimum.residuals.clone(), cost: optimum.cost }
    }
}

/// Finite differences.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Difference {
    OneSided,
    Central,
}

pub(crate) struct Solver<'a, M: Model> {
    model: &'a mut M,
    pub(crate) parameters: &'a [Parameter],
    pub(crate) method: Method,
    evaluations: u64,
    /// Factor on the steps of finite differences, raised where the model is rough on their scale.
    widening: f64,
}

/// Fits the parameters. `start` holds a coordinate for each; further starting points are a scrambled Sobol
/// sequence in the unit cube.
///
/// # Errors
/// [`SolveError`].
pub fn fit<M: Model>(
    model: &mut M,
    parameters: &[Parameter],
    start: &[f64],
    method: Method,
) -> Result<Fit, SolveError<M::Error>> {
    let mut solver = Solver { model, parameters, method, evaluations: 0, widening: 1.0 };
    let mut starts = vec![start.iter().map(|unit| unit.clamp(0.0, 1.0)).collect::<Vec<f64>>()];
    for index in 1..method.starts.max(1) {
        let unit = |dimension| f64::from(sobol_burley::sample(index, dimension, method.seed));
        starts.push((0..parameters.len() as u32).map(unit).collect());
    }
    let points = solver.points(starts)?;
    let mut reason = String::new();
    let mut costs = Vec::new();
    let mut first_cost = f64::NAN;
    let mut best: Option<Optimum> = None;
    for (index, point) in points.into_iter().enumerate() {
        let point = match point {
            Ok(point) => point,
            Err(cause) => {
                if reason.is_empty() {
                    reason = cause;
                }
                costs.push(None);
                continue;
            }
        };
        if index == 0 {
            first_cost = point.cost;
        }
        match solver.descend(point) {
            Ok(found) => {
                costs.push(Some(found.cost));
                if best.as_ref().is_none_or(|best| found.cost < best.cost) {
                    best = Some(found);
                }
            }
            // Another starting point may lead elsewhere.
            Err(SolveError::Derivative { .. }) if method.starts > 1 => costs.push(None),
            Err(other) => return Err(other),
        }
    }
    let best = solver.averaged(best.ok_or(SolveError::Start { reason })?)?;
    Ok(Fit { best, costs, first_cost, evaluations: solver.evaluations })
}

/// Returns the derivatives of the residuals by each coordinate at a point, by central differences over these
/// steps, with the residuals there.
///
/// # Errors
/// [`SolveError`].
#[allow(clippy::type_complexity, reason = "residuals and columns")]
pub fn linearised<M: Model>(
    model: &mut M,
    parameters: &[Parameter],
    unit: &[f64],
    steps: &[f64],
) -> Result<(Vec<f64>, Vec<Vec<f64>>), SolveError<M::Error>> {
    let method = Method { starts: 1, seed: 0, iterations: 0, huber: None };
    let mut solver = Solver { model, parameters, method, evaluations: 0, widening: 1.0 };
    let point = solver.points(vec![unit.to_vec()])?.remove(0);
    let point = point.map_err(|reason| SolveError::Start { reason })?;
    let sides: Vec<[f64; 2]> = unit.iter().zip(steps).map(|(unit, step)| either_side(*unit, *step)).collect();
    let columns = solver.columns_at(&point, &sides)?;
    Ok((point.residuals, columns))
}

/// Returns the weight of a residual: ρ′(r) / (2 r).
pub fn weight(residual: f64, huber: Option<f64>) -> f64 {
    match huber {
        Some(at) if residual.abs() > at => at / residual.abs(),
        _ => 1.0,
    }
}

/// Returns half of ρ(r).
fn loss(residual: f64, huber: Option<f64>) -> f64 {
    match huber {
        Some(at) if residual.abs() > at => at * (residual.abs() - 0.5 * at),
        _ => 0.5 * residual * residual,
    }
}

impl<M: Model> Solver<'_, M> {
    pub(crate) fn values(&self, unit: &[f64]) -> Vec<f64> {
        self.parameters.iter().zip(unit).map(|(parameter, unit)| parameter.value(*unit)).collect()
    }

    /// Returns each parameter's (x − mean) / sd and its derivative by the coordinate; zero without a prior.
    pub(crate) fn priors(&self, unit: &[f64]) -> Vec<(f64, f64)> {
        let prior = |(parameter, unit): (&Parameter, &f64)| match parameter.prior {
            Some(prior) => {
                ((parameter.value(*unit) - prior.mean) / prior.sd, parameter.slope(*unit) / prior.sd)
            }
            None => (0.0, 0.0),
        };
        self.parameters.iter().zip(unit).map(prior).collect()
    }

    pub(crate) fn points(&mut self, units: Vec<Vec<f64>>) -> Result<Vec<Result<Point, String>>, M::Error> {
        let values: Vec<Vec<f64>> = units.iter().map(|unit| self.values(unit)).collect();
        self.evaluations += values.len() as u64;
        let outcomes = self.model.residuals(&values)?;
        let huber = self.method.huber;
        let point = |(unit, outcome): (Vec<f64>, Outcome)| {
            let residuals = outcome?;
            if residuals.iter().any(|r| !r.is_finite()) {
                return Err("a residual is not a finite number".to_owned());
            }
            let prior: f64 = self.priors(&unit).iter().map(|(r, _)| 0.5 * r * r).sum();
            let cost = residuals.iter().map(|r| loss(*r, huber)).sum::<f64>() + prior;
            Ok(Point { unit, residuals, cost })
        };
        Ok(units.into_iter().zip(outcomes).map(point).collect())
    }

    /// Returns the columns of the Jacobian at a point.
    fn columns(&mut self, at: &Point, by: Difference) -> Result<Vec<Vec<f64>>, SolveError<M::Error>> {
        let steps: Vec<[f64; 2]> = (0..self.parameters.len()).map(|j| self.steps(at, j, by)).collect();
        self.columns_at(at, &steps)
    }

    /// Returns the columns of the Jacobian at a point by differences over one or two steps for each.
    pub(crate) fn columns_at(
        &mut self,
        at: &Point,
        steps: &[[f64; 2]],
    ) -> Result<Vec<Vec<f64>>, SolveError<M::Error>> {
        let mut units = Vec::new();
        for (j, steps) in steps.iter().enumerate() {
            for step in steps.iter().filter(|step| **step != 0.0) {
                let mut unit = at.unit.clone();
                unit[j] += step;
                units.push(unit);
            }
        }
        let mut points = self.points(units)?.into_iter();
        let mut columns = Vec::new();
        for (j, &[a, b]) in steps.iter().enumerate() {
            let mut next = |step: f64| (step != 0.0).then(|| points.next()).flatten();
            let (first, second) = (next(a), next(b));
            let column = difference(at, (a, first), (b, second))
                .map_err(|reason| SolveError::Derivative { key: self.parameters[j].key.clone(), reason })?;
            columns.push(column);
        }
        Ok(columns)
    }

    /// As `columns`; where the model fails on one side, changes to central differences.
    fn columns_of(&mut self, at: &Point, by: &mut Difference) -> Result<Vec<Vec<f64>>, SolveError<M::Error>> {
        match self.columns(at, *by) {
            Err(SolveError::Derivative { .. }) if *by == Difference::OneSided => {
                *by = Difference::Central;
                self.columns(at, *by)
            }
            other => other,
        }
    }

    /// Returns the steps at which a column is evaluated; 0: none.
    fn steps(&self, at: &Point, j: usize, by: Difference) -> [f64; 2] {
        let given = self.parameters[j].difference();
        let (unit, h) = (at.unit[j], (given * self.widening).min(given.max(MOST_STEP)));
        match by {
            Difference::OneSided if unit + h <= 1.0 => [h, 0.0],
            Difference::OneSided => [-h, 0.0],
            Difference::Central => either_side(unit, h),
        }
    }

    /// Descends from a point to an optimum.
    fn descend(&mut self, mut point: Point) -> Result<Optimum, SolveError<M::Error>> {
        self.widening = 1.0;
        let mut by = Difference::OneSided;
        let mut damping = 1e-3;
        let mut iterations = 0;
        let mut columns = self.columns_of(&point, &mut by)?;
        let stop = loop {
            let normal = self.normal(&point, &columns);
            let decrease = normal.attainable(&point.unit);
            if decrease < NEAR_DECREASE && by == Difference::OneSided {
                by = Difference::Central;
                columns = self.columns(&point, by)?;
                continue;
            }
            if decrease < NEGLIGIBLE_DECREASE {
                break Stop::Converged;
            }
            if iterations >= self.method.iterations {
                break Stop::Iterations;
            }
            let Some((next, used)) = self.step(&point, &normal, &mut damping)? else {
                if by == Difference::Central {
                    if decrease < NEAR_DECREASE {
                        break Stop::Converged;
                    }
                    if self.widening >= MOST_WIDENING {
                        break Stop::Rough;
                    }
                    self.widening *= 10.0;
                }
                (by, damping) = (Difference::Central, 1e-3);
                columns = self.columns(&point, by)?;
                continue;
            };
            damping = used;
            iterations += 1;
            point = next;
            columns = self.columns_of(&point, &mut by)?;
        };
        if by == Difference::OneSided {
            columns = self.columns(&point, Difference::Central)?;
        }
        let normal = self.normal(&point, &columns);
        let at_bound = (0..point.unit.len()).map(|j| normal.bound(j)).collect();
        Ok(Optimum {
            values: self.values(&point.unit),
            weights: point.residuals.iter().map(|r| weight(*r, self.method.huber)).collect(),
            unit: point.unit,
            at_bound,
            cost: point.cost,
            residuals: point.residuals,
            columns,
            steps: self.parameters.iter().map(Parameter::difference).collect(),
            roughness: None,
            iterations,
            stop,
        })
    }

    /// Tries steps with more and more damping, two at a time; returns the point after the step that was
    /// accepted, and the damping to begin with next time.
    fn step(
        &mut self,
        from: &Point,
        normal: &Normal,
        damping: &mut f64,
    ) -> Result<Option<(Point, f64)>, M::Error> {
        while *damping <= MOST_DAMPING {
            let tried = [*damping, 0.1 * *damping];
            let steps: Vec<(f64, Vec<f64>)> = tried
                .iter()
                .filter_map(|&damping| Some((damping, normal.step(damping)?)))
                .map(|(damping, step)| (damping, normal.projected(&from.unit, &step)))
                .collect();
            let units = steps.iter().map(|(_, unit)| unit.clone()).collect();
            let mut found: Option<(Point, f64)> = None;
            for (point, (damping, unit)) in self.points(units)?.into_iter().zip(&steps) {
                let Ok(point) = point else { continue };
                let step: Vec<f64> = unit.iter().zip(&from.unit).map(|(to, from)| to - from).collect();
                let share = (from.cost - point.cost) / normal.decrease_of(&step).max(f64::MIN_POSITIVE);
                if share > LEAST_SHARE && found.as_ref().is_none_or(|(best, _)| point.cost < best.cost) {
                    let next = if share > 0.75 { damping / 3.0 } else { 2.0 * damping };
                    found = Some((point, next.clamp(1e-12, MOST_DAMPING)));
                }
            }
            if found.is_some() {
                return Ok(found);
            }
            *damping = (*damping * 10.0).max(1e-9);
        }
        Ok(None)
    }

    fn normal(&self, at: &Point, columns: &[Vec<f64>]) -> Normal {
        let weights: Vec<f64> = at.residuals.iter().map(|r| weight(*r, self.method.huber)).collect();
        let mut hessian = gram(columns, &weights);
        let mut slope = gradient(columns, &weights, &at.residuals);
        for (j, (residual, derivative)) in self.priors(&at.unit).into_iter().enumerate() {
            hessian[(j, j)] += derivative * derivative;
            slope[j] += derivative * residual;
        }
        let bounds = at.unit.iter().zip(&slope).map(|(unit, slope)| {
            // Pressed against a bound: the descent leads out of the range.
            match () {
                () if *unit <= 0.0 && *slope > 0.0 => Some(Bound::Min),
                () if *unit >= 1.0 && *slope < 0.0 => Some(Bound::Max),
                () => None,
            }
        });
        Normal { bounds: bounds.collect(), hessian, slope }
    }
}

/// Returns two steps within the range: one to either side of a coordinate, or two to one side.
pub(crate) fn either_side(unit: f64, h: f64) -> [f64; 2] {
    match (unit + h <= 1.0, unit - h >= 0.0) {
        (true, true) => [h, -h],
        (true, false) => [h, 2.0 * h],
        (false, _) => [-h, -2.0 * h],
    }
}

/// Returns a derivative from the values at one or two steps; with one failed, from the other.
fn difference(
    at: &Point,
    (a, first): (f64, Option<Result<Point, String>>),
    (b, second): (f64, Option<Result<Point, String>>),
) -> Result<Vec<f64>, String> {
    let one_sided = |step: f64, point: &Point| -> Vec<f64> {
        point.residuals.iter().zip(&at.residuals).map(|(there, here)| (there - here) / step).collect()
    };
    match (first, second) {
        (Some(Ok(first)), Some(Ok(second))) => {
            // The parabola through three points; for b = −a the central difference.
            let (u, v) = (b / (a * (b - a)), -a / (b * (b - a)));
            let triples = first.residuals.iter().zip(&second.residuals).zip(&at.residuals);
            Ok(triples.map(|((x, y), here)| u * (x - here) + v * (y - here)).collect())
        }
        (Some(Ok(first)), _) => Ok(one_sided(a, &first)),
        (_, Some(Ok(second))) => Ok(one_sided(b, &second)),
        (Some(Err(reason)), _) | (_, Some(Err(reason))) => Err(reason),
        (None, None) => Err("no step within the range".to_owned()),
    }
}

/// The quadratic model of the objective at a point.
struct Normal {
    hessian: DMatrix<f64>,
    slope: Vec<f64>,
    bounds: Vec<Option<Bound>>,
}

impl Normal {
    fn bound(&self, j: usize) -> Option<Bound> {
        self.bounds[j]
    }

    /// Returns the step with Marquardt's damping; pressed parameters stay.
    fn step(&self, damping: f64) -> Option<Vec<f64>> {
        let n = self.slope.len();
        let free: Vec<usize> = (0..n).filter(|&j| self.bounds[j].is_none()).collect();
        if free.is_empty() {
            return Some(vec![0.0; n]);
        }
        let largest = free.iter().map(|&j| self.hessian[(j, j)]).fold(0.0, f64::max);
        if largest <= 0.0 {
            return Some(vec![0.0; n]);
        }
        let reduced = DMatrix::from_fn(free.len(), free.len(), |i, j| {
            let (row, column) = (free[i], free[j]);
            let entry = self.hessian[(row, column)];
            // A parameter that moves nothing has no curvature; the floor keeps its step at 0.
            if i == j { entry * (1.0 + damping) + largest * 1e-13 } else { entry }
        });
        let against: Vec<f64> = free.iter().map(|&j| -self.slope[j]).collect();
        let found = solve(&reduced, &against)?;
        let mut step = vec![0.0; n];
        free.iter().zip(found).for_each(|(&j, x)| step[j] = x);
        Some(step)
    }

    fn projected(&self, from: &[f64], step: &[f64]) -> Vec<f64> {
        from.iter().zip(step).map(|(unit, step)| (unit + step).clamp(0.0, 1.0)).collect()
    }

    /// Returns the decrease that the model predicts for a step.
    fn decrease_of(&self, step: &[f64]) -> f64 {
        let n = step.len();
        let linear: f64 = self.slope.iter().zip(step).map(|(g, s)| g * s).sum();
        let quadratic: f64 =
            (0..n).map(|i| (0..n).map(|j| step[i] * self.hessian[(i, j)] * step[j]).sum::<f64>()).sum();
        -linear - 0.5 * quadratic
    }

    /// Returns the largest decrease that the model predicts for steps that stay within the range. A long step
    /// cut off at the range may predict an increase, so shorter ones are tried too.
    fn attainable(&self, from: &[f64]) -> f64 {
        let decrease = |damping: f64| {
            let Some(step) = self.step(damping) else { return f64::INFINITY };
            let to = self.projected(from, &step);
            let step: Vec<f64> = to.iter().zip(from).map(|(to, from)| to - from).collect();
            self.decrease_of(&step)
        };
        [0.0, 0.1, 10.0, 1e3].into_iter().map(decrease).fold(0.0, f64::max)
    }
}
