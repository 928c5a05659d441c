//! From what the detector sees to what a monitor shows.
//!
//! Fluoroscopes show the logarithm of the signal: equal steps of attenuation are equal steps of grey. A window (lowest and
//! highest attenuation shown) fixes the contrast.

use crate::error::{DrrError, check_range};

/// Whether bone is dark or bright.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DisplayMode {
    /// What a fluoroscope's intensifier shows: the more attenuation, the darker. Bone darker than soft tissue, the tool
    /// black, a drilled path a lighter track.
    #[default]
    BoneDark,
    /// The radiograph's negative: the more attenuation, the brighter; bone and tool bright, a drilled path a darker track.
    BoneBright,
    /// As `BoneBright` for the anatomy, with the tool laid over it in black (its noise-free transmission times the anatomy's
    /// brightness). Not physical, but common in simulators.
    BoneBrightToolBlack,
    /// No logarithm and no window: 65535 times the share of photons detected. For algorithms, not for eyes.
    Linear,
}

/// Which attenuations (-ln of the share of photons) the picture spans.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Window {
    /// From the frame's own anatomy (without tool and noise): between two percentiles of the pixels behind the object, widened on the
    /// dense side so that metal has room to be darker than any bone.
    Automatic {
        /// Share of the object's pixels below the window, 0 to 0.5.
        low_share: f64,
        /// Share of the object's pixels above the densest anatomy considered, 0 to 0.5.
        high_share: f64,
        /// Room for metal: the window's extent beyond the anatomy, as a share of the anatomy's range.
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

/// How frames are displayed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DisplayParameters {
    /// Whether bone is dark or bright.
    pub mode: DisplayMode,
    /// What they span.
    pub window: Window,
}

impl Default for DisplayParameters {
    fn default() -> Self {
        let window = Window::Automatic { low_share: 0.1, high_share: 0.005, metal_room: 0.2 };
        Self { mode: DisplayMode::BoneDark, window }
    }
}

impl DisplayParameters {
    /// Checks every field.
    ///
    /// # Errors
    /// The first field that is out of range, by name.
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

/// Bins of the histogram behind the automatic window; each is [`BIN`] wide.
const BINS: usize = 2048;
const BIN: f64 = 0.005;
/// A pixel with less attenuation than this sees the source directly, beside the object.
const OPEN_FIELD: f64 = 0.02;
/// Narrowest automatic window: a homogeneous object does not show its noise at full contrast.
const NARROWEST: f64 = 0.5;

/// The window's limits for a frame whose anatomy has these line integrals.
pub fn window_limits(window: Window, anatomy: &[f64]) -> (f64, f64) {
    let (low_share, high_share, metal_room) = match window {
        Window::Fixed { low, high } => return (low, high),
        Window::Automatic { low_share, high_share, metal_room } => (low_share, high_share, metal_room),
    };
    let mut histogram = [0_u32; BINS];
    let mut total = 0_u32;
    for &l in anatomy.iter().filter(|&&l| l > OPEN_FIELD) {
        histogram[((l / BIN) as usize).min(BINS - 1)] += 1;
        total += 1;
    }
    if total == 0 {
        return (0.0, NARROWEST);
    }
    let low = quantile(&histogram, low_share * f64::from(total));
    let high = quantile(&histogram, (1.0 - high_share) * f64::from(total));
    let range = (high - low).max(NARROWEST);
    (low, low + range * (1.0 + metal_room))
}

/// Value below which `rank` of the counted pixels lie, linear inside a bin.
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

/// The linear map from a value (attenuation; in linear mode the readout) to a grey, 0 to 65535.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    mode: DisplayMode,
    low: f64,
    factor: f64,
    constant: f64,
}

impl Scale {
    /// The scale of a mode and a window.
    pub fn new(mode: DisplayMode, (low, high): (f64, f64)) -> Self {
        let slope = 65535.0 / (high - low);
        // 0.5 rounds.
        let (factor, constant) = match mode {
            DisplayMode::BoneDark => (-slope, high * slope + 0.5),
            DisplayMode::BoneBright | DisplayMode::BoneBrightToolBlack => (slope, 0.5 - low * slope),
            DisplayMode::Linear => (65535.0, 0.5),
        };
        Self { mode, low, factor, constant }
    }

    /// The mode.
    pub fn mode(&self) -> DisplayMode {
        self.mode
    }

    /// The grey of a value.
    #[inline(always)]
    pub fn grey(&self, value: f64) -> u16 {
        // Clamped before the conversion, which then needs no checks of its own.
        (value * self.factor + self.constant).clamp(0.0, 65535.0) as i32 as u16
    }

    /// The greys of some values, as many as `out` takes.
    #[inline(always)]
    pub(crate) fn to_greys(self, values: &[f64], out: &mut [u16]) {
        for (o, v) in out.iter_mut().zip(values) {
            *o = self.grey(*v);
        }
    }

    /// `BoneBrightToolBlack`: the anatomy's grey times the share that the metal alone lets through.
    pub fn under_metal(&self, attenuation: f64, metal_transmission: f64) -> u16 {
        let metal = metal_transmission.clamp(5e-7, 1.0);
        let anatomy = attenuation + libm::log(metal);
        let grey = ((anatomy - self.low) * self.factor).clamp(0.0, 65535.0) * metal;
        (grey + 0.5) as u16
    }
}

/// The upper byte of every pixel, for 8-bit picture files.
pub fn to_8_bit(image: &[u16]) -> Vec<u8> {
    image.iter().map(|&v| (v >> 8) as u8).collect()
}
