//! Which input moves what, and how fast: a TOML file, or the built-in one of a kind of device.

use core::f64::consts::PI;
use std::path::PathBuf;

use ipc_types::messages::{MAX_BURR_SPEED_RAD_PER_S, MAX_DISPLACEMENT_RATE_M_PER_S, MAX_TENDONS};
use ipc_types::text_file;
use serde::Deserialize;
use thiserror::Error;

use super::DeviceKind;
use super::input::{EXPECTED, Input};

/// Largest speed of the burr by an axis. The arm follows its goal closely at up to this speed.
const HIGHEST_MM_PER_S: f64 = 100.0;
/// Largest angular speed by an axis, about the burr.
const HIGHEST_DEG_PER_S: f64 = 45.0;
const RPM: f64 = PI / 30.0;

/// Why a mapping is refused.
#[derive(Debug, Error)]
pub enum MappingError {
    /// The file cannot be read.
    #[error("{}: {source}", foreign_text::foreign_path(.file))]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of another type.
    #[error("{}:{line}: {cause}", foreign_text::foreign_path(.file))]
    Malformed {
        /// The file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        cause: String,
    },
    /// A value is not allowed.
    #[error("{}: `{key}` is {given}; allowed: {expected}", foreign_text::foreign_path(.file))]
    Value {
        /// The file.
        file: PathBuf,
        /// The key.
        key: String,
        /// Its value.
        given: String,
        /// What it may be.
        expected: String,
    },
}

/// The axes along and about which the arm moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum MotionFrame {
    /// Those of the tool's base: +z forward, +x toward tendon 0.
    #[default]
    Tool,
    /// The patient's (LPS).
    Patient,
    /// Those of the newest X-ray image: x to the right, y down, z to the source.
    CArm,
}

/// What an input moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Output {
    /// The burr along an axis of the frame.
    Along(usize),
    /// The tool about an axis of the frame, through the burr.
    About(usize),
    /// A tendon; positive pulls.
    Tendon(usize),
    /// The burr's speed.
    Burr,
}

/// One input, and what it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Drive {
    pub(crate) input: Input,
    pub(crate) output: Output,
    /// At full deflection: m/s or rad/s.
    pub(crate) rate: f64,
    /// Share of the deflection that counts as rest.
    dead_zone: f64,
    /// Lowest value, rest, highest value.
    range: [f64; 3],
    /// A button that turns on and off with each press.
    pub(crate) toggle: bool,
}

/// A checked mapping.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Mapping {
    pub(crate) frame: MotionFrame,
    /// Everything is at rest unless this is held.
    pub(crate) clutch: Input,
    pub(crate) halt: Option<Input>,
    pub(crate) drives: Vec<Drive>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    #[serde(default)]
    frame: MotionFrame,
    clutch: String,
    halt: Option<String>,
    map: Vec<DriveText>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct DriveText {
    input: String,
    output: String,
    rate: f64,
    #[serde(default)]
    dead_zone: f64,
    range: Option<[f64; 3]>,
    #[serde(default)]
    toggle: bool,
}

/// Returns the text of the built-in mapping of a kind of device.
pub fn built_in(kind: DeviceKind) -> &'static str {
    match kind {
        DeviceKind::Gamepad => include_str!("mappings/gamepad.toml"),
        DeviceKind::SpaceMouse => include_str!("mappings/spacemouse.toml"),
        DeviceKind::Pedal => include_str!("mappings/pedal.toml"),
    }
}

impl Drive {
    /// Returns the rate at a value of the input: 0 in the dead zone, and full at either end of the range.
    pub(crate) fn rate_at(&self, value: f64) -> f64 {
        let [lowest, rest, highest] = self.range;
        let span = if value < rest { rest - lowest } else { highest - rest };
        if span <= 0.0 {
            return 0.0;
        }
        let deflection = ((value - rest) / span).clamp(-1.0, 1.0);
        let beyond = ((deflection.abs() - self.dead_zone) / (1.0 - self.dead_zone)).max(0.0);
        self.rate * beyond.copysign(deflection)
    }
}

impl Mapping {
    /// Reads a mapping file, or the built-in mapping of a kind of device.
    ///
    /// # Errors
    /// The [`MappingError`].
    pub(crate) fn load(file: Option<&PathBuf>, kind: DeviceKind) -> Result<Mapping, MappingError> {
        let Some(file) = file else {
            return Mapping::parse(built_in(kind), PathBuf::from("built-in mapping"));
        };
        let text =
            text_file::read(file).map_err(|source| MappingError::Read { file: file.clone(), source })?;
        Mapping::parse(&text, file.clone())
    }

    fn parse(text: &str, file: PathBuf) -> Result<Mapping, MappingError> {
        let read: Text = toml::from_str(text).map_err(|error| {
            let line = foreign_text::line_at(text, error.span().map_or(0, |span| span.start));
            let cause = foreign_text::foreign_line(error.message()).to_string();
            MappingError::Malformed { file: file.clone(), line, cause }
        })?;
        let check = Checker { file };
        if read.map.is_empty() {
            return Err(check.value("map", "empty", "at least one [[map]]"));
        }
        let drives = read.map.iter().enumerate().map(|(index, drive)| check.drive(index, drive));
        if read.halt.as_ref() == Some(&read.clutch) {
            return Err(check.value("halt", &read.clutch, "a button other than the clutch"));
        }
        Ok(Mapping {
            frame: read.frame,
            clutch: check.button("clutch", &read.clutch)?,
            halt: read.halt.as_ref().map(|name| check.button("halt", name)).transpose()?,
            drives: drives.collect::<Result<_, _>>()?,
        })
    }
}

/// What a range must be.
const RANGE: &str = "lowest value, rest and highest value, rising, within -2147483647 to 2147483647";

/// Builds the errors of a file.
struct Checker {
    file: PathBuf,
}

impl Checker {
    fn value(&self, key: &str, given: impl ToString, expected: impl ToString) -> MappingError {
        let given = foreign_text::foreign_line(&given.to_string()).to_string();
        MappingError::Value {
            file: self.file.clone(),
            key: key.to_owned(),
            given,
            expected: expected.to_string(),
        }
    }

    fn within(&self, key: &str, value: f64, lowest: f64, highest: f64) -> Result<f64, MappingError> {
        // Written so that NaN fails.
        match (lowest..=highest).contains(&value) {
            true => Ok(value),
            false => Err(self.value(key, value, format!("{lowest} to {highest}"))),
        }
    }

    fn button(&self, key: &str, name: &str) -> Result<Input, MappingError> {
        match Input::named(name) {
            Some(input @ Input::Button(_)) => Ok(input),
            _ => Err(self.value(key, name, "a button: BTN_0, BTN_SOUTH, BTN_TL, KEY_A and so on")),
        }
    }

    fn drive(&self, index: usize, text: &DriveText) -> Result<Drive, MappingError> {
        let key = |name: &str| format!("map[{index}].{name}");
        let input =
            Input::named(&text.input).ok_or_else(|| self.value(&key("input"), &text.input, EXPECTED))?;
        let (output, [lowest, highest], unit) = output(&text.output).ok_or_else(|| {
            self.value(&key("output"), &text.output, "x, y, z, rx, ry, rz, tendon_0 to tendon_3, burr")
        })?;
        let is_button = matches!(input, Input::Button(_));
        let range = match (text.range, is_button) {
            (Some(range), true) => {
                return Err(self.value(&key("range"), format!("{range:?}"), "none for a button"));
            }
            (None, false) => {
                return Err(self.value(
                    &key("range"),
                    "missing",
                    "lowest value, rest and highest value of the axis",
                ));
            }
            (None, true) => [0.0, 0.0, 1.0],
            (Some(range), false) => self.range(&key("range"), range)?,
        };
        if text.toggle && !is_button {
            return Err(self.value(&key("toggle"), true, "false for an axis"));
        }
        Ok(Drive {
            input,
            output,
            rate: self.within(&key("rate"), text.rate, lowest, highest)? * unit,
            dead_zone: self.within(&key("dead_zone"), text.dead_zone, 0.0, 0.9)?,
            range,
            toggle: text.toggle,
        })
    }

    fn range(&self, key: &str, range: [f64; 3]) -> Result<[f64; 3], MappingError> {
        let [lowest, rest, highest] = range;
        let fits = |value: &f64| value.abs() <= f64::from(i32::MAX);
        if range.iter().all(fits) && lowest <= rest && rest <= highest && lowest < highest {
            return Ok(range);
        }
        Err(self.value(key, format!("{range:?}"), RANGE))
    }
}

/// Returns an output by its name, the least and greatest rate in the file's unit, and that unit in SI.
fn output(name: &str) -> Option<(Output, [f64; 2], f64)> {
    let linear = [-HIGHEST_MM_PER_S, HIGHEST_MM_PER_S];
    let angular = [-HIGHEST_DEG_PER_S, HIGHEST_DEG_PER_S];
    let tendon = 1e3 * MAX_DISPLACEMENT_RATE_M_PER_S;
    if let Some(axis) = ["x", "y", "z"].iter().position(|axis| *axis == name) {
        return Some((Output::Along(axis), linear, 1e-3));
    }
    if let Some(axis) = ["rx", "ry", "rz"].iter().position(|axis| *axis == name) {
        return Some((Output::About(axis), angular, PI / 180.0));
    }
    if name == "burr" {
        return Some((Output::Burr, [0.0, (MAX_BURR_SPEED_RAD_PER_S / RPM).floor()], RPM));
    }
    let tendon_index = (0..MAX_TENDONS).find(|index| name == format!("tendon_{index}"))?;
    Some((Output::Tendon(tendon_index), [-tendon, tendon], 1e-3))
}

#[cfg(test)]
pub(crate) fn parsed(text: &str) -> Result<Mapping, String> {
    Mapping::parse(text, PathBuf::from("map.toml")).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: &str = "clutch = \"BTN_0\"\n[[map]]\ninput = \"ABS_X\"\noutput = \"x\"\nrate = 10.0\n\
                       dead_zone = 0.2\nrange = [-100, 0, 100]\n";

    #[test]
    fn every_kind_has_a_mapping() {
        for kind in DeviceKind::ALL {
            Mapping::load(None, kind).unwrap();
        }
    }

    #[test]
    fn rates_begin_at_the_dead_zone_and_end_at_the_range() {
        let stick = parsed(ONE).unwrap().drives[0];
        for (value, expected_mm_per_s) in
            [(0.0, 0.0), (20.0, 0.0), (-20.0, 0.0), (60.0, 5.0), (-60.0, -5.0), (100.0, 10.0), (1e9, 10.0)]
        {
            assert!((1e3 * stick.rate_at(value) - expected_mm_per_s).abs() < 1e-12, "{value}");
        }
        let trigger = ONE.replace("[-100, 0, 100]", "[0, 0, 250]").replace("10.0", "-10.0");
        let trigger = parsed(&trigger).unwrap().drives[0];
        assert_eq!((trigger.rate_at(-1e9), trigger.rate_at(250.0)), (0.0, -0.01));
    }

    #[test]
    fn what_a_mapping_may_not_hold_is_refused_by_key_and_range() {
        for (from, to, expected) in [
            (
                "rate =",
                "speed =",
                "map.toml:5: unknown field `speed`, expected one of `input`, `output`, `rate`",
            ),
            (
                "clutch",
                "frame = \"bone\"\nclutch",
                "unknown variant `bone`, expected one of `tool`, `patient`, `c_arm`",
            ),
            ("10.0", "101.0", "`map[0].rate` is 101; allowed: -100 to 100"),
            ("10.0", "nan", "`map[0].rate` is NaN; allowed: -100 to 100"),
            ("0.2", "1.0", "`map[0].dead_zone` is 1; allowed: 0 to 0.9"),
            ("ABS_X", "ABS_Q", "`map[0].input` is ABS_Q; allowed: ABS_X to ABS_RZ"),
            ("\"x\"", "\"w\"", "`map[0].output` is w; allowed: x, y, z, rx"),
            ("BTN_0", "ABS_X", "`clutch` is ABS_X; allowed: a button"),
            ("range = [-100, 0, 100]", "", "`map[0].range` is missing; allowed: lowest value, rest and"),
            ("[-100, 0, 100]", "[100, 0, -100]", "allowed: lowest value, rest and highest value, rising"),
            ("ABS_X", "BTN_1", "`map[0].range` is [-100.0, 0.0, 100.0]; allowed: none for a button"),
            ("dead_zone = 0.2", "toggle = true", "`map[0].toggle` is true; allowed: false for an axis"),
            ("clutch = \"BTN_0\"\n", "", "missing field `clutch`"),
            (
                "clutch",
                "halt = \"BTN_0\"\nclutch",
                "`halt` is BTN_0; allowed: a button other than the clutch",
            ),
        ] {
            let error = parsed(&ONE.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let burr = ONE.replace("\"x\"", "\"burr\"").replace("10.0", "-1.0");
        let error = parsed(&burr).unwrap_err();
        assert!(error.contains("`map[0].rate` is -1; allowed: 0 to 60000"), "{error}");
    }
}
