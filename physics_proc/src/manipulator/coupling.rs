//! The part of the implicit operator that couples all joints: elastic tendons held by displacement, and friction.
//!
//! Per tendon it is the rank-one matrix `a g'` with `g = dl/dq` and `a = -d torque / dl`. Friction makes `a` not
//! parallel to `g`. Contact needs a symmetric operator, so `a` is replaced by `alpha g` with `alpha = (g' H^-1 a) /
//! (g' H^-1 g)`: the take-up l, the only stiff direction, responds as it does under the exact operator. Statics do not
//! depend on the replacement. The inverse follows by Woodbury's identity.

use super::MAX_JOINTS;
use super::articulated::{Articulated, Generalised, Spatial};
use super::tendon::TendonLoad;

/// `A = H + sum_t c_t g_t g_t'` and its inverse.
#[derive(Debug, Clone)]
pub(super) struct Coupling {
    /// Whether there is anything to couple.
    pub active: bool,
    /// alpha of each tendon, N/m.
    pub alpha: [f64; 2],
    slope: [[f64; MAX_JOINTS]; 2],
    /// H^-1 g_t.
    pub response: [Generalised; 2],
    /// Symmetric 2 x 2 kernel: A^-1 = H^-1 - Z kernel Z'; entries 00 01 11.
    pub kernel: [f64; 3],
}

fn dot_joints(a: &[f64; MAX_JOINTS], b: &[f64; MAX_JOINTS]) -> f64 {
    let mut sum = 0.0;
    for i in 0..MAX_JOINTS {
        sum += a[i] * b[i];
    }
    sum
}

impl Coupling {
    pub fn new() -> Self {
        Self {
            active: false,
            alpha: [0.0; 2],
            slope: [[0.0; MAX_JOINTS]; 2],
            response: [Generalised::ZERO; 2],
            kernel: [0.0; 3],
        }
    }

    /// Sets up the coupling for a factored H; the rank-one stiffness enters with weight `scale` (dt^2 of the method).
    pub fn update(&mut self, articulated: &Articulated, load: &TendonLoad, scale: f64) {
        self.active = load.coupled[0] || load.coupled[1];
        self.alpha = [0.0; 2];
        if !self.active {
            return;
        }
        let none: [Spatial; MAX_JOINTS + 1] = [[0.0; 3]; MAX_JOINTS + 1];
        for t in 0..2 {
            self.response[t] = Generalised::ZERO;
            if !load.coupled[t] {
                self.slope[t] = [0.0; MAX_JOINTS];
                continue;
            }
            self.slope[t] = load.slope[t];
            let slope = Generalised { joint: load.slope[t], mount: [0.0; 3] };
            let gradient = Generalised { joint: load.gradient[t], mount: [0.0; 3] };
            self.response[t] = articulated.solve(&none, &slope);
            let own = dot_joints(&self.slope[t], &self.response[t].joint);
            let cross = dot_joints(&self.slope[t], &articulated.solve(&none, &gradient).joint);
            self.alpha[t] = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
        }
        let c = self.alpha.map(|a| a * scale);
        let s00 = dot_joints(&self.slope[0], &self.response[0].joint);
        let s01 = dot_joints(&self.slope[0], &self.response[1].joint);
        let s11 = dot_joints(&self.slope[1], &self.response[1].joint);
        let determinant = (1.0 + c[0] * s00) * (1.0 + c[1] * s11) - c[0] * c[1] * s01 * s01;
        self.kernel = [
            c[0] * (1.0 + c[1] * s11) / determinant,
            -c[0] * c[1] * s01 / determinant,
            c[1] * (1.0 + c[0] * s00) / determinant,
        ];
    }

    /// Adds `-weight` times the rank-one stiffness times joint velocities `rate` to `rhs`.
    pub fn subtract_stiffness(&self, rate: &[f64; MAX_JOINTS], weight: f64, rhs: &mut [f64; MAX_JOINTS]) {
        if !self.active {
            return;
        }
        for t in 0..2 {
            let scale = weight * self.alpha[t] * dot_joints(&self.slope[t], rate);
            for (r, slope) in rhs.iter_mut().zip(&self.slope[t]) {
                *r -= scale * slope;
            }
        }
    }

    /// A^-1 b from H^-1 b.
    pub fn correct(&self, x: Generalised) -> Generalised {
        if !self.active {
            return x;
        }
        let p = [dot_joints(&self.slope[0], &x.joint), dot_joints(&self.slope[1], &x.joint)];
        let w0 = self.kernel[0] * p[0] + self.kernel[1] * p[1];
        let w1 = self.kernel[1] * p[0] + self.kernel[2] * p[1];
        x.plus(-w0, &self.response[0]).plus(-w1, &self.response[1])
    }
}
