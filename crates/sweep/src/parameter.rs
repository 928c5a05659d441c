//! A parameter: a scene key and its values.

use std::path::Path;

use serde::{Deserialize, Serialize};
use toml::Value;

use crate::error::StudyError;

/// Maximum number of listed values of a parameter.
pub const MAX_VALUES: usize = 10_000;

/// Returns whether a value is a non-finite number.
pub(crate) fn is_not_finite(value: &Value) -> bool {
    matches!(value, Value::Float(number) if !number.is_finite())
}

/// How a range is divided.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// Equal steps.
    #[default]
    Linear,
    /// Equal ratios; both ends must be above zero.
    Log,
}

/// A scene key that a sweep varies, between `min` and `max` or over `values`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Scene key with its path, as for `trabecula run --set`.
    pub key: String,
    /// Lowest value, in the key's unit.
    pub min: Option<f64>,
    /// Highest value, in the key's unit.
    pub max: Option<f64>,
    /// How the range is divided.
    #[serde(default)]
    pub scale: Scale,
    /// Whether only whole numbers are used, `min` and `max` included.
    #[serde(default)]
    pub integer: bool,
    /// Number of values of a range in a grid, both ends included.
    pub steps: Option<u64>,
    /// Values to choose from, instead of a range.
    pub values: Option<Vec<Value>>,
}

impl Parameter {
    /// # Errors
    /// No values, an invalid range, or a malformed key.
    pub(crate) fn check(&self, number: usize, file: &Path, is_grid: bool) -> Result<(), StudyError> {
        let key = |name: &str| format!("parameter.{number}.{name}");
        let bad = |name: &str, given: String, expected: &str| {
            Err(StudyError::Value {
                file: file.to_owned(),
                key: key(name),
                given,
                expected: expected.to_owned(),
            })
        };
        let contradiction = |name: &str, problem: &str| {
            Err(StudyError::Contradiction {
                file: file.to_owned(),
                key: key(name),
                problem: problem.to_owned(),
            })
        };
        let part = |part: &str| {
            !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-'))
        };
        if self.key.len() > 200 || !self.key.split('.').all(part) {
            return bad("key", format!("`{}`", self.key), "a key of the scene such as `drilling.friction`");
        }
        if let Some(values) = &self.values {
            if self.min.is_some() || self.max.is_some() || self.steps.is_some() || self.integer {
                return contradiction(
                    "values",
                    "cannot be combined with `min`, `max`, `steps` or `integer`; set either a range or \
                     values",
                );
            }
            if values.is_empty() || values.len() > MAX_VALUES {
                return bad("values", format!("{} values", values.len()), "1 to 10000 values");
            }
            if values.iter().any(is_not_finite) {
                return bad("values", "a non-finite number".to_owned(), "finite numbers");
            }
            return Ok(());
        }
        let (Some(min), Some(max)) = (self.min, self.max) else {
            return contradiction("min", "is missing, expected `min` and `max`, or `values`");
        };
        if !min.is_finite() {
            return bad("min", format!("{min:?}"), "a finite number");
        }
        if !(max - min).is_finite() {
            return bad(
                "max",
                format!("{max:?}"),
                &format!("a finite number, and finitely far from `min`, which is {min:?}"),
            );
        }
        if min >= max {
            return bad("max", format!("{max:?}"), &format!("a finite number above `min`, which is {min:?}"));
        }
        if self.scale == Scale::Log && min <= 0.0 {
            return bad("min", format!("{min:?}"), "a number above 0, because `scale` is \"log\"");
        }
        // Not all larger whole numbers are representable in 64 bits.
        let is_whole = |x: f64| x.fract() == 0.0 && x.abs() <= 9e15;
        if self.integer && !(is_whole(min) && is_whole(max)) {
            return bad("min", format!("{min:?}"), "whole numbers up to 9e15, because `integer` is true");
        }
        match (is_grid, self.steps) {
            (true, None) => contradiction("steps", "is missing; a grid needs it for a range"),
            (false, Some(_)) => contradiction("steps", "is only for `design = \"grid\"`"),
            (true, Some(steps)) if !(2..=MAX_VALUES as u64).contains(&steps) => {
                bad("steps", steps.to_string(), "2 to 10000")
            }
            _ => Ok(()),
        }
    }

    /// Returns the number of values in a grid.
    pub(crate) fn grid_count(&self) -> u64 {
        self.values.as_ref().map_or(self.steps.unwrap_or(1), |values| values.len() as u64)
    }

    /// Returns the value at a fraction of the range, 0 to 1; listed values have equal shares.
    pub(crate) fn at(&self, unit: f64) -> Value {
        if let Some(values) = &self.values {
            let index = (unit * values.len() as f64) as usize;
            return values[index.min(values.len() - 1)].clone();
        }
        let (min, max) = (self.min.unwrap_or(0.0), self.max.unwrap_or(1.0));
        if self.integer {
            // All whole numbers have equal shares.
            let number = (self.stretched(min - 0.5, max + 0.5, unit)).round().clamp(min, max);
            return Value::Integer(number as i64);
        }
        Value::Float(self.stretched(min, max, unit).clamp(min, max))
    }

    /// Returns value `index` of its grid.
    pub(crate) fn of_grid(&self, index: u64) -> Value {
        match (&self.values, self.steps) {
            (Some(values), _) => values[(index as usize).min(values.len() - 1)].clone(),
            (None, Some(steps)) if self.integer => {
                let (min, max) = (self.min.unwrap_or(0.0), self.max.unwrap_or(1.0));
                let number = self.stretched(min, max, index as f64 / (steps.max(2) - 1) as f64);
                Value::Integer(number.round().clamp(min, max) as i64)
            }
            (None, steps) => self.at(index as f64 / (steps.unwrap_or(2).max(2) - 1) as f64),
        }
    }

    fn stretched(&self, min: f64, max: f64, unit: f64) -> f64 {
        match self.scale {
            Scale::Linear => min + unit * (max - min),
            Scale::Log if min <= 0.0 => unit * max,
            Scale::Log => min * libm::pow(max / min, unit),
        }
    }
}
