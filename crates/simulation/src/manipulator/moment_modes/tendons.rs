//! Tendons on the flexures, by the formulas of [`crate::manipulator::tendon`]; slack tendons cost nothing
//! here.

use super::basis::Basis;
use super::shape::{FlexureArray, Shape};
use crate::manipulator::state::TendonCommand;
use crate::manipulator::tendon::{Channels, TendonMemory, base_tension, planar_slopes, sign};
use crate::manipulator::{MAX_JOINTS, MAX_TENDONS};

/// Sums over the flexures from which all take-ups are computed.
#[derive(Debug, Clone, Copy)]
pub(super) struct BendSums {
    /// Sum of the sines of half the angles.
    sin: f64,
    /// Sum of 1 minus the cosines of half the angles.
    versed: f64,
}

impl BendSums {
    /// Sums of the straight tool.
    pub const NONE: Self = Self { sin: 0.0, versed: 0.0 };

    #[inline(always)]
    pub fn of(shape: &Shape) -> Self {
        // Four partial sums, in a fixed order.
        let (mut sin, mut versed) = ([0.0; 4], [0.0; 4]);
        for (s, c) in shape.half_sin.chunks_exact(4).zip(shape.half_cos.chunks_exact(4)) {
            for lane in 0..4 {
                sin[lane] += s[lane];
                versed[lane] += 1.0 - c[lane];
            }
        }
        let total = |x: [f64; 4]| (x[0] + x[1]) + (x[2] + x[3]);
        Self { sin: total(sin), versed: total(versed) }
    }

    /// Returns the length of tendon `t` taken up, from the rest shape, m.
    #[inline(always)]
    pub fn take_up_m(&self, channels: &Channels, t: usize) -> f64 {
        channels.cable[t].gap_m * self.versed + 2.0 * channels.offset_m[t][0] * self.sin - channels.rest_m[t]
    }
}

/// Effect of the tendons in one shape.
#[derive(Debug, Clone)]
pub(super) struct Tendons<const N: usize> {
    pub channels: Channels,
    /// Torque on each flexure, N m.
    pub torque: FlexureArray,
    /// Stiffness -d torque_i / d q_i at constant tension and sliding state, N m/rad.
    pub stiffness: FlexureArray,
    /// Slope d take-up / d freedom of each pulling tendon, and gradient -d force / d take-up.
    pub slope: [[f64; N]; MAX_TENDONS],
    pub gradient: [[f64; N]; MAX_TENDONS],
    /// Part of the slope d take-up / d angle of each tendon with friction whose share of the tension friction
    /// takes.
    pub lost: [FlexureArray; MAX_TENDONS],
    /// True for each tendon whose gradient is not zero.
    pub coupled: [bool; MAX_TENDONS],
    /// True if the step assumes that this tendon's friction does not change: it was sliding at the given
    /// velocity and keeps sliding.
    pub slides_on: [bool; MAX_TENDONS],
    /// Tension at the proximal end, N.
    pub tension_n: [f64; MAX_TENDONS],
}

impl<const N: usize> Tendons<N> {
    pub fn new(channels: Channels) -> Self {
        Self {
            channels,
            torque: [0.0; MAX_JOINTS],
            stiffness: [0.0; MAX_JOINTS],
            slope: [[0.0; N]; MAX_TENDONS],
            gradient: [[0.0; N]; MAX_TENDONS],
            lost: [[0.0; MAX_JOINTS]; MAX_TENDONS],
            coupled: [false; MAX_TENDONS],
            slides_on: [false; MAX_TENDONS],
            tension_n: [0.0; MAX_TENDONS],
        }
    }

    /// Evaluates all tendons in a shape with the flexures' angles `q`, rad. The freedoms' velocities `v` show
    /// whether a saturated sliding state is about to reverse.
    #[inline(always)]
    pub fn evaluate(
        &mut self,
        basis: &Basis<N>,
        (shape, bent, q, v): (&Shape, &BendSums, &FlexureArray, &[f64; N]),
        command: &TendonCommand,
        memory: &[TendonMemory; MAX_TENDONS],
    ) {
        self.torque = [0.0; MAX_JOINTS];
        self.stiffness = [0.0; MAX_JOINTS];
        for t in 0..self.channels.count {
            let cable = self.channels.cable[t];
            let take_up_m = bent.take_up_m(&self.channels, t);
            let tension = base_tension(&cable, command, t, take_up_m);
            self.tension_n[t] = tension;
            (self.coupled[t], self.slides_on[t]) = (false, false);
            let frictional = cable.friction_coefficient > 0.0;
            if tension <= 0.0 {
                if frictional {
                    self.lost[t].fill(0.0);
                }
                continue;
            }
            let (offset_m, gap_m) = (self.channels.offset_m[t][0], cable.gap_m);
            let (mut slope, mut curvature) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
            for i in 0..MAX_JOINTS {
                [slope[i], curvature[i]] =
                    planar_slopes(offset_m, gap_m, [shape.half_sin[i], shape.half_cos[i]]);
            }
            if !frictional {
                for i in 0..MAX_JOINTS {
                    self.torque[i] += tension * slope[i];
                    self.stiffness[i] -= tension * curvature[i];
                }
            }
            if frictional || command.is_displacement() {
                self.slope[t] = basis.project(&slope);
                let sliding = memory[t].sliding_at(take_up_m, &cable);
                let at = (tension, sliding, command.is_displacement());
                self.couple(basis, t, (q, &slope, &curvature), v, at);
            }
        }
    }

    /// Computes the dependence of the tension of tendon `t` on its take-up, and its friction loss.
    #[inline(always)]
    fn couple(
        &mut self,
        basis: &Basis<N>,
        t: usize,
        (q, slope, curvature): (&FlexureArray, &FlexureArray, &FlexureArray),
        v: &[f64; N],
        (tension, sliding, stretched): (f64, f64, bool),
    ) {
        let cable = self.channels.cable[t];
        let mu = cable.friction_coefficient;
        let elastic = if stretched { cable.stiffness_n_per_m } else { 0.0 };
        let rate: f64 = self.slope[t].iter().zip(v).map(|(slope, v)| slope * v).sum();
        let saturated = sliding.abs() >= 1.0 && sliding * rate >= 0.0;
        self.slides_on[t] = mu > 0.0 && saturated;
        self.coupled[t] = stretched || (mu > 0.0 && !saturated);
        let mut gradient = slope.map(|slope| elastic * slope);
        if mu > 0.0 {
            let mut wrap = 0.0;
            for i in self.channels.flexures(t) {
                wrap += 0.5 * q[i].abs();
                let share = libm::exp(-mu * sliding * wrap);
                self.lost[t][i] = (1.0 - share) * slope[i];
                let local = tension * share;
                let friction = local * mu * slope[i];
                self.torque[i] += local * slope[i];
                self.stiffness[i] += 0.5 * friction * sliding * sign(q[i]) - local * curvature[i];
                gradient[i] *= share;
                if !saturated {
                    gradient[i] += friction * wrap / cable.presliding_m;
                }
                wrap += 0.5 * q[i].abs();
            }
        }
        self.gradient[t] = basis.project(&gradient);
    }
}
