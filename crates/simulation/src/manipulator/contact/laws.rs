//! Laws of a contact and of a joint stop, and their tangents at given speeds.

use crate::manipulator::row::Stop;

/// Stiffness that holds a sticking contact, relative to the contact's effective mass. With 1e4, a speed error
/// of 1 mm/s creeps at 0.1 um/s.
const STICK_STIFFNESS: f64 = 1.0e4;

/// A contact: compliant along the normal, Coulomb friction along two tangents.
#[derive(Debug, Clone, Copy)]
pub(in crate::manipulator) struct ContactRow<const N: usize> {
    pub link: usize,
    /// Unit forces on the link along normal and tangents, through the contact point.
    pub force: [[f64; N]; 3],
    /// Coulomb coefficient.
    pub friction: f64,
    /// Contact compliance, 1 / (k_c dt^2).
    pub compliance: f64,
    /// Lower bound for normal speed + compliance * impulse, m/s, while the obstacle does not yield.
    pub target: f64,
    /// Part of the target that pushes out overlap, m/s.
    pub push: f64,
    /// Normal impulse at which the obstacle yields, N s.
    pub strength: f64,
    /// Whether the obstacle recedes within the step: see [`super::patch`].
    pub recedes: bool,
    /// Speed of the contact point on the link relative to the obstacle without contact impulses, m/s;
    /// initially due to the motion of base and obstacle alone.
    pub drive: [f64; 3],
    /// Normal and tangential impulse, N s.
    pub impulse: [f64; 3],
    /// Speed under the present impulses.
    pub(super) speed: [f64; 3],
    /// Impulse by the tangent law, and speed, at the end of the step.
    pub(super) next: [f64; 3],
    pub(super) next_speed: [f64; 3],
    /// Mobility along the normal plus compliance; larger mobility of the two tangents.
    pub(super) mobility: [f64; 2],
    /// Radius of the friction cone, stick stiffness and last impulse.
    pub(super) radius: f64,
    hold: f64,
    held: [f64; 2],
    pub(super) tangent: Tangent,
}

/// A contact's law near the present speeds: impulse = offset - weight speed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tangent {
    pub normal: f64,
    /// Friction weights: entries 00 01 11.
    pub friction: [f64; 3],
    pub offset: [f64; 3],
}

impl Tangent {
    /// Returns true if the contact carries a normal impulse.
    #[inline(always)]
    pub(super) fn presses(&self) -> bool {
        self.normal > 0.0 || self.offset[0] > 0.0
    }
}

const NO_TANGENT: Tangent = Tangent { normal: 0.0, friction: [0.0; 3], offset: [0.0; 3] };

/// A joint stop of one freedom.
#[derive(Debug, Clone, Copy)]
pub(in crate::manipulator) struct StopRow {
    pub freedom: usize,
    pub stop: Stop,
    /// Free rate toward the free range, rate under the present impulses, and the mobility plus compliance.
    pub(super) free: f64,
    pub(super) rate: f64,
    pub(super) next: f64,
    pub(super) next_rate: f64,
    pub(super) mobility: f64,
    pub(super) weight: f64,
}

impl StopRow {
    pub fn new(freedom: usize, stop: Stop) -> Self {
        Self { freedom, stop, free: 0.0, rate: 0.0, next: 0.0, next_rate: 0.0, mobility: 0.0, weight: 0.0 }
    }

    #[inline(always)]
    pub(super) fn law(&self, rate: f64) -> f64 {
        ((self.stop.target - rate) / self.stop.compliance).max(0.0)
    }
}

#[inline(always)]
fn norm(a: [f64; 2]) -> f64 {
    (a[0] * a[0] + a[1] * a[1]).sqrt()
}

/// Returns the point of the disc nearest to `z`.
#[inline(always)]
pub(super) fn onto_disc(z: [f64; 2], radius: f64) -> [f64; 2] {
    let length = norm(z);
    if length <= radius { z } else { [z[0] * (radius / length), z[1] * (radius / length)] }
}

/// Returns the speed by which `impulse` violates the law of a bound: the impulse moves by the missing speed
/// to its target over the `mobility`, never pulls and never exceeds the `strength`.
#[inline(always)]
pub(super) fn bound_miss(impulse: f64, missing: f64, mobility: f64, strength: f64) -> f64 {
    let wanted = (impulse + missing / mobility).max(0.0).min(strength);
    (wanted - impulse).abs() * mobility
}

impl<const N: usize> ContactRow<N> {
    pub fn new(link: usize, force: [[f64; N]; 3]) -> Self {
        Self {
            link,
            force,
            friction: 0.0,
            compliance: 0.0,
            target: 0.0,
            push: 0.0,
            strength: f64::INFINITY,
            recedes: false,
            drive: [0.0; 3],
            impulse: [0.0; 3],
            speed: [0.0; 3],
            next: [0.0; 3],
            next_speed: [0.0; 3],
            mobility: [0.0; 2],
            radius: 0.0,
            hold: 0.0,
            held: [0.0; 2],
            tangent: NO_TANGENT,
        }
    }

    /// Returns the normal impulse at the normal speed `u`, m/s, with the obstacle receding at the speed
    /// `back`, m/s.
    #[inline(always)]
    pub(super) fn normal_law(&self, u: f64, back: f64) -> f64 {
        ((self.target - u - self.back(back)) / self.compliance).max(0.0).min(self.strength)
    }

    /// Returns the recession speed of this obstacle if receding obstacles recede at the speed `back`.
    #[inline(always)]
    fn back(&self, back: f64) -> f64 {
        if self.recedes { back } else { 0.0 }
    }

    /// Returns the impulses at speeds `u` with the cone held.
    #[inline(always)]
    pub(super) fn law(&self, u: &[f64; 3], back: f64) -> [f64; 3] {
        let normal = self.normal_law(u[0], back);
        if self.radius == 0.0 {
            return [normal, 0.0, 0.0];
        }
        let z = [self.held[0] - self.hold * u[1], self.held[1] - self.hold * u[2]];
        let [a, b] = onto_disc(z, self.radius);
        [normal, a, b]
    }

    /// Computes the law's tangent at the present speeds. If `first`, the present impulses are the last
    /// tick's, and predict the solution's side of a kink better than the speeds do. The normal's tangent is
    /// at the speed of the obstacle plus that of the sphere.
    #[inline(always)]
    pub(super) fn linearise(&mut self, first: bool, back: f64) {
        self.tangent = NO_TANGENT;
        let [p, ..] = self.impulse;
        let missing = self.target - self.speed[0] - self.back(back);
        let ahead = p + (missing - self.compliance * p) / self.mobility[0];
        let side = if first { ahead } else { missing / self.compliance };
        if side >= self.strength {
            self.tangent.offset[0] = self.strength;
        } else if side > 0.0 {
            self.tangent.normal = 1.0 / self.compliance;
            self.tangent.offset[0] = self.target / self.compliance;
        }
        if self.radius == 0.0 {
            return;
        }
        let u = [self.speed[1], self.speed[2]];
        let hold = if first { 1.0 / self.mobility[1] } else { self.hold };
        let ahead = norm([self.held[0] - hold * u[0], self.held[1] - hold * u[1]]);
        if ahead <= self.radius {
            self.tangent.friction = [self.hold, 0.0, self.hold];
            (self.tangent.offset[1], self.tangent.offset[2]) = (self.held[0], self.held[1]);
            return;
        }
        let z = [self.held[0] - self.hold * u[0], self.held[1] - self.hold * u[1]];
        let length = norm(z).max(self.radius);
        let s = [z[0] / length, z[1] / length];
        let w = self.hold * self.radius / length;
        let [a, b, c] = [w * (1.0 - s[0] * s[0]), -w * s[0] * s[1], w * (1.0 - s[1] * s[1])];
        self.tangent.friction = [a, b, c];
        self.tangent.offset[1] = self.radius * s[0] + a * u[0] + b * u[1];
        self.tangent.offset[2] = self.radius * s[1] + b * u[0] + c * u[1];
    }

    /// Returns the impulses by the tangent law.
    #[inline(always)]
    pub(super) fn tangent_law(&self, u: &[f64; 3], back: f64) -> [f64; 3] {
        let Tangent { normal, friction: [a, b, c], offset } = self.tangent;
        [
            offset[0] - normal * (u[0] + self.back(back)),
            offset[1] - a * u[1] - b * u[2],
            offset[2] - b * u[1] - c * u[2],
        ]
    }

    /// Returns the speeds by which the impulses violate the laws with the cone held, and Coulomb's law.
    /// `back` is the recession speed of obstacles under these impulses.
    #[inline(always)]
    pub(super) fn misses(&self, back: f64) -> [f64; 2] {
        let [n, p, q] = self.impulse;
        let u = &self.speed;
        let missing = self.target - u[0] - self.back(back) - self.compliance * n;
        let normal = bound_miss(n, missing, self.mobility[0], self.strength);
        if self.friction == 0.0 {
            return [normal, normal];
        }
        let of = |disc: [f64; 2]| norm([disc[0] - p, disc[1] - q]) * self.mobility[1];
        let [_, a, b] = self.law(u, back);
        let ahead = [p - u[1] / self.mobility[1], q - u[2] / self.mobility[1]];
        let coulomb = of(onto_disc(ahead, self.friction * n.max(0.0)));
        [normal.max(of([a, b])), normal.max(coulomb)]
    }

    /// Sets the stick stiffness and the cone once the mobility is known.
    #[inline(always)]
    pub(super) fn begin(&mut self) {
        self.hold = STICK_STIFFNESS / self.mobility[1];
        self.renew(1.0);
    }

    /// Updates the cone from the present impulses; its radius changes by the fraction `share` of the
    /// difference.
    #[inline(always)]
    pub(super) fn renew(&mut self, share: f64) {
        self.radius += share * (self.friction * self.impulse[0].max(0.0) - self.radius);
        self.held = onto_disc([self.impulse[1], self.impulse[2]], self.radius);
    }
}
