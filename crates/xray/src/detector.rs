//! From line integrals to the fraction of photons detected: Beer-Lambert, seeded quantum noise, blur.

use std::sync::LazyLock;

use counter_random::{Key, mix, uniform};

use crate::error::{DrrError, check_range};
use crate::lane_math;

/// Photon counts with a mean below this are drawn from the exact Poisson distribution, others from a normal
/// one.
pub const EXACT_POISSON_BELOW: f64 = 30.0;

/// The detector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectorParameters {
    /// Photons that a pixel detects with nothing between it and the source. About 1e2 to 1e3 behind a patient
    /// for a fluoroscopy pulse, far more for a radiograph.
    pub photons_per_pixel: f64,
    /// Adds photon noise.
    pub quantum_noise: bool,
    /// Standard deviation of the light spread in the scintillator, in pixels; 0 for none. It blurs the noise
    /// too, as in a real detector.
    pub blur_sigma_px: f64,
    /// The readout is `min(gain * signal + offset, saturation)`, with a signal of 1 in the open field: 0.01
    /// to 100.
    pub gain: f64,
    /// Dark signal as a fraction of the open-field signal: 0 to 0.5.
    pub offset: f64,
    /// Maximum readout, 0.01 to 100; `None` for no limit.
    pub saturation: Option<f64>,
}

impl Default for DetectorParameters {
    fn default() -> Self {
        Self {
            photons_per_pixel: 4000.0,
            quantum_noise: true,
            blur_sigma_px: 0.6,
            gain: 1.0,
            offset: 0.0,
            saturation: None,
        }
    }
}

impl DetectorParameters {
    /// Checks every field.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn validate(&self) -> Result<(), DrrError> {
        check_range("photons_per_pixel", self.photons_per_pixel, 1.0, 1e9, "1 to 1e9 photons")?;
        check_range("blur_sigma_px", self.blur_sigma_px, 0.0, 20.0, "0 to 20 pixels")?;
        check_range("gain", self.gain, 0.01, 100.0, "0.01 to 100")?;
        check_range("offset", self.offset, 0.0, 0.5, "0 to 0.5 of the open field's signal")?;
        self.saturation.map_or(Ok(()), |s| check_range("saturation", s, 0.01, 100.0, "0.01 to 100"))
    }

    /// The readout parameters.
    pub(crate) fn readout(&self) -> Readout {
        Readout { gain: self.gain, offset: self.offset, saturation: self.saturation.unwrap_or(f64::INFINITY) }
    }
}

/// Gain, offset and saturation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Readout {
    gain: f64,
    offset: f64,
    saturation: f64,
}

impl Readout {
    /// True if the readout leaves the signal unchanged.
    pub(crate) fn is_plain(self) -> bool {
        self == Self { gain: 1.0, offset: 0.0, saturation: f64::INFINITY }
    }

    #[inline(always)]
    pub(crate) fn apply(self, signal: f64) -> f64 {
        (self.gain * signal + self.offset).min(self.saturation)
    }
}

/// Seed of a frame's noise: the run's seed and the frame number (its tick).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameSeed {
    /// The run's seed.
    pub seed: u64,
    /// The frame number.
    pub frame: u64,
}

impl FrameSeed {
    /// A counter-based random number for a pixel: stateless, so any pixel order and any number of threads
    /// give the same frame.
    pub fn hash(self, pixel: u64) -> u64 {
        self.key().word(pixel)
    }

    /// The part of the hash that all pixels share.
    pub(crate) fn key(self) -> Key {
        Key::of(self.seed).and(self.frame)
    }
}

/// A Poisson-distributed number: exact for means below `EXACT_POISSON_BELOW`, otherwise a normal deviate of
/// the same mean and variance, rounded.
pub fn photon_number(mean: f64, random: u64) -> f64 {
    if mean < EXACT_POISSON_BELOW {
        return small_poisson(mean.max(0.0), random);
    }
    lane_math::round(mean + mean.sqrt() * lane_math::normal(random)).max(0.0)
}

/// Exact: the sum of two Poisson numbers, one for the integer part of the mean (from a table) and one for its
/// fraction (by inversion).
fn small_poisson(mean: f64, random: u64) -> f64 {
    static TABLES: LazyLock<Vec<PoissonTable>> =
        LazyLock::new(|| (0..EXACT_POISSON_BELOW as usize).map(|m| PoissonTable::new(m as f64)).collect());
    let whole = mean as usize;
    let first = TABLES.get(whole).map_or(0.0, |table| table.number(uniform(random)));
    first + poisson_by_inversion(mean - whole as f64, uniform(mix(random)))
}

/// Cumulative probabilities for one mean, and where to start the search for each 1/256 of the uniform range.
struct PoissonTable {
    cumulative: Vec<f64>,
    begin: [u8; 256],
}

impl PoissonTable {
    fn new(mean: f64) -> Self {
        let mut probability = libm::exp(-mean);
        let mut cumulative = vec![probability];
        // For a mean below 30 the tail beyond 120 is far below the resolution of the uniform number.
        for n in 1..120 {
            probability *= mean / f64::from(n);
            cumulative.push(cumulative[cumulative.len() - 1] + probability);
        }
        let first_above = |i: usize| cumulative.partition_point(|&c| c < i as f64 / 256.0);
        let begin = core::array::from_fn(|i| first_above(i).min(119) as u8);
        Self { cumulative, begin }
    }

    /// Smallest n whose cumulative probability is at least `u`.
    fn number(&self, u: f64) -> f64 {
        let begin = usize::from(self.begin[(u * 256.0) as usize & 255]);
        let beyond = self.cumulative[begin..].iter().take_while(|&&c| c < u).count();
        (begin + beyond) as f64
    }
}

/// Smallest n whose cumulative probability is at least `u`, for a mean below 1.
fn poisson_by_inversion(mean: f64, u: f64) -> f64 {
    let mut probability = lane_math::exp(-mean);
    let mut cumulative = probability;
    let mut n = 0.0;
    // The tail beyond 20 is far below the resolution of u.
    while u > cumulative && n < 20.0 {
        n += 1.0;
        probability *= mean / n;
        cumulative += probability;
    }
    n
}

/// Normalised Gaussian weights, truncated at 3 sigma: `[w_-r, ..., w_0, ..., w_r]`; a single 1 for sigma 0.
pub fn gaussian_weights(sigma_px: f64) -> Vec<f64> {
    let reach = libm::ceil(3.0 * sigma_px) as i32;
    let bell = |i: i32| libm::exp(-0.5 * f64::from(i * i) / (sigma_px * sigma_px).max(f64::MIN_POSITIVE));
    let mut weights: Vec<f64> = (-reach..=reach).map(|i| if i == 0 { 1.0 } else { bell(i) }).collect();
    let total: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= total);
    weights
}

/// One output row of a blur along rows: `out[c] = sum_i w_i row[c + i - r]`, with edge pixels repeated
/// outside.
#[inline(always)]
pub fn blur_row(row: &[f32], weights: &[f32], out: &mut [f32]) {
    let (reach, width) = (weights.len() / 2, row.len());
    let edge = reach.min(width);
    let clamped = |c: usize| {
        let at = |i: usize| row[(c + i).saturating_sub(reach).min(width - 1)];
        weights.iter().enumerate().fold(0.0, |sum, (i, w)| sum + w * at(i))
    };
    if width <= 2 * reach {
        out.iter_mut().enumerate().for_each(|(c, o)| *o = clamped(c));
        return;
    }
    for c in (0..edge).chain(width - edge..width) {
        out[c] = clamped(c);
    }
    let inner = &mut out[edge..width - edge];
    inner.fill(0.0);
    for (i, w) in weights.iter().enumerate() {
        add_scaled_row(inner, *w, &row[i..]);
    }
}

/// `out += weight * row`, for the length of `out`.
#[inline(always)]
pub fn add_scaled_row(out: &mut [f32], weight: f32, row: &[f32]) {
    for (o, x) in out.iter_mut().zip(row) {
        *o += weight * x;
    }
}
