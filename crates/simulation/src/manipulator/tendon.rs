//! Joint torques of tendons that are routed from hole to hole.
//!
//! A tendon in a channel at (d, e) from the axis, with free gap g, spans a flexure bent by q with the chord
//! `g cos(q/2) - 2 d sin(q/2)`; in the planar rung e has no effect. The antagonist pair lies at d and -d. The
//! tool takes up `l = sum (g - chord)` of tendon, minus that in its rest shape, so a tension T exerts the
//! joint torque `T dl/dq = T (d cos(q/2) + g/2 sin(q/2))`. The sum is over the flexures that the tendon
//! bends.
//!
//! Capstan friction reduces the tension along the channel, `T_i = T_0 exp(-mu s phi_i)`, with the wrap angle
//! `phi_i = sum_{j<i} |q_j| + |q_i| / 2`. The tendon turns by half the joint angle at each of the two holes
//! of a flexure, which makes the discrete law second-order accurate relative to the continuous channel `dT =
//! -mu T dphi`. The sliding state s in [-1, 1] is Dahl's play operator on the take-up: it moves by dl /
//! presliding and saturates at +1 (tendon pulled in) and -1 (tendon let out), which gives the hysteresis
//! loop.
//!
//! At saturation the friction changes only if the tendon reverses, so the implicit operator needs the sliding
//! direction before the step is taken. The step assumes that every saturated tendon keeps sliding, and is
//! solved again if the resulting velocities reverse one ([`turns`]). The rank-one stiffness of friction
//! reduces that reversal but does not undo it.

use serde::{Deserialize, Serialize};

use super::articulated::Generalised;
use super::coupling::TendonTerms;
use super::geometry::{Configuration, Layout};
use super::helix;
use super::parameters::{ManipulatorParameters, TendonParameters};
use super::state::TendonCommand;
use super::{MAX_JOINTS, MAX_TENDONS};

/// Largest capstan exponent at which a Rosenbrock step is taken. The operator ignores the effect of one
/// flexure's wrap on the friction in more distal ones; at 10 ms this excites oscillations from an exponent of
/// 1.5 upward.
const MAX_CAPSTAN_EXPONENT: f64 = 1.25;

/// Routing of the tendons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Channels {
    pub count: usize,
    /// Position relative to the tool axis along base x and y, m.
    pub offset_m: [[f64; 2]; MAX_TENDONS],
    /// The first flexure that each bends, and the one after the last.
    pub reach: [[usize; 2]; MAX_TENDONS],
    /// Parameters of each tendon.
    pub cable: [TendonParameters; MAX_TENDONS],
    /// Take-up in the rest shape, m.
    pub rest_m: [f64; MAX_TENDONS],
    /// Total bend of the tool per end moment, rad/(N m).
    compliance_rad_per_nm: f64,
}

impl Channels {
    /// Returns the channels of the parameters, or the antagonist pair.
    pub fn of(parameters: &ManipulatorParameters) -> Self {
        let mut offset_m = [[0.0; 2]; MAX_TENDONS];
        let joints = parameters.joint_positions_m.len();
        let mut reach = [[0, joints]; MAX_TENDONS];
        let mut cable = [parameters.tendon; MAX_TENDONS];
        if parameters.tendon_routes.is_none() {
            offset_m[0][0] = parameters.tendon.offset_m;
            offset_m[1][0] = -parameters.tendon.offset_m;
        }
        for (t, route) in parameters.tendon_routes.iter().flatten().enumerate().take(MAX_TENDONS) {
            offset_m[t] = route.channel_m;
            reach[t] = [route.reach.from, route.reach.to.unwrap_or(joints)];
            let (stiffness, friction) = (route.stiffness_n_per_m, route.friction_coefficient);
            cable[t].stiffness_n_per_m = stiffness.unwrap_or(parameters.tendon.stiffness_n_per_m);
            cable[t].friction_coefficient = friction.unwrap_or(parameters.tendon.friction_coefficient);
        }
        let gap_m = parameters.tendon.gap_m;
        let rest = |t: usize, joint: usize| {
            let (sin, cos) = libm::sincos(0.5 * parameters.rest_rad(joint));
            gap_m * (1.0 - cos) + 2.0 * offset_m[t][0] * sin
        };
        let mut rest_m =
            core::array::from_fn(|t: usize| (reach[t][0]..reach[t][1]).map(|i| rest(t, i)).sum());
        for (t, route) in parameters.tendon_routes.iter().flatten().enumerate().take(MAX_TENDONS) {
            let crossings = helix::crossings(parameters, route);
            let bent = (reach[t][0]..).zip(&crossings);
            let each_m =
                bent.map(|(joint, crossing)| crossing.chord::<1>(&[parameters.rest_rad(joint)]).length_m);
            if !crossings.is_empty() {
                rest_m[t] = each_m.sum();
            }
        }
        let compliance_rad_per_nm = parameters.joint_stiffness_nm_per_rad.iter().map(|k| 1.0 / k).sum();
        Self { count: parameters.tendon_count(), offset_m, reach, cable, rest_m, compliance_rad_per_nm }
    }

    /// Returns the flexures that tendon `t` bends.
    pub fn flexures(&self, t: usize) -> core::ops::Range<usize> {
        self.reach[t][0]..self.reach[t][1]
    }

    /// Returns true if friction is too strong for a Rosenbrock step. The measure is the capstan exponent mu
    /// phi, where mu is the largest of all and phi the sum of the bends, rad, that each tension alone would
    /// cause without friction and stops.
    pub fn bind(&self, tension_n: &[f64; MAX_TENDONS]) -> bool {
        let moment = |t: usize| tension_n[t] * libm::hypot(self.offset_m[t][0], self.offset_m[t][1]);
        let bend_rad = self.compliance_rad_per_nm * (0..self.count).map(moment).sum::<f64>();
        let friction = self.cable[..self.count].iter().map(|cable| cable.friction_coefficient);
        friction.fold(0.0, f64::max) * bend_rad > MAX_CAPSTAN_EXPONENT
    }
}

/// Tendon state carried from tick to tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct TendonMemory {
    /// Take-up at the end of the last tick, m.
    pub take_up_m: f64,
    /// Sliding state, -1 to 1.
    pub sliding: f64,
}

impl TendonMemory {
    /// Returns the sliding state after the take-up has changed to `take_up_m`.
    pub fn sliding_at(&self, take_up_m: f64, parameters: &TendonParameters) -> f64 {
        (self.sliding + (take_up_m - self.take_up_m) / parameters.presliding_m).clamp(-1.0, 1.0)
    }

    /// Advances the sliding state of tendon `t` to a new take-up; returns its tension (N) and displacement
    /// (m).
    pub fn advance(
        &mut self,
        take_up_m: f64,
        parameters: &TendonParameters,
        command: &TendonCommand,
        t: usize,
    ) -> (f64, f64) {
        *self = TendonMemory { take_up_m, sliding: self.sliding_at(take_up_m, parameters) };
        let tension_n = base_tension(parameters, command, t, take_up_m);
        let displacement_m = if command.is_displacement() {
            command.values()[t]
        } else {
            take_up_m + tension_n / parameters.stiffness_n_per_m
        };
        (tension_n, displacement_m)
    }
}

/// Joint torques of all tendons in one configuration, and their derivatives.
#[derive(Debug, Clone)]
pub(super) struct TendonLoad {
    pub channels: Channels,
    /// Torque on each joint, N m.
    pub torque: [f64; MAX_JOINTS],
    /// Stiffness -d torque_i / d q_i at constant tension and sliding state, N m/rad.
    pub stiffness: [f64; MAX_JOINTS],
    /// Slope d take-up / d q_i of each tendon, m/rad.
    pub slope: [Generalised; MAX_TENDONS],
    /// Gradient -d torque_i / d take-up of each tendon, N m/m.
    pub gradient: [Generalised; MAX_TENDONS],
    /// Part of the slope of each tendon with friction whose share of the tension friction takes.
    pub lost: [[f64; MAX_JOINTS]; MAX_TENDONS],
    /// True for each tendon whose gradient is not zero.
    pub coupled: [bool; MAX_TENDONS],
    /// True if the step assumes that this tendon's friction does not change: it was sliding at the given
    /// velocity and keeps sliding.
    pub slides_on: [bool; MAX_TENDONS],
    /// Tension at the proximal end, N.
    pub tension_n: [f64; MAX_TENDONS],
}

impl TendonLoad {
    pub fn new(channels: Channels) -> Self {
        Self {
            channels,
            torque: [0.0; MAX_JOINTS],
            stiffness: [0.0; MAX_JOINTS],
            slope: [Generalised::ZERO; MAX_TENDONS],
            gradient: [Generalised::ZERO; MAX_TENDONS],
            lost: [[0.0; MAX_JOINTS]; MAX_TENDONS],
            coupled: [false; MAX_TENDONS],
            slides_on: [false; MAX_TENDONS],
            tension_n: [0.0; MAX_TENDONS],
        }
    }

    /// Returns the terms that couple the joints.
    pub fn terms(&self) -> TendonTerms<'_, Generalised> {
        let Self { channels, coupled, slope, gradient, .. } = self;
        TendonTerms { count: channels.count, coupled, slope, gradient }
    }

    /// Evaluates all tendons. `rate`, the joint velocities, shows whether a saturated sliding state is about
    /// to reverse.
    pub fn evaluate(
        &mut self,
        layout: &Layout,
        (configuration, q, rate): (&Configuration, &[f64; MAX_JOINTS], &[f64; MAX_JOINTS]),
        command: &TendonCommand,
        memory: &[TendonMemory; MAX_TENDONS],
    ) {
        let n = layout.joints;
        self.torque[..n].fill(0.0);
        self.stiffness[..n].fill(0.0);
        for t in 0..self.channels.count {
            let cable = self.channels.cable[t];
            let parameters = &cable;
            let slope_rate = self.update_slope(t, configuration, rate);
            let take_up = self.take_up(configuration, t);
            let tension = base_tension(parameters, command, t, take_up);
            self.tension_n[t] = tension;
            let sliding = memory[t].sliding_at(take_up, parameters);
            let saturated = sliding.abs() >= 1.0 && sliding * slope_rate >= 0.0;
            let stretched = command.is_displacement() && tension > 0.0;
            let elastic = if stretched { parameters.stiffness_n_per_m } else { 0.0 };
            let frictional = parameters.friction_coefficient > 0.0 && tension > 0.0;
            self.coupled[t] = elastic > 0.0 || (frictional && !saturated);
            self.slides_on[t] = frictional && saturated;
            if !frictional && parameters.friction_coefficient > 0.0 {
                self.lost[t].fill(0.0);
            }
            let mut wrap = 0.0;
            for i in self.channels.flexures(t) {
                wrap += 0.5 * q[i].abs();
                let share = if frictional {
                    libm::exp(-parameters.friction_coefficient * sliding * wrap)
                } else {
                    1.0
                };
                let local = tension * share;
                let slope = self.slope[t].joint[i];
                self.torque[i] += local * slope;
                let half = [configuration.half_sin[i], configuration.half_cos[i]];
                let [_, curvature] = planar_slopes(self.channels.offset_m[t][0], parameters.gap_m, half);
                self.stiffness[i] -= local * curvature;
                self.gradient[t].joint[i] = elastic * share * slope;
                if frictional {
                    self.lost[t][i] = (1.0 - share) * slope;
                    let friction = local * parameters.friction_coefficient * slope;
                    self.stiffness[i] += 0.5 * friction * sliding * sign(q[i]);
                    if !saturated {
                        self.gradient[t].joint[i] += friction * wrap / parameters.presliding_m;
                    }
                }
                wrap += 0.5 * q[i].abs();
            }
        }
    }

    /// Updates d take-up / dq of tendon `t`; returns the take-up's rate.
    fn update_slope(&mut self, t: usize, configuration: &Configuration, rate: &[f64; MAX_JOINTS]) -> f64 {
        let gap_m = self.channels.cable[t].gap_m;
        let mut slope_rate = 0.0;
        for i in self.channels.flexures(t) {
            let half = [configuration.half_sin[i], configuration.half_cos[i]];
            let [slope, _] = planar_slopes(self.channels.offset_m[t][0], gap_m, half);
            self.slope[t].joint[i] = slope;
            slope_rate += slope * rate[i];
        }
        slope_rate
    }

    /// Returns the length of tendon `t` taken up by the bent tool, from its rest shape, m.
    pub fn take_up(&self, configuration: &Configuration, t: usize) -> f64 {
        let gap_m = self.channels.cable[t].gap_m;
        let mut sum = 0.0;
        for i in self.channels.flexures(t) {
            sum += gap_m * (1.0 - configuration.half_cos[i])
                + 2.0 * self.channels.offset_m[t][0] * configuration.half_sin[i];
        }
        sum - self.channels.rest_m[t]
    }
}

/// Returns the first and second derivative of a tendon's take-up by the angle of a planar flexure, m/rad and
/// m/rad^2, at sine and cosine of half the angle.
#[inline(always)]
pub(super) fn planar_slopes(offset_m: f64, gap_m: f64, [half_sin, half_cos]: [f64; 2]) -> [f64; 2] {
    [offset_m * half_cos + 0.5 * gap_m * half_sin, 0.25 * gap_m * half_cos - 0.5 * offset_m * half_sin]
}

/// Returns true if velocities `after` reverse a tendon that was assumed to keep sliding as with `before`;
/// `slope` is d take-up / dq of each.
pub(super) fn turns<S: AsRef<[f64]>>(
    slides_on: &[bool; MAX_TENDONS],
    slope: &[S; MAX_TENDONS],
    [before, after]: [&[f64]; 2],
) -> bool {
    let rate = |slope: &S, v: &[f64]| slope.as_ref().iter().zip(v).map(|(slope, v)| slope * v).sum::<f64>();
    slides_on
        .iter()
        .zip(slope)
        .any(|(slides_on, slope)| *slides_on && rate(slope, before) * rate(slope, after) < 0.0)
}

/// Returns the power that friction takes from tendons with these tensions, W: of each the tension times
/// `lost`, the part of its slope that friction takes, times the rates.
pub(super) fn friction_w<S: AsRef<[f64]>>(
    tension_n: &[f64; MAX_TENDONS],
    lost: &[S; MAX_TENDONS],
    rate_rad_per_s: &[f64],
) -> f64 {
    let pulls = tension_n.iter().zip(lost).filter(|(tension_n, _)| **tension_n > 0.0);
    let each_w = pulls.map(|(tension_n, lost)| {
        tension_n * lost.as_ref().iter().zip(rate_rad_per_s).map(|(lost, rate)| lost * rate).sum::<f64>()
    });
    each_w.sum()
}

/// Returns d|x| / dx, with 0 at 0.
pub(super) fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

/// Returns the tension at the proximal end: as commanded, or from the stretch under the commanded pull. A
/// slack tendon does not push.
pub(super) fn base_tension(
    parameters: &TendonParameters,
    command: &TendonCommand,
    t: usize,
    take_up_m: f64,
) -> f64 {
    let value = command.values()[t];
    let tension_n =
        if command.is_displacement() { parameters.stiffness_n_per_m * (value - take_up_m) } else { value };
    tension_n.max(0.0)
}
