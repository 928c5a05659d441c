//! How photons of 10 to 120 keV interact with water and cortical bone.
//!
//! Compton scattering follows Klein and Nishina (Z. Phys. 52 (1929) 853) times the incoherent scattering
//! function S(x), Rayleigh scattering follows Thomson times the squared form factor F²(x), with x =
//! sin(theta/2)/lambda of independent atoms. The scattered electron's motion (Doppler broadening), the
//! interference between molecules, and fluorescence (at most 4 keV in bone) are neglected. The tables are
//! xraylib's ([`tables`]).

use std::sync::LazyLock;

use super::tables;
use crate::attenuation::Material;
use crate::lane_math;

/// Energy of an electron at rest, keV (CODATA 2018).
const ELECTRON_KEV: f64 = 510.998_95;
/// Energy times wavelength of a photon, keV angstrom (CODATA 2018).
const KEV_ANGSTROM: f64 = 12.398_419_84;
/// The materials of a phantom.
const MATERIALS: [Material; 2] = [Material::Water, Material::CorticalBone];
/// Nodes of the resampled tables, in equal ratios of energy and of momentum transfer.
const ENERGY_NODES: usize = 257;
const MOMENTUM_NODES: usize = 1025;
/// Steps of the integrals over the scattering angle.
const ANGLES: u32 = 512;

/// Lowest energy that is followed: a slower photon leaves no patient.
pub(super) const LOWEST_KEV: f64 = 10.0;

/// Interaction coefficients of one material at one energy.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Coefficients {
    /// Photoelectric absorption and both kinds of scattering, 1/m.
    pub total_per_m: f64,
    /// Compton scattering, 1/m.
    pub incoherent_per_m: f64,
    /// Rayleigh scattering, 1/m.
    pub coherent_per_m: f64,
    /// Factors that make `compton * S` and `thomson * F²` coefficients per metre and steradian.
    incoherent_scale: f64,
    coherent_scale: f64,
}

impl Coefficients {
    fn between(a: &Self, b: &Self, t: f64) -> Self {
        let mix = |of: fn(&Self) -> f64| of(a) + t * (of(b) - of(a));
        Self {
            total_per_m: mix(|c| c.total_per_m),
            incoherent_per_m: mix(|c| c.incoherent_per_m),
            coherent_per_m: mix(|c| c.coherent_per_m),
            incoherent_scale: mix(|c| c.incoherent_scale),
            coherent_scale: mix(|c| c.coherent_scale),
        }
    }
}

/// Coefficients per metre and steradian of one scattering angle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Differential {
    /// Compton scattering.
    pub incoherent: f64,
    /// Rayleigh scattering.
    pub coherent: f64,
}

/// Fraction of its energy that a photon keeps in Compton scattering.
#[inline]
pub(super) fn kept_energy(energy_kev: f64, cosine: f64) -> f64 {
    1.0 / (1.0 + energy_kev / ELECTRON_KEV * (1.0 - cosine))
}

/// Klein and Nishina's distribution over the solid angle; 1 straight ahead, where it is largest.
#[inline]
pub(super) fn compton(energy_kev: f64, cosine: f64) -> f64 {
    let kept = kept_energy(energy_kev, cosine);
    0.5 * kept * kept * (kept + 1.0 / kept - (1.0 - cosine * cosine))
}

/// Thomson's distribution over the solid angle; 1 straight ahead.
#[inline]
fn thomson(cosine: f64) -> f64 {
    0.5 * (1.0 + cosine * cosine)
}

/// Square of sin(theta/2)/lambda, 1/angstrom².
#[inline]
fn squared_momentum(energy_kev: f64, cosine: f64) -> f64 {
    let per_angstrom = energy_kev / KEV_ANGSTROM;
    per_angstrom * per_angstrom * 0.5 * (1.0 - cosine).max(0.0)
}

/// S and F² of a material, resampled.
#[derive(Debug)]
struct Shape {
    scattering_function: Vec<f64>,
    squared_form_factor: Vec<f64>,
    /// Integral of F² over the squared momentum transfer, up to each node.
    cumulative: Vec<f64>,
    squares: Vec<f64>,
}

/// A position between two nodes of a table in equal ratios.
#[derive(Debug, Clone, Copy)]
struct Place {
    below: usize,
    fraction: f64,
}

impl Place {
    /// Finds `value` among `nodes` nodes from `low` to `high`; values outside are moved to the ends.
    #[inline]
    fn of(value: f64, (low, high): (f64, f64), nodes: usize) -> Self {
        let position = lane_math::log(value / low) / lane_math::log(high / low) * (nodes - 1) as f64;
        let position = position.clamp(0.0, (nodes - 1) as f64);
        let below = (position as usize).min(nodes - 2);
        Self { below, fraction: position - below as f64 }
    }

    #[inline]
    fn linear(self, values: &[f64]) -> f64 {
        let (a, b) = (values[self.below], values[self.below + 1]);
        a + self.fraction * (b - a)
    }
}

/// Momentum transfers of the tables.
const MOMENTA: (f64, f64) =
    (tables::MOMENTA_PER_ANGSTROM[0], tables::MOMENTA_PER_ANGSTROM[tables::MOMENTA_PER_ANGSTROM.len() - 1]);
/// Energies of the tables.
const ENERGIES: (f64, f64) = (tables::ENERGIES_KEV[0], tables::ENERGIES_KEV[tables::ENERGIES_KEV.len() - 1]);

/// The value at node `i` of `nodes` in equal ratios.
fn node((low, high): (f64, f64), i: usize, nodes: usize) -> f64 {
    low * libm::exp(libm::log(high / low) * i as f64 / (nodes - 1) as f64)
}

/// Interpolates the logarithm of a positive table in equal ratios.
fn logarithmic(values: &[f64], at: f64, range: (f64, f64)) -> f64 {
    let place = Place::of(at, range, values.len());
    let (a, b) = (values[place.below], values[place.below + 1]);
    a * libm::exp(place.fraction * libm::log(b / a))
}

impl Shape {
    fn new(scattering_function: &[f64], squared_form_factor: &[f64]) -> Self {
        let momenta: Vec<f64> = (0..MOMENTUM_NODES).map(|i| node(MOMENTA, i, MOMENTUM_NODES)).collect();
        let resampled =
            |values: &[f64]| momenta.iter().map(|x| logarithmic(values, *x, MOMENTA)).collect::<Vec<f64>>();
        let squares: Vec<f64> = momenta.iter().map(|x| x * x).collect();
        let factors = resampled(squared_form_factor);
        let mut cumulative = vec![factors[0] * squares[0]];
        for i in 1..MOMENTUM_NODES {
            let piece = 0.5 * (factors[i - 1] + factors[i]) * (squares[i] - squares[i - 1]);
            cumulative.push(cumulative[i - 1] + piece);
        }
        Self {
            scattering_function: resampled(scattering_function),
            squared_form_factor: factors,
            cumulative,
            squares,
        }
    }

    /// Place of a squared momentum transfer.
    #[inline]
    fn place(square: f64) -> Place {
        Place::of(square, (MOMENTA.0 * MOMENTA.0, MOMENTA.1 * MOMENTA.1), MOMENTUM_NODES)
    }

    /// S; below the table it is proportional to the squared momentum transfer.
    #[inline]
    fn scattering_function(&self, square: f64, place: Place) -> f64 {
        let below_table = (square / self.squares[0]).min(1.0);
        place.linear(&self.scattering_function) * below_table
    }

    /// Integral of F² up to a squared momentum transfer.
    fn integral(&self, square: f64) -> f64 {
        if square <= self.squares[0] {
            return self.squared_form_factor[0] * square;
        }
        let below = self.squares.partition_point(|s| *s < square).clamp(1, MOMENTUM_NODES - 1) - 1;
        let (a, b) = (self.squares[below], self.squares[below + 1]);
        let t = ((square - a) / (b - a)).min(1.0);
        self.cumulative[below] + t * (self.cumulative[below + 1] - self.cumulative[below])
    }

    /// The inverse of [`Shape::integral`].
    fn square_of(&self, integral: f64) -> f64 {
        if integral <= self.cumulative[0] {
            return integral / self.squared_form_factor[0];
        }
        let below = self.cumulative.partition_point(|c| *c < integral).clamp(1, MOMENTUM_NODES - 1) - 1;
        let (a, b) = (self.cumulative[below], self.cumulative[below + 1]);
        let t = ((integral - a) / (b - a)).min(1.0);
        self.squares[below] + t * (self.squares[below + 1] - self.squares[below])
    }
}

/// Interaction coefficients and angular distributions of water (0) and cortical bone (1).
#[derive(Debug)]
pub(super) struct Interactions {
    by_energy: Vec<[Coefficients; 2]>,
    shapes: [Shape; 2],
}

/// The tables, resampled on first use.
pub(super) static INTERACTIONS: LazyLock<Interactions> = LazyLock::new(Interactions::new);

impl Interactions {
    fn new() -> Self {
        let shapes = [
            Shape::new(&tables::WATER_SCATTERING_FUNCTION, &tables::WATER_SQUARED_FORM_FACTOR),
            Shape::new(
                &tables::CORTICAL_BONE_SCATTERING_FUNCTION,
                &tables::CORTICAL_BONE_SQUARED_FORM_FACTOR,
            ),
        ];
        let mass = [
            [&tables::WATER_PHOTOELECTRIC, &tables::WATER_INCOHERENT, &tables::WATER_COHERENT],
            [
                &tables::CORTICAL_BONE_PHOTOELECTRIC,
                &tables::CORTICAL_BONE_INCOHERENT,
                &tables::CORTICAL_BONE_COHERENT,
            ],
        ];
        let by_energy = (0..ENERGY_NODES).map(|i| {
            let energy_kev = node(ENERGIES, i, ENERGY_NODES);
            [0, 1].map(|material| {
                // cm2/g * g/cm3 = 1/cm = 100/m.
                let density_g_per_cm3 = MATERIALS[material].density_g_per_cm3();
                let per_m =
                    |table: &[f64]| 100.0 * density_g_per_cm3 * logarithmic(table, energy_kev, ENERGIES);
                let [photoelectric, incoherent, coherent] = mass[material].map(|table| per_m(table));
                let (compton_integral, thomson_integral) = integrals(&shapes[material], energy_kev);
                Coefficients {
                    total_per_m: photoelectric + incoherent + coherent,
                    incoherent_per_m: incoherent,
                    coherent_per_m: coherent,
                    incoherent_scale: incoherent / compton_integral,
                    coherent_scale: coherent / thomson_integral,
                }
            })
        });
        Self { by_energy: by_energy.collect(), shapes }
    }

    /// Coefficients of both materials.
    #[inline]
    pub fn at(&self, energy_kev: f64) -> [Coefficients; 2] {
        let place = Place::of(energy_kev, ENERGIES, ENERGY_NODES);
        let (below, above) = (&self.by_energy[place.below], &self.by_energy[place.below + 1]);
        [0, 1].map(|m| Coefficients::between(&below[m], &above[m], place.fraction))
    }

    /// Coefficients of a scattering angle in a mixture.
    #[inline]
    pub fn differential(
        &self,
        coefficients: &[Coefficients; 2],
        fractions: [f64; 2],
        energy_kev: f64,
        cosine: f64,
    ) -> Differential {
        let square = squared_momentum(energy_kev, cosine);
        let place = Shape::place(square.max(f64::MIN_POSITIVE));
        let (mut incoherent, mut coherent) = (0.0, 0.0);
        for ((shape, c), fraction) in self.shapes.iter().zip(coefficients).zip(fractions) {
            incoherent += fraction * c.incoherent_scale * shape.scattering_function(square, place);
            coherent += fraction * c.coherent_scale * place.linear(&shape.squared_form_factor);
        }
        Differential {
            incoherent: incoherent * compton(energy_kev, cosine),
            coherent: coherent * thomson(cosine),
        }
    }

    /// Draws the cosine of a Compton scattering angle in a material.
    pub fn compton_cosine(&self, material: usize, energy_kev: f64, mut uniform: impl FnMut() -> f64) -> f64 {
        let shape = &self.shapes[material];
        let backwards = squared_momentum(energy_kev, -1.0);
        let largest = shape.scattering_function(backwards, Shape::place(backwards));
        loop {
            let cosine = 2.0 * uniform() - 1.0;
            let square = squared_momentum(energy_kev, cosine).max(f64::MIN_POSITIVE);
            let bound = shape.scattering_function(square, Shape::place(square)) / largest;
            if uniform() < compton(energy_kev, cosine) * bound {
                return cosine;
            }
        }
    }

    /// Draws the cosine of a Rayleigh scattering angle in a material.
    pub fn rayleigh_cosine(&self, material: usize, energy_kev: f64, mut uniform: impl FnMut() -> f64) -> f64 {
        let shape = &self.shapes[material];
        let backwards = squared_momentum(energy_kev, -1.0);
        let all = shape.integral(backwards);
        loop {
            let square = shape.square_of(uniform() * all);
            let cosine = (1.0 - 2.0 * square / backwards).max(-1.0);
            if uniform() < thomson(cosine) {
                return cosine;
            }
        }
    }
}

/// Integrals of `compton * S` and of `thomson * F²` over the solid angle, by the midpoint rule in s =
/// sin(theta/2), with which the solid angle is 8 pi s ds.
fn integrals(shape: &Shape, energy_kev: f64) -> (f64, f64) {
    let (mut incoherent, mut coherent) = (0.0, 0.0);
    for i in 0..ANGLES {
        let s = (f64::from(i) + 0.5) / f64::from(ANGLES);
        let cosine = 1.0 - 2.0 * s * s;
        let solid_angle = 8.0 * core::f64::consts::PI * s / f64::from(ANGLES);
        let square = squared_momentum(energy_kev, cosine);
        let place = Shape::place(square);
        incoherent += solid_angle * compton(energy_kev, cosine) * shape.scattering_function(square, place);
        coherent += solid_angle * thomson(cosine) * place.linear(&shape.squared_form_factor);
    }
    (incoherent, coherent)
}
