//! What a parameter sets.

use crate::signal::Signal;

/// What a parameter sets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// A key of every experiment's scene.
    Scene(String),
    /// The time of the measured file's clock at tick 0.
    ClockOffset {
        /// Index of the experiment.
        experiment: usize,
    },
    /// A parameter of a sensor.
    Measured {
        /// Name of the sensor.
        name: String,
        /// Which.
        part: SignalPart,
    },
    /// A parameter of a command's column.
    Command {
        /// Name of the column.
        name: String,
        /// Which.
        part: CommandPart,
    },
}

/// A parameter of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalPart {
    /// `delay_ms`.
    Delay,
    /// `gain`.
    Gain,
    /// `bias` of all columns, or of one.
    Bias(Option<usize>),
    /// A component of `frame_mm`.
    Position(usize),
    /// A component of `frame_deg`.
    Rotation(usize),
}

/// A parameter of a command's column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandPart {
    /// `gain`.
    Gain,
    /// `bias`.
    Bias,
    /// `delay_ms`.
    Delay,
}

/// What keys of signals look like, for errors.
pub(super) const EXPECTED: &str = "`measured.NAME.` with `delay_ms`, `gain`, `bias`, `bias.0`, `frame_mm.0` or \
                                   `frame_deg.0`; `command.NAME.` with `gain`, `bias` or `delay_ms`; \
                                   `experiment.NAME.clock_offset_s`; or a key of the scene";

impl SignalPart {
    fn parse(text: &str) -> Option<SignalPart> {
        let (name, index) = match text.split_once('.') {
            Some((name, index)) => (name, Some(index.parse::<usize>().ok()?)),
            None => (text, None),
        };
        match (name, index) {
            ("delay_ms", None) => Some(SignalPart::Delay),
            ("gain", None) => Some(SignalPart::Gain),
            ("bias", index) => Some(SignalPart::Bias(index)),
            ("frame_mm", Some(index @ 0..3)) => Some(SignalPart::Position(index)),
            ("frame_deg", Some(index @ 0..3)) => Some(SignalPart::Rotation(index)),
            _ => None,
        }
    }

    /// Sets it.
    pub fn put(self, signal: &mut Signal, value: f64) {
        match self {
            SignalPart::Delay => signal.delay_s = value * 1e-3,
            SignalPart::Gain => signal.gain = value,
            SignalPart::Bias(None) => signal.bias.fill(value),
            SignalPart::Bias(Some(index)) => {
                if let Some(bias) = signal.bias.get_mut(index) {
                    *bias = value;
                }
            }
            SignalPart::Position(index) => signal.frame_m[index] = value * 1e-3,
            SignalPart::Rotation(index) => signal.frame_rad[index] = value.to_radians(),
        }
    }

    /// Returns its value, in the key's unit.
    pub fn get(self, signal: &Signal) -> Option<f64> {
        match self {
            SignalPart::Delay => Some(signal.delay_s * 1e3),
            SignalPart::Gain => Some(signal.gain),
            SignalPart::Bias(index) => signal.bias.get(index.unwrap_or(0)).copied(),
            SignalPart::Position(index) => Some(signal.frame_m[index] * 1e3),
            SignalPart::Rotation(index) => Some(signal.frame_rad[index].to_degrees()),
        }
    }
}

impl Target {
    /// Parses a parameter's key. `experiments` and the two predicates know the study's names.
    pub(super) fn parse(
        key: &str,
        experiments: &[&str],
        has_measured: impl Fn(&str) -> bool,
        has_command: impl Fn(&str) -> bool,
    ) -> Result<Target, String> {
        let mut parts = key.splitn(3, '.');
        let (kind, name, rest) = (parts.next(), parts.next(), parts.next());
        let no_name =
            |what: &str, name: &str| format!("names {what} `{name}`, which the study does not have");
        match (kind, name, rest) {
            (Some("measured"), Some(name), Some(rest)) => {
                let part = SignalPart::parse(rest).ok_or_else(|| format!("is not {EXPECTED}"))?;
                let target = Target::Measured { name: name.to_owned(), part };
                has_measured(name).then_some(target).ok_or_else(|| no_name("the measured quantity", name))
            }
            (Some("command"), Some(name), Some(rest)) => {
                let part = match rest {
                    "gain" => CommandPart::Gain,
                    "bias" => CommandPart::Bias,
                    "delay_ms" => CommandPart::Delay,
                    _ => return Err(format!("is not {EXPECTED}")),
                };
                let target = Target::Command { name: name.to_owned(), part };
                has_command(name).then_some(target).ok_or_else(|| no_name("the command column", name))
            }
            (Some("experiment"), Some(name), Some("clock_offset_s")) => {
                let experiment = experiments.iter().position(|experiment| *experiment == name);
                let experiment = experiment.ok_or_else(|| no_name("the experiment", name))?;
                Ok(Target::ClockOffset { experiment })
            }
            (Some("measured" | "command" | "experiment"), ..) => Err(format!("is not {EXPECTED}")),
            _ => Ok(Target::Scene(key.to_owned())),
        }
    }
}
