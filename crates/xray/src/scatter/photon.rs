//! The path of one photon: Woodcock's flights (E. R. Woodcock et al., "Techniques used in the GEM code for
//! Monte Carlo neutronics calculations", ANL-7050 (1965) 557) between collisions, and the collisions.

use counter_random::Key;

use super::interactions::{Coefficients, INTERACTIONS, Interactions, LOWEST_KEV, kept_energy};
use super::phantom::Phantom;
use crate::lane_math;
use crate::ray::IndexRay;
use crate::siddon::clip_to_volume;
use crate::vector::{Vec3, add_scaled, cross, norm, scale};

/// Below this share of its weight at the first collision, a photon survives with probability 1/2, and then
/// has twice the weight.
const LOW_WEIGHT: f64 = 0.2;

/// The random numbers of one photon.
#[derive(Debug, Clone, Copy)]
pub(super) struct Numbers {
    key: Key,
    next: u64,
}

impl Numbers {
    pub fn of(key: Key) -> Self {
        Self { key, next: 0 }
    }

    /// The next uniform number.
    #[inline]
    pub fn uniform(&mut self) -> f64 {
        self.next += 1;
        self.key.uniform(self.next - 1)
    }
}

/// A photon in flight.
#[derive(Debug, Clone, Copy)]
pub(super) struct Photon {
    pub position_m: Vec3,
    /// Unit vector.
    pub direction: Vec3,
    pub energy_kev: f64,
    /// 1 at the source; absorption and the choice of the first collision change it.
    pub weight: f64,
}

/// What a photon meets at a collision.
#[derive(Debug, Clone, Copy)]
pub(super) struct Site {
    /// Densities of water and bone.
    pub fractions: [f64; 2],
    pub coefficients: [Coefficients; 2],
    /// Attenuation there.
    pub total_per_m: f64,
}

/// The straight way of a photon through a phantom.
struct Way {
    /// Its start, and its direction per metre, in index coordinates.
    origin: Vec3,
    direction: Vec3,
    /// Where it enters and leaves the phantom, m.
    enter: f64,
    leave: f64,
    coefficients: [Coefficients; 2],
}

impl Way {
    /// Attenuation by densities, 1/m, or by metres of both materials.
    fn attenuation(&self, of: [f64; 2]) -> f64 {
        of[0] * self.coefficients[0].total_per_m + of[1] * self.coefficients[1].total_per_m
    }

    /// What is there after these metres.
    fn site(&self, phantom: &Phantom, flown: f64) -> Site {
        let fractions = phantom.at(add_scaled(self.origin, flown, self.direction));
        let (coefficients, total_per_m) = (self.coefficients, self.attenuation(fractions));
        Site { fractions, coefficients, total_per_m }
    }
}

/// Follows photons through a phantom.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tracker<'a> {
    pub phantom: &'a Phantom,
    pub interactions: &'static Interactions,
    /// Scatterings after which a photon is dropped.
    pub orders: u32,
}

impl<'a> Tracker<'a> {
    pub fn new(phantom: &'a Phantom, orders: u32) -> Self {
        Self { phantom, interactions: &INTERACTIONS, orders }
    }

    /// Follows a photon, and calls `visit` at each collision, before the photon's weight and direction
    /// change.
    pub fn follow(
        &self,
        mut photon: Photon,
        numbers: &mut Numbers,
        mut visit: impl FnMut(&Photon, &Site, &mut Numbers),
    ) {
        let Some(mut site) = self.first(&mut photon, numbers) else { return };
        let low_weight = LOW_WEIGHT * photon.weight;
        for order in 1..=self.orders {
            visit(&photon, &site, numbers);
            if order == self.orders {
                return;
            }
            self.scatter(&mut photon, &site, numbers);
            if photon.energy_kev < LOWEST_KEV {
                return;
            }
            if photon.weight < low_weight {
                if numbers.uniform() < 0.5 {
                    return;
                }
                photon.weight *= 2.0;
            }
            match self.fly(&mut photon, numbers) {
                Some(next) => site = next,
                None => return,
            }
        }
    }

    /// Moves a photon to its first collision, drawn evenly along its way through the phantom, with the weight
    /// of a collision there: deep collisions are rare, but most of what leaves the patient comes from them.
    fn first(&self, photon: &mut Photon, numbers: &mut Numbers) -> Option<Site> {
        let way = self.way(photon)?;
        let flown = way.enter + numbers.uniform() * (way.leave - way.enter);
        let site = way.site(self.phantom, flown);
        if site.total_per_m <= 0.0 {
            return None;
        }
        let position_m = add_scaled(photon.position_m, flown, photon.direction);
        let depth = way.attenuation(self.phantom.lengths_m(photon.position_m, position_m));
        photon.weight *= site.total_per_m * (way.leave - way.enter) * lane_math::exp(-depth);
        photon.position_m = position_m;
        Some(site)
    }

    /// Moves a photon to its next collision; `None` if it leaves the phantom.
    fn fly(&self, photon: &mut Photon, numbers: &mut Numbers) -> Option<Site> {
        let way = self.way(photon)?;
        let largest = way.attenuation(self.phantom.largest());
        if largest <= 0.0 {
            return None;
        }
        let mut flown = way.enter;
        loop {
            flown -= lane_math::log(numbers.uniform()) / largest;
            if flown >= way.leave {
                return None;
            }
            let site = way.site(self.phantom, flown);
            if numbers.uniform() * largest < site.total_per_m {
                photon.position_m = add_scaled(photon.position_m, flown, photon.direction);
                return Some(site);
            }
        }
    }

    /// Returns the way ahead of a photon; `None` if it misses the phantom.
    fn way(&self, photon: &Photon) -> Option<Way> {
        let grid = self.phantom.grid();
        let (origin, direction) =
            (grid.world_to_index(photon.position_m), grid.vector_to_index(photon.direction));
        let ray = IndexRay { origin, direction, length_m: 1.0 };
        let (enter, leave) = clip_to_volume(&ray, grid.dims(), (0.0, f64::MAX))?;
        Some(Way { origin, direction, enter, leave, coefficients: self.interactions.at(photon.energy_kev) })
    }

    /// Scatters a photon; absorption lowers its weight.
    fn scatter(&self, photon: &mut Photon, site: &Site, numbers: &mut Numbers) {
        let of = |m: usize, per_m: fn(&Coefficients) -> f64| site.fractions[m] * per_m(&site.coefficients[m]);
        let parts = [
            of(0, |c| c.incoherent_per_m),
            of(1, |c| c.incoherent_per_m),
            of(0, |c| c.coherent_per_m),
            of(1, |c| c.coherent_per_m),
        ];
        let all = parts[0] + parts[1] + parts[2] + parts[3];
        photon.weight *= all / site.total_per_m;
        let drawn = numbers.uniform() * all;
        let energy = photon.energy_kev;
        let (mut kind, mut below) = (0, parts[0]);
        while kind < 3 && drawn >= below {
            kind += 1;
            below += parts[kind];
        }
        let material = kind % 2;
        let cosine = if kind < 2 {
            let cosine = self.interactions.compton_cosine(material, energy, || numbers.uniform());
            photon.energy_kev *= kept_energy(energy, cosine);
            cosine
        } else {
            self.interactions.rayleigh_cosine(material, energy, || numbers.uniform())
        };
        photon.direction = turned(photon.direction, cosine, numbers.uniform());
    }
}

/// A unit vector at this angle to `direction`; `turn` in 0..1 is the angle about it.
fn turned(direction: Vec3, cosine: f64, turn: f64) -> Vec3 {
    let axis = if direction[0].abs() < 0.5 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let across = cross(direction, axis);
    let across = scale(across, 1.0 / norm(across));
    let along = cross(direction, across);
    let (sine, (s, c)) =
        ((1.0 - cosine * cosine).max(0.0).sqrt(), libm::sincos(core::f64::consts::TAU * turn));
    let out = add_scaled(add_scaled(scale(direction, cosine), sine * c, across), sine * s, along);
    scale(out, 1.0 / norm(out))
}
