//! Optima of models that are not smooth, such as drilled voxels.
//!
//! Where residuals jump when a parameter changes slightly, finite differences over a short step miss the
//! jumps or divide one by the step, and the nearest minimum is one of many. Within an interval of the
//! parameters such a model is nearly a plane plus roughness. So a plane is fitted to residuals at points
//! along the principal axes of the covariance, so far apart that its slopes stand clear of the roughness (as
//! Moré and Wild 2012 choose steps, "Estimating derivatives of noisy simulations", ACM Trans. Math. Softw.
//! 38). Its optimum is that of the averaged model. The scatter of the residuals about the plane within two
//! standard deviations is an error of the model, which the intervals include.

use nalgebra::DMatrix;

use crate::matrix::{gradient, gram, solve};
use crate::solver::{Model, Optimum, Point, SolveError, Solver, Stop, either_side, weight};
use crate::uncertainty::{combinations, information};

/// Places along each axis, in steps.
const PLACES: [f64; 4] = [-2.0, -1.0, 1.0, 2.0];
/// Longest step, as a share of the range.
const MOST_STEP: f64 = 0.1;
/// Step of a derivative, in standard deviations of a single parameter.
const STEP_SD: f64 = 2.0;
/// Shortest and longest step of a plane, in standard deviations.
const LEAST_SPREAD: f64 = 2.0;
const MOST_SPREAD: f64 = 16.0;
/// Share of the square of a slope that may be roughness; above it, longer steps are taken.
const MOST_NOISE: f64 = 0.1;
/// Maximum number of planes, and of looks around the optimum that they lead to.
const ROUNDS: usize = 12;
const LOOKS: usize = 3;
/// Longest move between two planes, in standard deviations.
const LONGEST_MOVE: f64 = 10.0;
/// Move, in standard deviations, after which the next plane would be the same, and that of a last look.
const SETTLED: f64 = 1.0;
/// Second difference, in standard deviations of the noise in all, that no interval depends on.
const NEGLIGIBLE: f64 = 0.01;

/// Axes of the covariance around a point.
struct Axes {
    /// Directions in the unit cube, as long as a step.
    steps: Vec<Vec<f64>>,
    /// Their lengths.
    lengths: Vec<f64>,
    /// Directions that the data do not determine.
    open: Vec<Vec<f64>>,
    /// Parameters that are not at a bound.
    free: Vec<usize>,
}

/// Points around one.
struct Sample {
    /// The points, the one in the middle last.
    points: Vec<Point>,
    /// The place of each along each axis, in steps.
    places: Vec<Vec<f64>>,
}

/// Returns the root of the sum of squares.
fn length(values: impl Iterator<Item = f64>) -> f64 {
    libm::sqrt(values.map(|x| x * x).sum())
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Adds a multiple of a vector.
fn add(to: &mut [f64], factor: f64, vector: &[f64]) {
    to.iter_mut().zip(vector).for_each(|(to, x)| *to += factor * x);
}

impl<M: Model> Solver<'_, M> {
    /// Returns an optimum as it is where the model is smooth; elsewhere the optimum of its average, with the
    /// covariance of its roughness.
    pub(crate) fn averaged(&mut self, found: Optimum) -> Result<Optimum, M::Error> {
        let steps = self.steps_of(&found.columns, 1.0);
        if !self.is_rough(&found, &steps)? {
            return Ok(found);
        }
        let mut at = found.clone();
        for _ in 0..3 {
            at.steps = self.steps_of(&at.columns, STEP_SD);
            let point = Point::of(&at);
            let sides: Vec<[f64; 2]> =
                at.unit.iter().zip(&at.steps).map(|(unit, step)| either_side(*unit, *step)).collect();
            match self.columns_at(&point, &sides) {
                Ok(columns) => at.columns = columns,
                Err(SolveError::Model(error)) => return Err(error),
                Err(_) => break,
            }
        }
        at.stop = Stop::Rough;
        let (mut spread, mut noise) = (LEAST_SPREAD, f64::INFINITY);
        for _ in 0..ROUNDS {
            let axes = self.axes(&at, spread);
            let sample = self.around(&at, &axes)?;
            let Some((mean, columns, share)) = plane(&at, &axes, &sample) else { break };
            at.columns = columns;
            // Longer steps help as long as they lower the share of the roughness: it grows less than the
            // slope.
            if share > MOST_NOISE && share < noise && spread < MOST_SPREAD {
                (noise, spread) = (share, 2.0 * spread);
                continue;
            }
            let moved = self.move_to_optimum(&mut at, &axes, &mean)?;
            if moved.is_none_or(|moved| moved < SETTLED) {
                break;
            }
        }
        for _ in 0..LOOKS {
            let axes = self.axes(&at, 1.0);
            let sample = self.around(&at, &axes)?;
            let Some(mean) = look(&mut at, &axes, &sample) else { break };
            let moved = self.move_to_optimum(&mut at, &axes, &mean)?;
            if moved.is_none_or(|moved| moved < SETTLED) {
                at.stop = if moved.is_some() { Stop::Converged } else { Stop::Rough };
                break;
            }
        }
        at.steps = self.steps_of(&at.columns, STEP_SD);
        Ok(at)
    }

    /// Returns a step for each parameter that changes the residuals by `sd` standard deviations in all.
    fn steps_of(&self, columns: &[Vec<f64>], sd: f64) -> Vec<f64> {
        let step = |(column, parameter): (&Vec<f64>, &crate::Parameter)| {
            let step = sd / length(column.iter().copied());
            step.clamp(parameter.difference().min(MOST_STEP), MOST_STEP.max(parameter.difference()))
        };
        columns.iter().zip(self.parameters).map(step).collect()
    }

    /// Whether no step decreases the residuals although the derivatives say so, or the residuals are not
    /// smooth within an eighth of a standard deviation.
    fn is_rough(&mut self, at: &Optimum, steps: &[f64]) -> Result<bool, M::Error> {
        if at.stop == Stop::Rough {
            return Ok(true);
        }
        let inside = |j: usize| {
            at.at_bound[j].is_none() && at.unit[j] - steps[j] >= 0.0 && at.unit[j] + steps[j] <= 1.0
        };
        let tested: Vec<usize> = (0..steps.len()).filter(|j| inside(*j)).collect();
        let beside = |j: usize, share: f64| {
            let mut unit = at.unit.clone();
            unit[j] += share * steps[j];
            unit
        };
        let places = [0.125, -0.125, 1.0, -1.0];
        let units = tested.iter().flat_map(|j| places.map(|share| beside(*j, share))).collect();
        let points = self.points(units)?;
        for points in points.chunks(places.len()) {
            let [Ok(a), Ok(b), Ok(c), Ok(d)] = points else { continue };
            let second = |above: &Point, below: &Point| {
                let pairs = above.residuals.iter().zip(&below.residuals).zip(&at.residuals);
                length(pairs.map(|((above, below), here)| above + below - 2.0 * here))
            };
            let first = |above: &Point, below: &Point| {
                length(above.residuals.iter().zip(&below.residuals).map(|(above, below)| above - below))
            };
            let (near, far) = (second(a, b), second(c, d));
            // Second differences of a smooth model shrink with the square of the step.
            let is_near = near > NEGLIGIBLE && near > 0.1 * first(a, b) && near > far / 16.0;
            if is_near {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Returns the axes of the covariance at a point, with steps of `spread` standard deviations.
    fn axes(&self, at: &Optimum, spread: f64) -> Axes {
        let n = at.unit.len();
        let free: Vec<usize> = (0..n).filter(|&j| at.at_bound[j].is_none()).collect();
        let whole = information(self.parameters, &at.unit, &at.columns, &at.weights);
        let reduced = DMatrix::from_fn(free.len(), free.len(), |i, j| whole[(free[i], free[j])]);
        let mut axes = Axes { steps: Vec::new(), lengths: Vec::new(), open: Vec::new(), free };
        for combination in combinations(&reduced) {
            let mut direction = vec![0.0; n];
            axes.free.iter().zip(&combination.direction).for_each(|(j, x)| direction[*j] = *x);
            if combination.is_determined {
                let length = (spread / combination.singular_value).min(MOST_STEP);
                axes.steps.push(direction.iter().map(|x| x * length).collect());
                axes.lengths.push(length);
            } else {
                axes.open.push(direction);
            }
        }
        axes
    }

    /// Evaluates the model at places along each axis.
    fn around(&mut self, at: &Optimum, axes: &Axes) -> Result<Sample, M::Error> {
        let mut units = Vec::new();
        for axis in &axes.steps {
            for place in PLACES {
                let to = at.unit.iter().zip(axis).map(|(unit, step)| (unit + place * step).clamp(0.0, 1.0));
                units.push(to.collect::<Vec<f64>>());
            }
        }
        let mut points: Vec<Point> = self.points(units)?.into_iter().flatten().collect();
        points.push(Point::of(at));
        let places = axes.steps.iter().zip(&axes.lengths).map(|(axis, length)| {
            let place = |point: &Point| {
                let step: Vec<f64> = point.unit.iter().zip(&at.unit).map(|(to, from)| to - from).collect();
                dot(&step, axis) / (length * length)
            };
            points.iter().map(place).collect()
        });
        let places = places.collect();
        Ok(Sample { points, places })
    }

    /// Moves to the optimum of a plane; returns how far it is away, in standard deviations, or `None` if the
    /// model fails there.
    fn move_to_optimum(
        &mut self,
        at: &mut Optimum,
        axes: &Axes,
        mean: &[f64],
    ) -> Result<Option<f64>, M::Error> {
        let slopes = slopes(&at.columns, axes);
        let mut hessian = gram(&slopes, &at.weights);
        let mut slope = gradient(&slopes, &at.weights, mean);
        for (j, (residual, derivative)) in self.priors(&at.unit).into_iter().enumerate() {
            for (a, axis) in axes.steps.iter().enumerate() {
                slope[a] += derivative * residual * axis[j];
                for (b, other) in axes.steps.iter().enumerate() {
                    hessian[(a, b)] += derivative * derivative * axis[j] * other[j];
                }
            }
        }
        let against: Vec<f64> = slope.iter().map(|slope| -slope).collect();
        let Some(step) = solve(&hessian, &against) else { return Ok(None) };
        let moved = libm::sqrt(dot(&step, &against).max(0.0));
        let mut unit = at.unit.clone();
        let factor = if moved > LONGEST_MOVE { LONGEST_MOVE / moved } else { 1.0 };
        axes.steps.iter().zip(&step).for_each(|(axis, step)| add(&mut unit, factor * step, axis));
        unit.iter_mut().for_each(|unit| *unit = unit.clamp(0.0, 1.0));
        let Some(Ok(next)) = self.points(vec![unit])?.pop() else { return Ok(None) };
        at.values = self.values(&next.unit);
        at.weights = next.residuals.iter().map(|r| weight(*r, self.method.huber)).collect();
        (at.unit, at.residuals, at.cost) = (next.unit, next.residuals, next.cost);
        at.iterations += 1;
        Ok(Some(moved))
    }
}

/// Returns the change of the residuals by each axis.
fn slopes(columns: &[Vec<f64>], axes: &Axes) -> Vec<Vec<f64>> {
    let slope = |axis: &Vec<f64>| {
        let mut slope = vec![0.0; columns.first().map_or(0, Vec::len)];
        columns.iter().zip(axis).for_each(|(column, step)| add(&mut slope, *step, column));
        slope
    };
    axes.steps.iter().map(slope).collect()
}

/// Fits a plane to the residuals at points. Returns its residuals at the given one, the columns of the
/// Jacobian, and the largest share of roughness in the square of a slope, by which the columns have been
/// reduced; `None` if there are too few points, or nothing is determined.
#[allow(clippy::type_complexity, reason = "residuals, columns, share")]
fn plane(
    at: &Optimum,
    axes: &Axes,
    Sample { points, places }: &Sample,
) -> Option<(Vec<f64>, Vec<Vec<f64>>, f64)> {
    let mut regressors = vec![vec![1.0; points.len()]];
    regressors.extend_from_slice(places);
    let freedom = points.len().checked_sub(regressors.len()).filter(|freedom| *freedom > 0)? as f64;
    let normal = gram(&regressors, &regressors[0]);
    let mut inverse = Vec::new();
    let mut fitted: Vec<Vec<f64>> = Vec::new();
    for a in 0..regressors.len() {
        let mut one = vec![0.0; regressors.len()];
        one[a] = 1.0;
        let row = solve(&normal, &one)?;
        let mut coefficient = vec![0.0; at.residuals.len()];
        for (k, point) in points.iter().enumerate() {
            let factor = row.iter().zip(&regressors).map(|(row, column)| row * column[k]).sum();
            add(&mut coefficient, factor, &point.residuals);
        }
        inverse.push(row[a]);
        fitted.push(coefficient);
    }
    let mut scatter = 0.0;
    for (k, point) in points.iter().enumerate() {
        let mut rest = point.residuals.clone();
        fitted.iter().zip(&regressors).for_each(|(slope, place)| add(&mut rest, -place[k], slope));
        scatter += rest.iter().zip(&at.weights).map(|(r, weight)| weight * r * r).sum::<f64>() / freedom;
    }
    let mean = fitted.remove(0);
    let mut columns = at.columns.clone();
    for &j in &axes.free {
        columns[j].fill(0.0);
        for direction in &axes.open {
            for &i in &axes.free {
                add(&mut columns[j], direction[i] * direction[j], &at.columns[i]);
            }
        }
    }
    let mut most: f64 = 0.0;
    for (a, slope) in fitted.iter().enumerate() {
        let square: f64 = slope.iter().zip(&at.weights).map(|(s, weight)| weight * s * s).sum();
        let share = if square > 0.0 { scatter * inverse[a + 1] / square } else { 0.0 };
        most = most.max(share);
        let factor = libm::sqrt(1.0 - share.min(0.8)) / (axes.lengths[a] * axes.lengths[a]);
        axes.free.iter().for_each(|&j| add(&mut columns[j], factor * axes.steps[a][j], slope));
    }
    (!axes.steps.is_empty()).then_some((mean, columns, most))
}

/// Looks at the residuals around a point, less the plane of the known columns: returns their mean, and sets
/// the covariance of the gradient that their scatter causes. `None` if there are too few points.
fn look(at: &mut Optimum, axes: &Axes, Sample { points, places }: &Sample) -> Option<Vec<f64>> {
    let slopes = slopes(&at.columns, axes);
    let (n, count) = (at.unit.len(), points.len() as f64);
    let mut mean = vec![0.0; at.residuals.len()];
    let mut rests = Vec::new();
    for (k, point) in points.iter().enumerate() {
        let mut rest = point.residuals.clone();
        slopes.iter().zip(places).for_each(|(slope, place)| add(&mut rest, -place[k], slope));
        add(&mut mean, 1.0 / count, &rest);
        rests.push(rest);
    }
    if axes.steps.is_empty() || points.len() < 3 {
        return None;
    }
    // The data are one more draw of the same scatter as the mean of these points.
    let factor = (1.0 + 1.0 / count) / (count - 1.0);
    let mut roughness = DMatrix::zeros(n, n);
    for mut rest in rests {
        add(&mut rest, -1.0, &mean);
        let pull = gradient(&at.columns, &at.weights, &rest);
        for i in 0..n {
            for j in 0..n {
                roughness[(i, j)] += factor * pull[i] * pull[j];
            }
        }
    }
    at.roughness = Some(roughness);
    Some(mean)
}
