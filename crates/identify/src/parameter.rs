//! A parameter to estimate.
//!
//! The solver works in the unit cube: coordinate 0 is `min`, 1 is `max`; a logarithmic scale divides the
//! range into equal ratios.

use serde::{Deserialize, Serialize};
use sweep::Scale;

/// Knowledge about a parameter before the measurement: a normal distribution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Mean, in the parameter's unit.
    pub mean: f64,
    /// Standard deviation, above 0.
    pub sd: f64,
}

/// A parameter with its range.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Key of the scene, or of a signal: `measured.NAME.gain` and others.
    pub key: String,
    /// Lowest value, in the key's unit.
    pub min: f64,
    /// Highest value.
    pub max: f64,
    /// How the range is divided.
    #[serde(default)]
    pub scale: Scale,
    /// First value that is tried; by default that of the scene or signal, or the middle of the range.
    pub start: Option<f64>,
    /// Step of the finite differences, as a share of the range; 0.00001 by default. Larger steps average over
    /// the voxels of drilled bone.
    pub step: Option<f64>,
    /// Prior knowledge.
    pub prior: Option<Prior>,
}

/// Default [`Parameter::step`]: far above rounding, 1e-11 of the range, and below the curvature within an
/// interval.
pub const STANDARD_STEP: f64 = 1e-5;

impl Parameter {
    /// Returns the value at a coordinate from 0 to 1.
    pub fn value(&self, unit: f64) -> f64 {
        let value = match self.scale {
            Scale::Linear => self.min + unit * (self.max - self.min),
            Scale::Log => self.min * libm::pow(self.max / self.min, unit),
        };
        value.clamp(self.min, self.max)
    }

    /// Returns the coordinate of a value; outside the range it is below 0 or above 1.
    pub fn unit(&self, value: f64) -> f64 {
        match self.scale {
            Scale::Linear => (value - self.min) / (self.max - self.min),
            Scale::Log => libm::log(value / self.min) / libm::log(self.max / self.min),
        }
    }

    /// Returns the derivative of the value by the coordinate.
    pub fn slope(&self, unit: f64) -> f64 {
        match self.scale {
            Scale::Linear => self.max - self.min,
            Scale::Log => self.value(unit) * libm::log(self.max / self.min),
        }
    }

    /// Returns the step of finite differences in the unit cube.
    pub fn difference(&self) -> f64 {
        self.step.unwrap_or(STANDARD_STEP)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Rounding of pow and log: within a few units of the last place, hence 1e-12.
        #[test]
        fn a_coordinate_returns_to_its_value(unit in 0.0..1.0_f64, is_log: bool) {
            let scale = if is_log { Scale::Log } else { Scale::Linear };
            let parameter =
                Parameter { key: "a".to_owned(), min: 0.2, max: 5.0, scale, start: None, step: None, prior: None };
            prop_assert!((parameter.unit(parameter.value(unit)) - unit).abs() < 1e-12);
            let h = 1e-6;
            let difference = (parameter.value(unit + h) - parameter.value(unit - h)) / (2.0 * h);
            // The difference has an error of h² and of rounding, 1e-16 / h.
            prop_assert!(unit < h || unit > 1.0 - h || (difference - parameter.slope(unit)).abs() < 1e-7);
        }
    }
}
