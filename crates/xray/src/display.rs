//! From the detector signal to the displayed image.
//!
//! Fluoroscopes show the logarithm of the signal: equal steps of attenuation are equal steps of grey. A
//! window (lowest and highest attenuation shown) sets the contrast.
//!
//! As on a fluoroscope's intensifier ([`Display::BoneDark`]) bone is darker than soft tissue, the tool black
//! and a drilled path a lighter track; as on a radiograph ([`Display::BoneBright`]) the reverse.

use scene::Display;

use crate::error::{DrrError, check_range};

/// Range of attenuation (-ln of the fraction of photons) that the image shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Window {
    /// From the frame's own anatomy, without tool and noise: between two percentiles of the pixels behind the
    /// object, widened on the dense side so that metal can be darker than any bone.
    Automatic {
        /// Fraction of the object's pixels below the window, 0 to 0.5.
        low_share: f64,
        /// Fraction of the object's pixels above the densest anatomy considered, 0 to 0.5.
        high_share: f64,
        /// Extra range for metal, as a fraction of the anatomy's range.
        metal_room: f64,
    },
    /// Fixed limits.
    Fixed {
        /// Attenuation at one end of the scale.
        low: f64,
        /// Attenuation at the other end.
        high: f64,
    },
}

/// Display settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplayParameters {
    /// Grey-scale convention.
    pub mode: Display,
    /// Attenuation window.
    pub window: Window,
}

impl Default for DisplayParameters {
    fn default() -> Self {
        let window = Window::Automatic { low_share: 0.1, high_share: 0.005, metal_room: 0.2 };
        Self { mode: Display::BoneDark, window }
    }
}

impl DisplayParameters {
    /// Checks every field.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn validate(&self) -> Result<(), DrrError> {
        match self.window {
            Window::Automatic { low_share, high_share, metal_room } => {
                check_range("window.low_share", low_share, 0.0, 0.49, "0 to 0.49")?;
                check_range("window.high_share", high_share, 0.0, 0.49, "0 to 0.49")?;
                check_range("window.metal_room", metal_room, 0.0, 10.0, "0 to 10")
            }
            Window::Fixed { low, high } => {
                check_range("window.low", low, -1.0, 50.0, "-1 to 50")?;
                check_range("window.high", high, low + 1e-3, 50.0, "above window.low, up to 50")
            }
        }
    }
}

/// Histogram bins for the automatic window; each is [`BIN`] wide.
const BINS: usize = 2048;
const BIN: f64 = 0.005;
/// Attenuation below which a pixel sees the source directly, past the object.
const OPEN_FIELD: f64 = 0.02;
/// Minimum width of the automatic window, so that a homogeneous object does not show its noise at full
/// contrast.
const NARROWEST: f64 = 0.5;

/// Limits of a window: attenuation shown at the ends of the grey scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowLimits {
    /// The lower end.
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

/// Window limits for a frame with these anatomy line integrals.
pub fn window_limits(window: Window, anatomy: &[f64]) -> WindowLimits {
    let (low_share, high_share, metal_room) = match window {
        Window::Fixed { low, high } => return WindowLimits { low, high },
        Window::Automatic { low_share, high_share, metal_room } => (low_share, high_share, metal_room),
    };
    let mut histogram = [0_u32; BINS];
    let mut total = 0_u32;
    for &l in anatomy.iter().filter(|&&l| l > OPEN_FIELD) {
        histogram[((l / BIN) as usize).min(BINS - 1)] += 1;
        total += 1;
    }
    if total == 0 {
        return WindowLimits { low: 0.0, high: NARROWEST };
    }
    let low = quantile(&histogram, low_share * f64::from(total));
    let high = quantile(&histogram, (1.0 - high_share) * f64::from(total));
    let range = (high - low).max(NARROWEST);
    WindowLimits { low, high: low + range * (1.0 + metal_room) }
}

/// Value with `rank` counted pixels below it, interpolated linearly within a bin.
fn quantile(histogram: &[u32; BINS], rank: f64) -> f64 {
    let mut below = 0.0;
    for (bin, &count) in histogram.iter().enumerate() {
        let count = f64::from(count);
        if below + count >= rank && count > 0.0 {
            return BIN * (bin as f64 + (rank - below) / count);
        }
        below += count;
    }
    BIN * BINS as f64
}

/// The linear map from a value (attenuation, or the readout in linear mode) to a grey level, 0 to 65535.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    factor: f64,
    constant: f64,
}

impl Scale {
    /// The scale for a mode and a window.
    pub fn new(mode: Display, window: WindowLimits) -> Self {
        let WindowLimits { low, high } = window;
        let slope = 65535.0 / (high - low);
        // The 0.5 rounds to nearest.
        let (factor, constant) = match mode {
            Display::BoneDark => (-slope, high * slope + 0.5),
            Display::BoneBright => (slope, 0.5 - low * slope),
            Display::Linear => (65535.0, 0.5),
        };
        Self { factor, constant }
    }

    /// Grey level of a value.
    #[inline(always)]
    pub fn grey(&self, value: f64) -> u16 {
        // Clamping first makes the conversion check-free.
        (value * self.factor + self.constant).clamp(0.0, 65535.0) as i32 as u16
    }

    /// Grey levels of values, for the length of `out`.
    #[inline(always)]
    pub(crate) fn to_greys(self, values: &[f64], out: &mut [u16]) {
        for (o, v) in out.iter_mut().zip(values) {
            *o = self.grey(*v);
        }
    }
}
