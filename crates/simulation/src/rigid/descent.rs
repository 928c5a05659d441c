//! Descent on a convex potential of the bodies' motions: limited-memory BFGS with line search.
//!
//! Finds the motion x (one twist per body) at which the residual r(x) = response(x) - x vanishes. The
//! response is the motion of the bodies under the impulses of a tool that assumed x. Both terms are monotone
//! (the faster a body approaches the tool, the larger the impulse that repels it), so -r is the gradient of a
//! convex function in the metric of the bodies' inertia. The function is piecewise quadratic because contacts
//! open and close. Search directions follow Nocedal (1980, "Updating quasi-Newton matrices with limited
//! storage", Math. Comp. 35) in that metric. The curvature pairs are kept from tick to tick, because the tool
//! hardly changes between ticks. Along a direction d the slope <r, d> decreases; bracketed secant steps find
//! its root.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// The line search ends when the slope has fallen to this fraction.
const FLAT: f64 = 0.3;
/// Maximum evaluations per line search.
const MAX_LINE_EVALUATIONS: usize = 8;
/// First step as a fraction of the residual when no curvature is known: too small to open a contact.
const FIRST_STEP: f64 = 1e-3;
/// Number of stored curvature pairs.
const MEMORY: usize = 8;

/// A body's mean velocity over a tick, world axes: of its centre of mass, m/s, and angular, rad/s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Motion {
    pub linear: Vector3<f64>,
    pub angular: Vector3<f64>,
}

impl Motion {
    pub fn zero() -> Motion {
        Motion { linear: Vector3::zeros(), angular: Vector3::zeros() }
    }

    /// Returns self + scale other.
    pub fn plus(&self, scale: f64, other: &Motion) -> Motion {
        Motion { linear: self.linear + other.linear * scale, angular: self.angular + other.angular * scale }
    }

    /// Returns the velocity at offset `arm` from the centre of mass.
    pub fn at(&self, arm: &Vector3<f64>) -> Vector3<f64> {
        self.linear + self.angular.cross(arm)
    }
}

/// Inertia of a body, which defines the metric.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Inertia {
    pub mass_kg: f64,
    /// Inertia about the centre of mass, world axes.
    pub moment_kg_m2: Matrix3<f64>,
}

impl Inertia {
    /// Returns the inertia of a body that does not take part.
    pub fn none() -> Inertia {
        Inertia { mass_kg: 0.0, moment_kg_m2: Matrix3::zeros() }
    }
}

/// A curvature pair: differences of motion and of the negative residual, and their inner product.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Pair {
    step: Vec<Motion>,
    change: Vec<Motion>,
    product: f64,
}

impl Pair {
    /// Returns the number of bodies in the pair; `None` if its two vectors differ in length.
    pub fn bodies(&self) -> usize {
        if self.step.len() == self.change.len() { self.step.len() } else { 0 }
    }
}

/// Vectors of the iteration, one entry per body.
pub(super) struct Descent {
    /// x, the motion to evaluate.
    pub motion: Vec<Motion>,
    /// r(x), set by the caller's evaluation.
    pub residual: Vec<Motion>,
    pub inertia: Vec<Inertia>,
    best: Vec<Motion>,
    start: Vec<Motion>,
    start_residual: Vec<Motion>,
    direction: Vec<Motion>,
    /// Curvature pairs, oldest first; the first `used` are valid. Part of the state.
    pairs: Vec<Pair>,
    used: usize,
    line: Line,
}

/// A line search in progress: steps and slopes.
#[derive(Debug, Clone, Copy)]
struct Line {
    first_slope: f64,
    evaluations: usize,
    step: f64,
    /// The last two points with a positive slope.
    low: [(f64, f64); 2],
    high: Option<(f64, f64)>,
}

impl Descent {
    pub fn new(bodies: usize) -> Descent {
        let zeros = || vec![Motion::zero(); bodies];
        Descent {
            motion: zeros(),
            residual: zeros(),
            inertia: vec![Inertia::none(); bodies],
            best: zeros(),
            start: zeros(),
            start_residual: zeros(),
            direction: zeros(),
            pairs: (0..MEMORY).map(|_| Pair { step: zeros(), change: zeros(), product: 0.0 }).collect(),
            used: 0,
            line: Line { first_slope: 0.0, evaluations: 0, step: 0.0, low: [(0.0, 0.0); 2], high: None },
        }
    }

    /// Returns the stored curvature pairs.
    pub fn memory(&self) -> &[Pair] {
        &self.pairs[..self.used]
    }

    pub fn restore_memory(&mut self, pairs: &[Pair]) {
        self.used = pairs.len().min(MEMORY);
        self.pairs[..self.used].clone_from_slice(&pairs[..self.used]);
    }

    /// Discards the curvature pairs because other bodies take part.
    pub fn forget(&mut self) {
        self.used = 0;
    }

    pub fn keep_best(&mut self) {
        self.best.clone_from(&self.motion);
    }

    pub fn take_best(&mut self) {
        self.motion.clone_from(&self.best);
    }

    /// Starts the first line search, after the first evaluation of a tick.
    pub fn begin(&mut self) {
        self.direction.clone_from(&self.residual);
        let mut shares = [0.0; MEMORY];
        for k in (0..self.used).rev() {
            let pair = &self.pairs[k];
            shares[k] = dot(&self.inertia, &pair.step, &self.direction) / pair.product;
            add(&mut self.direction, -shares[k], &pair.change);
        }
        let scale = self.used.checked_sub(1).map_or(FIRST_STEP, |newest| {
            let pair = &self.pairs[newest];
            pair.product / dot(&self.inertia, &pair.change, &pair.change)
        });
        for direction in &mut self.direction {
            *direction = Motion::zero().plus(scale, direction);
        }
        for (pair, share) in self.pairs[..self.used].iter().zip(shares) {
            let beta = dot(&self.inertia, &pair.change, &self.direction) / pair.product;
            add(&mut self.direction, share - beta, &pair.step);
        }
        let mut slope = dot(&self.inertia, &self.residual, &self.direction);
        if slope.is_nan() || slope <= 0.0 {
            self.forget();
            for (direction, residual) in self.direction.iter_mut().zip(&self.residual) {
                *direction = Motion::zero().plus(FIRST_STEP, residual);
            }
            slope = dot(&self.inertia, &self.residual, &self.direction);
        }
        self.start.clone_from(&self.motion);
        self.start_residual.clone_from(&self.residual);
        self.line =
            Line { first_slope: slope, evaluations: 0, step: 1.0, low: [(0.0, slope); 2], high: None };
        self.place();
    }

    /// Continues the line search, or starts a new one, after a further evaluation.
    pub fn advance(&mut self) {
        let slope = dot(&self.inertia, &self.residual, &self.direction);
        self.line.evaluations += 1;
        if slope.abs() <= FLAT * self.line.first_slope || self.line.evaluations >= MAX_LINE_EVALUATIONS {
            self.remember();
            self.begin();
            return;
        }
        self.line.step = self.line.next(slope);
        self.place();
    }

    /// Stores the difference from the line's start to here; called also when the tick ends here.
    pub fn remember(&mut self) {
        if self.used == MEMORY {
            self.pairs.rotate_left(1);
            self.used -= 1;
        }
        let pair = &mut self.pairs[self.used];
        for k in 0..self.motion.len() {
            pair.step[k] = self.motion[k].plus(-1.0, &self.start[k]);
            pair.change[k] = self.start_residual[k].plus(-1.0, &self.residual[k]);
        }
        pair.product = dot(&self.inertia, &pair.step, &pair.change);
        let least = dot(&self.inertia, &pair.step, &pair.step);
        // The bodies' own inertia has curvature 1; anything below half of it is noise.
        if pair.product > 0.5 * least && least > 0.0 {
            self.used += 1;
        }
    }

    fn place(&mut self) {
        for (k, motion) in self.motion.iter_mut().enumerate() {
            *motion = self.start[k].plus(self.line.step, &self.direction[k]);
        }
    }
}

impl Line {
    /// Returns the next step from the slope at the present one.
    fn next(&mut self, slope: f64) -> f64 {
        let here = (self.step, slope);
        if slope > 0.0 {
            self.low = [self.low[1], here];
        } else {
            self.high = Some(here);
        }
        let [before, low] = self.low;
        // Extrapolate through the last two points with a positive slope.
        let fall = (before.1 - low.1) / (low.0 - before.0);
        let onward = low.0 + low.1 / fall;
        let Some(high) = self.high else {
            let far = 20.0 * low.0;
            return if fall > 0.0 { onward.min(far) } else { far };
        };
        let width = high.0 - low.0;
        if slope > 0.0 && onward > low.0 && onward < high.0 {
            return onward;
        }
        let secant = low.0 + width * low.1 / (low.1 - high.1);
        // A contact that opened inside the bracket leaves almost no slope on the high side.
        let near = if low.0 == 0.0 { 0.1 * high.0 } else { low.0 + 0.5 * width };
        secant.min(near)
    }
}

/// Returns the inner product weighted by the bodies' inertia.
fn dot(inertia: &[Inertia], a: &[Motion], b: &[Motion]) -> f64 {
    let bodies = a.iter().zip(b).zip(inertia);
    let one = |((a, b), inertia): ((&Motion, &Motion), &Inertia)| {
        inertia.mass_kg * a.linear.dot(&b.linear) + a.angular.dot(&(inertia.moment_kg_m2 * b.angular))
    };
    bodies.map(one).sum()
}

/// Adds scale b to a.
fn add(a: &mut [Motion], scale: f64, b: &[Motion]) {
    for (x, y) in a.iter_mut().zip(b) {
        *x = x.plus(scale, y);
    }
}
