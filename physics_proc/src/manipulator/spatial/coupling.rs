//! The tendons' rank-one stiffnesses in the implicit operator of a spatial chain: the method of `manipulator::coupling`.

use super::algebra::Spatial;
use super::articulated::Articulated;
use super::layout::SpatialLayout;
use super::tendon::TendonLoad;

/// `A = H + sum_t c_t g_t g_t'` and its inverse.
#[derive(Debug, Clone)]
pub(super) struct Coupling {
    /// Whether there is anything to couple.
    pub active: bool,
    /// alpha of each tendon, N/m.
    alpha: [f64; 2],
    slope: [Vec<f64>; 2],
    /// H^-1 g_t.
    response: [Vec<f64>; 2],
    scratch: Vec<f64>,
    /// Motions of the links under H^-1 g_t.
    pub link_response: [Vec<Spatial>; 2],
    /// Symmetric 2 x 2 kernel: A^-1 = H^-1 - Z kernel Z'; entries 00 01 11.
    kernel: [f64; 3],
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl Coupling {
    pub fn new(freedoms: usize, links: usize) -> Self {
        let blank = || vec![0.0; freedoms];
        Self {
            active: false,
            alpha: [0.0; 2],
            slope: [blank(), blank()],
            response: [blank(), blank()],
            scratch: blank(),
            link_response: [vec![[0.0; 6]; links], vec![[0.0; 6]; links]],
            kernel: [0.0; 3],
        }
    }

    /// Sets up the coupling for a factored H; the rank-one stiffness enters with weight `scale` (dt^2 of the method).
    pub fn update<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        articulated: &mut Articulated,
        load: &TendonLoad,
        scale: f64,
    ) {
        self.active = load.coupled[0] || load.coupled[1];
        self.alpha = [0.0; 2];
        if !self.active {
            return;
        }
        for t in 0..2 {
            if !load.coupled[t] {
                self.slope[t].fill(0.0);
                self.response[t].fill(0.0);
                self.link_response[t].fill([0.0; 6]);
                continue;
            }
            self.slope[t].copy_from_slice(&load.slope[t]);
            articulated.solve(layout, None, &load.gradient[t], &mut self.scratch);
            let cross = dot(&self.slope[t], &self.scratch);
            articulated.solve(layout, None, &load.slope[t], &mut self.response[t]);
            let own = dot(&self.slope[t], &self.response[t]);
            self.alpha[t] = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
            articulated.link_motions(layout, &self.response[t], &mut self.link_response[t]);
        }
        let c = self.alpha.map(|a| a * scale);
        let s00 = dot(&self.slope[0], &self.response[0]);
        let s01 = dot(&self.slope[0], &self.response[1]);
        let s11 = dot(&self.slope[1], &self.response[1]);
        let determinant = (1.0 + c[0] * s00) * (1.0 + c[1] * s11) - c[0] * c[1] * s01 * s01;
        self.kernel = [
            c[0] * (1.0 + c[1] * s11) / determinant,
            -c[0] * c[1] * s01 / determinant,
            c[1] * (1.0 + c[0] * s00) / determinant,
        ];
    }

    /// Adds minus the rank-one stiffnesses times the velocities `rate` to `rhs`.
    pub fn subtract_stiffness(&self, rate: &[f64], rhs: &mut [f64]) {
        if !self.active {
            return;
        }
        for t in 0..2 {
            let scale = self.alpha[t] * dot(&self.slope[t], rate);
            for (r, slope) in rhs.iter_mut().zip(&self.slope[t]) {
                *r -= scale * slope;
            }
        }
    }

    /// Kernel times a pair.
    pub fn weigh(&self, p: [f64; 2]) -> [f64; 2] {
        [self.kernel[0] * p[0] + self.kernel[1] * p[1], self.kernel[1] * p[0] + self.kernel[2] * p[1]]
    }

    /// A^-1 b from H^-1 b.
    pub fn correct(&self, x: &mut [f64]) {
        if !self.active {
            return;
        }
        let w = self.weigh([dot(&self.slope[0], x), dot(&self.slope[1], x)]);
        for (response, w) in self.response.iter().zip(w) {
            for (x, r) in x.iter_mut().zip(response) {
                *x -= w * r;
            }
        }
    }

    /// Velocity of freedom `k` under H^-1 g of each tendon.
    pub fn freedom_response(&self, k: usize) -> [f64; 2] {
        [self.response[0][k], self.response[1][k]]
    }
}
