//! Line integrals to the share of photons that the detector sees: Beer-Lambert, seeded quantum noise, blur.

use crate::error::{DrrError, check_range};

/// Below this mean, photon numbers are drawn from the exact Poisson distribution; above it, from a normal one.
pub const EXACT_POISSON_BELOW: f64 = 30.0;

/// The detector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectorParameters {
    /// Photons detected by a pixel that sees the source through nothing. A fluoroscopy pulse is of the order of 1e2 to 1e3 behind a
    /// patient, a radiograph far above.
    pub photons_per_pixel: f64,
    /// Whether photon numbers fluctuate.
    pub quantum_noise: bool,
    /// Standard deviation of the spread of light in the scintillator, in pixels; 0 for none. It blurs the noise too, as in a real
    /// detector.
    pub blur_sigma_px: f64,
}

impl Default for DetectorParameters {
    fn default() -> Self {
        Self { photons_per_pixel: 4000.0, quantum_noise: true, blur_sigma_px: 0.6 }
    }
}

impl DetectorParameters {
    /// Checks every field.
    ///
    /// # Errors
    /// The first field that is out of range, by name.
    pub fn validate(&self) -> Result<(), DrrError> {
        check_range("photons_per_pixel", self.photons_per_pixel, 1.0, 1e9, "1 to 1e9 photons")?;
        check_range("blur_sigma_px", self.blur_sigma_px, 0.0, 20.0, "0 to 20 pixels")
    }

    /// Share of the unattenuated photons that a pixel detects, for a line integral and a pixel number.
    pub fn expose(&self, line_integral: f64, seed: FrameSeed, pixel: u64) -> f64 {
        let transmitted = libm::exp(-line_integral);
        if !self.quantum_noise {
            return transmitted;
        }
        let mean = transmitted * self.photons_per_pixel;
        photon_number(mean, seed.hash(pixel)) / self.photons_per_pixel
    }
}

/// What the noise of a frame depends on: the run's seed and the frame's number (its tick).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameSeed {
    /// The run's seed.
    pub seed: u64,
    /// The frame's number.
    pub frame: u64,
}

impl FrameSeed {
    /// A counter-based random number of a pixel: no state, so any order and any number of threads give the same frame.
    pub fn hash(self, pixel: u64) -> u64 {
        mix(mix(mix(self.seed) ^ self.frame) ^ pixel)
    }
}

/// The finaliser of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014; constants of D. Stafford's variant 13), with its increment.
fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ x >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ x >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ x >> 31
}

/// A number in 0..1, both ends excluded.
fn uniform(bits: u64) -> f64 {
    ((bits >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
}

/// A Poisson number of the given mean: exact by inversion below [`EXACT_POISSON_BELOW`], above it the nearest whole number to a
/// normal deviate of the same mean and variance (Box and Muller 1958).
pub fn photon_number(mean: f64, random: u64) -> f64 {
    if mean < EXACT_POISSON_BELOW {
        return poisson_by_inversion(mean, uniform(random));
    }
    let radius = (-2.0 * libm::log(uniform(random))).sqrt();
    let normal = radius * libm::cos(core::f64::consts::TAU * uniform(mix(random)));
    libm::round(mean + mean.sqrt() * normal).max(0.0)
}

/// Smallest n whose cumulative probability exceeds `u`.
fn poisson_by_inversion(mean: f64, u: f64) -> f64 {
    let mut probability = libm::exp(-mean);
    let mut cumulative = probability;
    let mut n = 0.0;
    // With a mean below 30 the tail beyond 200 is far below the resolution of u.
    while u > cumulative && n < 200.0 {
        n += 1.0;
        probability *= mean / n;
        cumulative += probability;
    }
    n
}

/// Weights of a normalised Gaussian, cut at 3 sigma: `[w_-r, ..., w_0, ..., w_r]`. One weight of 1 for sigma 0.
pub fn gaussian_weights(sigma_px: f64) -> Vec<f64> {
    let reach = libm::ceil(3.0 * sigma_px) as i32;
    let bell = |i: i32| libm::exp(-0.5 * f64::from(i * i) / (sigma_px * sigma_px).max(f64::MIN_POSITIVE));
    let mut weights: Vec<f64> = (-reach..=reach).map(|i| if i == 0 { 1.0 } else { bell(i) }).collect();
    let total: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= total);
    weights
}

/// One output row of a blur along rows: `out[c] = sum_i w_i row[c + i - r]`, the edge pixels repeated outside.
pub fn blur_row(row: &[f64], weights: &[f64], out: &mut [f64]) {
    let reach = weights.len() / 2;
    let last = row.len().saturating_sub(1);
    for (c, o) in out.iter_mut().enumerate() {
        *o = weights.iter().enumerate().map(|(i, w)| w * row[(c + i).saturating_sub(reach).min(last)]).sum();
    }
}

/// One output row (number `r`) of a blur along columns of an image of `columns` pixels a row.
pub fn blur_column_into_row(image: &[f64], columns: usize, r: usize, weights: &[f64], out: &mut [f64]) {
    let reach = weights.len() / 2;
    let last = (image.len() / columns).saturating_sub(1);
    out.fill(0.0);
    for (i, w) in weights.iter().enumerate() {
        let source = (r + i).saturating_sub(reach).min(last);
        for (o, x) in out.iter_mut().zip(&image[source * columns..]) {
            *o += w * x;
        }
    }
}
