//! The tendons' rank-one stiffnesses in a spatial chain's implicit operator, by the method of `manipulator::coupling`.

use super::articulated::Articulated;
use super::layout::SpatialLayout;
use super::tendon::TendonLoad;
use crate::manipulator::MAX_TENDONS;
use crate::manipulator::contact::Chain;
use crate::manipulator::coupling::Kernel;

/// `A = H + sum_t c_t g_t g_t'` and its inverse.
#[derive(Debug, Clone)]
pub(super) struct Coupling {
    /// True if any tendon couples the joints.
    pub active: bool,
    /// alpha of each tendon, N/m.
    alpha: [f64; MAX_TENDONS],
    /// Number of tendons.
    pub count: usize,
    slope: [Vec<f64>; MAX_TENDONS],
    /// c_t.
    weight: [f64; MAX_TENDONS],
    /// H^-1 g_t.
    response: [Vec<f64>; MAX_TENDONS],
    scratch: Vec<f64>,
    kernel: Kernel,
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl Coupling {
    pub fn new(freedoms: usize) -> Self {
        let blank = || vec![0.0; freedoms];
        Self {
            active: false,
            alpha: [0.0; MAX_TENDONS],
            count: 0,
            slope: core::array::from_fn(|_| blank()),
            weight: [0.0; MAX_TENDONS],
            response: core::array::from_fn(|_| blank()),
            scratch: blank(),
            kernel: Kernel::NONE,
        }
    }

    /// Sets up the coupling for a factored H. `scale` weighs the rank-one stiffness (dt^2 for the method in use).
    pub fn update<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        articulated: &mut Articulated,
        load: &TendonLoad,
        scale: f64,
    ) {
        self.count = load.channels.count;
        self.active = load.coupled[..self.count].contains(&true);
        self.alpha = [0.0; MAX_TENDONS];
        if !self.active {
            return;
        }
        for t in 0..self.count {
            if !load.coupled[t] {
                self.slope[t].fill(0.0);
                self.response[t].fill(0.0);
                continue;
            }
            self.slope[t].copy_from_slice(&load.slope[t]);
            articulated.solve(layout, None, &load.gradient[t], &mut self.scratch);
            let cross = dot(&self.slope[t], &self.scratch);
            articulated.solve(layout, None, &load.slope[t], &mut self.response[t]);
            let own = dot(&self.slope[t], &self.response[t]);
            self.alpha[t] = if own > 0.0 { (cross / own).max(0.0) } else { 0.0 };
        }
        let c = self.alpha.map(|a| a * scale);
        self.weight = c;
        let mut s = [[0.0; MAX_TENDONS]; MAX_TENDONS];
        for i in 0..self.count {
            for j in i..self.count {
                s[i][j] = dot(&self.slope[i], &self.response[j]);
            }
        }
        self.kernel = Kernel::new(self.count, &c, &s);
    }

    /// Subtracts the rank-one stiffnesses times the velocities `rate` from `rhs`.
    pub fn subtract_stiffness(&self, rate: &[f64], rhs: &mut [f64]) {
        if !self.active {
            return;
        }
        for t in 0..self.count {
            let scale = self.alpha[t] * dot(&self.slope[t], rate);
            for (r, slope) in rhs.iter_mut().zip(&self.slope[t]) {
                *r -= scale * slope;
            }
        }
    }

    /// Multiplies the kernel by a vector.
    pub fn weigh(&self, p: &[f64; MAX_TENDONS]) -> [f64; MAX_TENDONS] {
        self.kernel.weigh(p)
    }

    /// Tells the contact solver's chain.
    pub fn describe<const N: usize>(&self, chain: &mut Chain<N>) {
        chain.coupled = if self.active { self.count.max(2) } else { 0 };
        chain.weight = self.weight;
        for t in 0..chain.coupled {
            chain.slope[t].copy_from_slice(&self.slope[t]);
        }
    }

    /// A^-1 b from H^-1 b.
    pub fn correct(&self, x: &mut [f64]) {
        if !self.active {
            return;
        }
        let mut p = [0.0; MAX_TENDONS];
        for t in 0..self.count {
            p[t] = dot(&self.slope[t], x);
        }
        let w = self.weigh(&p);
        for (response, w) in self.response[..self.count].iter().zip(w) {
            for (x, r) in x.iter_mut().zip(response) {
                *x -= w * r;
            }
        }
    }
}
