//! O(n) factorisation of a spatial chain's implicit operator.
//!
//! `H = M(q) + diag` by the articulated-body algorithm (Featherstone 2008, Rigid Body Dynamics Algorithms,
//! ch. 7), one single-DoF joint at a time: a flexure with three or six degrees of freedom is as many joints
//! with massless bodies between them, which the positive diagonal allows.

use super::algebra::{Operator, Spatial, ZERO, add_body, add_outer, add_scaled, dot, times};
use super::layout::{Configuration, SpatialLayout};

/// The factored operator.
#[derive(Debug, Clone)]
pub(super) struct Articulated {
    pub axis: Vec<Spatial>,
    /// Articulated inertia times axis.
    pub bias: Vec<Spatial>,
    /// 1 / (axis . bias + diagonal).
    pub inverse: Vec<f64>,
    torque: Vec<f64>,
}

impl Articulated {
    pub fn new(freedoms: usize) -> Self {
        Self {
            axis: vec![ZERO; freedoms],
            bias: vec![ZERO; freedoms],
            inverse: vec![0.0; freedoms],
            torque: vec![0.0; freedoms],
        }
    }

    /// Factors M(configuration) + diag(`diagonal`).
    pub fn factor<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        configuration: &Configuration<D>,
        diagonal: &[f64],
    ) {
        let mut inertia: Operator = [ZERO; 6];
        self.axis.copy_from_slice(&configuration.axis);
        for link in (0..=layout.joints).rev() {
            let body = &layout.body[link];
            let centre = configuration.point(link, body.centre_m);
            add_body(&mut inertia, &layout.moments(link), &centre, &configuration.direction(link));
            for k in layout.freedoms_of(link).rev() {
                let bias = times(&inertia, &self.axis[k]);
                let inverse = 1.0 / (dot(&self.axis[k], &bias) + diagonal[k]);
                add_outer(&mut inertia, -inverse, &bias);
                self.bias[k] = bias;
                self.inverse[k] = inverse;
            }
        }
    }

    /// Solves H x = `generalised` + sum over links of `force` (expressed at the base origin; index 0 is the
    /// shaft).
    pub fn solve<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        force: Option<&[Spatial]>,
        generalised: &[f64],
        out: &mut [f64],
    ) {
        let mut sum = ZERO;
        for link in (0..=layout.joints).rev() {
            if let Some(force) = force {
                add_scaled(&mut sum, 1.0, &force[link]);
            }
            for k in layout.freedoms_of(link).rev() {
                let t = (generalised[k] + dot(&self.axis[k], &sum)) * self.inverse[k];
                add_scaled(&mut sum, -t, &self.bias[k]);
                self.torque[k] = t;
            }
        }
        let mut v = ZERO;
        for k in 0..layout.freedoms() {
            let x = self.torque[k] - dot(&self.bias[k], &v) * self.inverse[k];
            add_scaled(&mut v, x, &self.axis[k]);
            out[k] = x;
        }
    }

    /// Computes the motions of all links for generalised velocities `x`.
    pub fn link_motions<const D: usize>(&self, layout: &SpatialLayout<D>, x: &[f64], out: &mut [Spatial]) {
        let mut v = ZERO;
        for link in 0..=layout.joints {
            for k in layout.freedoms_of(link) {
                add_scaled(&mut v, x[k], &self.axis[k]);
            }
            out[link] = v;
        }
    }
}
