//! Tendons on a spatial chain.
//!
//! The law of the planar rung (see `manipulator::tendon`), extended by lateral bending and, in the full rung,
//! compression. A flexure bent by q, bent laterally by p (about x, so toward -y) and compressed by u takes up
//! `l = g (1 - cos(q/2) cos(p/2)) + 2 d sin(q/2) - 2 e sin(p/2) + u` of a tendon in the channel (d, e). A
//! tension T exerts the generalised force `T dl` on every coordinate. Torsion also winds the channels; this
//! is second order in the angle of one flexure and neglected. For a tendon that winds around the tool it is
//! first order: `manipulator::helix`.

use super::layout::SpatialLayout;
use crate::manipulator::MAX_TENDONS;
use crate::manipulator::coupling::TendonTerms;
use crate::manipulator::helix::{Chord, Crossing, crossings};
use crate::manipulator::parameters::{ManipulatorParameters, TendonParameters};
use crate::manipulator::state::TendonCommand;
use crate::manipulator::tendon::{Channels, TendonMemory, base_tension};
use crate::manipulator::tip_jacobian::Pulls;

/// Generalised forces of all tendons in one configuration, and their derivatives.
#[derive(Debug, Clone)]
pub(super) struct TendonLoad {
    pub channels: Channels,
    /// Crossings of each winding tendon, one per flexure that it bends.
    crossings: [Vec<Crossing>; MAX_TENDONS],
    /// Generalised force per coordinate, N m (N for displacements).
    pub torque: Vec<f64>,
    /// Stiffness -d force_i / d q_i at constant tension and sliding state.
    pub stiffness: Vec<f64>,
    /// Slope d take-up / d q_i of each tendon.
    pub slope: [Vec<f64>; MAX_TENDONS],
    /// Gradient -d force_i / d take-up of each tendon.
    pub gradient: [Vec<f64>; MAX_TENDONS],
    /// Part of the slope of each tendon with friction whose share of the tension friction takes.
    pub lost: [Vec<f64>; MAX_TENDONS],
    /// True for each tendon whose gradient is not zero.
    pub coupled: [bool; MAX_TENDONS],
    /// Tension at the proximal end, N.
    pub tension_n: [f64; MAX_TENDONS],
    /// True if the step assumes that this tendon's friction does not change: it was sliding at the given
    /// velocity and keeps sliding.
    pub slides_on: [bool; MAX_TENDONS],
}

/// Take-up of one flexure: length, slopes (bending, lateral), curvatures (bending, lateral), wrap angle of
/// the channel.
struct TakeUp {
    length_m: f64,
    slope: [f64; 2],
    curvature: [f64; 2],
    turn_rad: f64,
    /// Slope d wrap / d (bending, lateral); 0 where the flexure is straight.
    turn_slope: [f64; 2],
}

impl TakeUp {
    fn of<const D: usize>(
        p: &TendonParameters,
        layout: &SpatialLayout<D>,
        [toward, across]: [f64; 2],
        joint: usize,
        q: &[f64],
    ) -> Self {
        let k = layout.bend(joint);
        let lateral = if D > 1 { q[k + 1] } else { 0.0 };
        let ((sb, cb), (sl, cl)) = (libm::sincos(0.5 * q[k]), libm::sincos(0.5 * lateral));
        let straight = 0.25 * p.gap_m * cb * cl;
        let compression = if D == 6 { -q[k - 1] } else { 0.0 };
        let turn_rad = libm::sqrt(q[k] * q[k] + lateral * lateral);
        let turn_slope = if turn_rad == 0.0 { [0.0; 2] } else { [q[k] / turn_rad, lateral / turn_rad] };
        Self {
            length_m: p.gap_m * (1.0 - cb * cl) + 2.0 * toward * sb - 2.0 * across * sl + compression,
            slope: [toward * cb + 0.5 * p.gap_m * sb * cl, 0.5 * p.gap_m * cb * sl - across * cl],
            curvature: [straight - 0.5 * toward * sb, straight + 0.5 * across * sl],
            turn_rad,
            turn_slope,
        }
    }

    /// Returns the bending part of a chord.
    fn of_chord<const D: usize>(chord: &Chord) -> Self {
        let bend = SpatialLayout::<D>::BEND;
        let both = |of: &[f64; 6]| [of[bend], of[bend + 1]];
        Self {
            length_m: chord.length_m,
            slope: both(&chord.slope),
            curvature: both(&chord.curvature),
            turn_rad: chord.turn_rad,
            turn_slope: chord.turn_slope,
        }
    }
}

/// Generalised positions and assumed velocities.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion<'a> {
    pub q: &'a [f64],
    pub v: &'a [f64],
}

impl TendonLoad {
    pub fn new(freedoms: usize, parameters: &ManipulatorParameters) -> Self {
        let blank = || vec![0.0; freedoms];
        let route = |t: usize| parameters.tendon_routes.as_ref().and_then(|routes| routes.get(t));
        Self {
            channels: Channels::of(parameters),
            crossings: core::array::from_fn(|t| {
                route(t).map_or_else(Vec::new, |route| crossings(parameters, route))
            }),
            torque: blank(),
            stiffness: blank(),
            slope: core::array::from_fn(|_| blank()),
            gradient: core::array::from_fn(|_| blank()),
            lost: core::array::from_fn(|_| blank()),
            coupled: [false; MAX_TENDONS],
            tension_n: [0.0; MAX_TENDONS],
            slides_on: [false; MAX_TENDONS],
        }
    }

    /// Returns the terms that couple the joints.
    pub fn terms(&self) -> TendonTerms<'_, Vec<f64>> {
        let Self { channels, coupled, slope, gradient, .. } = self;
        TendonTerms { count: channels.count, coupled, slope, gradient }
    }

    /// Evaluates all tendons. The velocities show whether a saturated sliding state is about to reverse.
    pub fn evaluate<const D: usize>(
        &mut self,
        layout: &SpatialLayout<D>,
        motion: Motion<'_>,
        command: &TendonCommand,
        memory: &[TendonMemory; MAX_TENDONS],
    ) {
        self.torque.fill(0.0);
        self.stiffness.fill(0.0);
        for t in 0..self.channels.count {
            let cable = self.channels.cable[t];
            let p = &cable;
            let (length_m, rate) = self.update_slope(t, layout, motion);
            let tension = base_tension(p, command, t, length_m);
            self.tension_n[t] = tension;
            let sliding = memory[t].sliding_at(length_m, p);
            let saturated = sliding.abs() >= 1.0 && sliding * rate >= 0.0;
            let stretched = command.is_displacement() && tension > 0.0;
            let elastic = if stretched { p.stiffness_n_per_m } else { 0.0 };
            let frictional = p.friction_coefficient > 0.0 && tension > 0.0;
            self.coupled[t] = elastic > 0.0 || (frictional && !saturated);
            self.slides_on[t] = frictional && saturated;
            if !frictional && p.friction_coefficient > 0.0 {
                self.lost[t].fill(0.0);
            }
            if tension == 0.0 && !self.coupled[t] {
                continue;
            }
            let mut wrap = 0.0;
            for i in self.channels.flexures(t) {
                let bend = layout.bend(i);
                let first = bend - SpatialLayout::<D>::BEND;
                let (chord, take_up) = self.across(t, layout, i, motion.q);
                wrap += 0.5 * take_up.turn_rad;
                let mu = if frictional { p.friction_coefficient } else { 0.0 };
                let share = if frictional { libm::exp(-mu * sliding * wrap) } else { 1.0 };
                let local = tension * share;
                let winding = 0.5 * local * mu * sliding;
                let friction = if saturated { 0.0 } else { local * mu * wrap / p.presliding_m };
                wrap += 0.5 * take_up.turn_rad;
                for k in first..first + D {
                    let slope = self.slope[t][k];
                    self.torque[k] += local * slope;
                    self.gradient[t][k] = (elastic * share + friction) * slope;
                    if frictional {
                        self.lost[t][k] = (1.0 - share) * slope;
                    }
                }
                for k in 0..D.min(2) {
                    self.stiffness[bend + k] += winding * take_up.turn_slope[k] * self.slope[t][bend + k]
                        - local * take_up.curvature[k];
                }
                if let Some(chord) = &chord {
                    // Bends are handled in the loop above.
                    let bends = SpatialLayout::<D>::BEND..SpatialLayout::<D>::BEND + D.min(2);
                    for k in (0..D).filter(|k| !bends.contains(k)) {
                        self.stiffness[first + k] -= local * chord.curvature[k];
                    }
                }
            }
        }
    }

    /// Returns the stiffness of the coordinates of flexure `joint` from its tendons, and the generalised
    /// force on them per unit of each tension. Called from base to tip.
    pub fn on_flexure<const D: usize>(
        &self,
        layout: &SpatialLayout<D>,
        joint: usize,
        q: &[f64],
        pulls: &mut Pulls<'_>,
    ) -> ([f64; D], [[f64; MAX_TENDONS]; D]) {
        let (mut stiffness, mut pull) = ([0.0; D], [[0.0; MAX_TENDONS]; D]);
        let bend = SpatialLayout::<D>::BEND;
        for t in (0..self.channels.count).filter(|t| self.channels.flexures(*t).contains(&joint)) {
            let (chord, take_up) = self.across(t, layout, joint, q);
            let (mut slope, mut curvature) =
                chord.as_ref().map_or(([0.0; 6], [0.0; 6]), |chord| (chord.slope, chord.curvature));
            for k in 0..D.min(2) {
                (slope[bend + k], curvature[bend + k]) = (take_up.slope[k], take_up.curvature[k]);
            }
            if D == 6 && chord.is_none() {
                slope[bend - 1] = -1.0;
            }
            let [share, local_n, winding] = pulls.next(t, take_up.turn_rad);
            for k in 0..D {
                stiffness[k] -= local_n * curvature[k];
                pull[k][t] = share * slope[k];
            }
            for k in 0..D.min(2) {
                stiffness[bend + k] += winding * take_up.turn_slope[k] * slope[bend + k];
            }
        }
        (stiffness, pull)
    }

    /// Returns how the angles of flexure `joint` take up tendon `t`, and its chord unless it runs parallel to
    /// the axis.
    fn across<const D: usize>(
        &self,
        t: usize,
        layout: &SpatialLayout<D>,
        joint: usize,
        q: &[f64],
    ) -> (Option<Chord>, TakeUp) {
        let first = layout.bend(joint) - SpatialLayout::<D>::BEND;
        let chord = self.chord::<D>(t, joint, &q[first..first + D]);
        let take_up = match &chord {
            Some(chord) => TakeUp::of_chord::<D>(chord),
            None => TakeUp::of(&self.channels.cable[t], layout, self.channels.offset_m[t], joint, q),
        };
        (chord, take_up)
    }

    /// Returns the chord of tendon `t` across flexure `joint`, at its coordinates `q`; `None` if it runs
    /// parallel to the axis.
    fn chord<const D: usize>(&self, t: usize, joint: usize, q: &[f64]) -> Option<Chord> {
        let place = joint.checked_sub(self.channels.reach[t][0])?;
        self.crossings[t].get(place).map(|crossing| crossing.chord::<D>(q))
    }

    /// Updates d take-up / dq of tendon `t`; returns the take-up and its rate.
    fn update_slope<const D: usize>(
        &mut self,
        t: usize,
        layout: &SpatialLayout<D>,
        motion: Motion<'_>,
    ) -> (f64, f64) {
        let cable = self.channels.cable[t];
        let Motion { q, v } = motion;
        let (mut length_m, mut rate) = (0.0, 0.0);
        for i in self.channels.flexures(t) {
            let k = layout.bend(i);
            let first = k - SpatialLayout::<D>::BEND;
            if let Some(chord) = self.chord::<D>(t, i, &q[first..first + D]) {
                length_m += chord.length_m;
                for (slope, (own, v)) in self.slope[t][first..first + D]
                    .iter_mut()
                    .zip(chord.slope.iter().zip(&v[first..first + D]))
                {
                    *slope = *own;
                    rate += own * v;
                }
                continue;
            }
            let take_up = TakeUp::of(&cable, layout, self.channels.offset_m[t], i, q);
            length_m += take_up.length_m;
            self.slope[t][k] = take_up.slope[0];
            rate += take_up.slope[0] * v[k];
            if D > 1 {
                self.slope[t][k + 1] = take_up.slope[1];
                rate += take_up.slope[1] * v[k + 1];
            }
            if D == 6 {
                self.slope[t][k - 1] = -1.0;
                rate -= v[k - 1];
            }
        }
        (length_m - self.channels.rest_m[t], rate)
    }

    /// Returns the length of tendon `t` taken up by the bent tool, from its rest shape, m.
    pub fn take_up<const D: usize>(&self, layout: &SpatialLayout<D>, q: &[f64], t: usize) -> f64 {
        let p = &self.channels.cable[t];
        let (channel, flexures) = (self.channels.offset_m[t], self.channels.flexures(t));
        let each_m = |i: usize| {
            let first = layout.bend(i) - SpatialLayout::<D>::BEND;
            let chord = self.chord::<D>(t, i, &q[first..first + D]);
            chord.map_or_else(|| TakeUp::of(p, layout, channel, i, q).length_m, |chord| chord.length_m)
        };
        let bent_m: f64 = flexures.map(each_m).sum();
        bent_m - self.channels.rest_m[t]
    }
}
