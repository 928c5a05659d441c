//! Calibration tables: the bend of the tip for each tendon tension or displacement. `trabecula calibrate`
//! writes them; open-loop curved drilling reads them.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Returns a file's text; this crate opens no files itself.
pub type ReadText<'a> = dyn Fn(&Path) -> std::io::Result<String> + 'a;

/// Columns of the file, in order.
pub const COLUMNS: [&str; 12] = [
    "direction",
    "commanded",
    "tension_n",
    "displacement_mm",
    "bend_deg",
    "tip_x_mm",
    "tip_y_mm",
    "tip_z_mm",
    "tip_rx_deg",
    "tip_ry_deg",
    "tip_rz_deg",
    "rate_deg_per_s",
];

/// Tip pose at one level of the tendon.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CalibrationRow {
    /// True while the tension rises, false on the way back: friction makes the two differ.
    pub rising: bool,
    /// The commanded value: N, or mm of displacement.
    pub commanded: f64,
    /// Tension of tendon 0 at its base end.
    pub tension_n: f64,
    /// Pulled length of tendon 0.
    pub displacement_mm: f64,
    /// Sum of the flexure angles.
    pub bend_deg: f64,
    /// Position of the burr's front in the frame of the tool's base.
    pub tip_mm: [f64; 3],
    /// Orientation of the burr in the frame of the tool's base, as axis times angle.
    pub tip_rotation_deg: [f64; 3],
    /// Rate at which the bend was still changing: large if the level had no time to settle.
    pub rate_deg_per_s: f64,
}

/// Why a calibration cannot be used.
#[derive(Debug, Error)]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error(
        "calibration {}: cannot be read ({cause}); create one with `trabecula calibrate`", path.display()
    )]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// The target lies on the side that tendon 0 cannot bend toward.
    #[error(
        "`target_mm` lies {:.2} deg on the side away from `tool.bend_toward`; turn `bend_toward` to the \
         target's side",
        -wanted_deg
    )]
    OtherSide {
        /// Bend of the arc; negative on the side that tendon 0 cannot bend toward.
        wanted_deg: f64,
    },
    /// A line does not have the format of a calibration.
    #[error("calibration {}, line {line}: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// Description of the defect, and what was expected.
        problem: String,
    },
    /// The plan needs more bend than the calibration covers.
    #[error(
        "the arc to the target bends the tip by {wanted_deg:.2} deg, but the calibration ends at \
         {reached_deg:.2} deg; extend the calibration or choose another target"
    )]
    OutOfReach {
        /// Bend of the plan.
        wanted_deg: f64,
        /// Largest bend in the calibration.
        reached_deg: f64,
    },
}

/// The rows of a sweep in the order they were recorded.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// The rows.
    pub rows: Vec<CalibrationRow>,
}

impl Calibration {
    /// Loads a file written by `trabecula calibrate`; `read` returns a file's text.
    ///
    /// # Errors
    /// [`CalibrationError::Unreadable`], [`CalibrationError::Malformed`].
    pub fn load(path: &Path, read: &ReadText) -> Result<Calibration, CalibrationError> {
        let text =
            read(path).map_err(|cause| CalibrationError::Unreadable { path: path.to_owned(), cause })?;
        Calibration::parse(&text).map_err(|(line, problem)| CalibrationError::Malformed {
            path: path.to_owned(),
            line,
            problem,
        })
    }

    /// Parses the text of a file; the error gives the line number, from 1, and the defect.
    ///
    /// # Errors
    /// If a line is malformed, or there are fewer than two rising rows with increasing bend.
    pub fn parse(text: &str) -> Result<Calibration, (usize, String)> {
        let mut lines = text.lines().enumerate();
        let header = lines.next().map_or("", |(_, line)| line);
        if header != COLUMNS.join(",") {
            return Err((1, format!("expected the columns {}", COLUMNS.join(","))));
        }
        let rows: Result<Vec<CalibrationRow>, _> =
            lines.map(|(index, line)| row(line).map_err(|problem| (index + 1, problem))).collect();
        let calibration = Calibration { rows: rows? };
        let rising = calibration.rising();
        if rising.len() < 2 || rising.windows(2).any(|pair| pair[1].0 <= pair[0].0) {
            let problem = "expected at least two `up` rows, each with more bend than the one before";
            return Err((text.lines().count(), problem.to_owned()));
        }
        Ok(calibration)
    }

    /// Formats the rows as the text of a file.
    pub fn to_csv(&self) -> String {
        let mut text = COLUMNS.join(",");
        text.push('\n');
        for row in &self.rows {
            let direction = if row.rising { "up" } else { "down" };
            let numbers = [row.commanded, row.tension_n, row.displacement_mm, row.bend_deg]
                .into_iter()
                .chain(row.tip_mm)
                .chain(row.tip_rotation_deg)
                .chain([row.rate_deg_per_s]);
            text.push_str(direction);
            for number in numbers {
                // Writing to a string cannot fail.
                let _ = write!(text, ",{number:.6}");
            }
            text.push('\n');
        }
        text
    }

    /// Returns the tension that bends the tip to `bend_deg` while the tension rises, by linear interpolation
    /// between rows.
    ///
    /// # Errors
    /// [`CalibrationError::OutOfReach`] if `bend_deg` exceeds the last row's bend.
    pub fn tension_for_bend_n(&self, bend_deg: f64) -> Result<f64, CalibrationError> {
        let rising = self.rising();
        let mut below = (0.0, 0.0);
        for &(bend, tension) in &rising {
            if bend >= bend_deg {
                let share = if bend > below.0 { (bend_deg - below.0) / (bend - below.0) } else { 1.0 };
                return Ok(below.1 + share.clamp(0.0, 1.0) * (tension - below.1));
            }
            below = (bend, tension);
        }
        Err(CalibrationError::OutOfReach { wanted_deg: bend_deg, reached_deg: below.0 })
    }

    /// Returns bend (deg) and tension (N) of the rising rows.
    fn rising(&self) -> Vec<(f64, f64)> {
        self.rows.iter().filter(|row| row.rising).map(|row| (row.bend_deg, row.tension_n)).collect()
    }
}

fn row(line: &str) -> Result<CalibrationRow, String> {
    let cells: Vec<&str> = line.split(',').map(str::trim).collect();
    let [direction, numbers @ ..] = cells.as_slice() else { return Err("is empty".to_owned()) };
    let rising = match *direction {
        "up" => true,
        "down" => false,
        other => return Err(format!("direction is {other:?}, expected `up` or `down`")),
    };
    let numbers: Result<Vec<f64>, String> = numbers
        .iter()
        .map(|cell| {
            cell.parse().ok().filter(|x: &f64| x.is_finite()).ok_or(format!("{cell:?} is not a number"))
        })
        .collect();
    let numbers = numbers?;
    let [commanded, tension_n, displacement_mm, bend_deg, x, y, z, rx, ry, rz, rate_deg_per_s] = numbers[..]
    else {
        return Err(format!("{} numbers, expected {}", numbers.len(), COLUMNS.len() - 1));
    };
    Ok(CalibrationRow {
        rising,
        commanded,
        tension_n,
        displacement_mm,
        bend_deg,
        tip_mm: [x, y, z],
        tip_rotation_deg: [rx, ry, rz],
        rate_deg_per_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> Calibration {
        let row = |rising, commanded: f64| CalibrationRow {
            rising,
            commanded,
            tension_n: commanded,
            displacement_mm: 0.5 * commanded,
            bend_deg: 8.0 * commanded + 0.5,
            tip_mm: [commanded, 0.0, 71.0],
            tip_rotation_deg: [0.0, 8.0 * commanded, 0.0],
            rate_deg_per_s: 0.0,
        };
        Calibration { rows: vec![row(true, 0.0), row(true, 1.0), row(true, 2.0), row(false, 1.0)] }
    }

    #[test]
    fn a_calibration_reads_back_and_interpolates() {
        let calibration = Calibration::parse(&example().to_csv()).unwrap();
        assert_eq!(calibration, example());
        assert!((calibration.tension_for_bend_n(12.5).unwrap() - 1.5).abs() < 1e-12);
        assert_eq!(calibration.tension_for_bend_n(0.0).unwrap(), 0.0);
        let beyond = calibration.tension_for_bend_n(17.0).unwrap_err().to_string();
        assert!(beyond.contains("17.00 deg") && beyond.contains("16.50 deg"), "{beyond}");
    }

    #[test]
    fn what_is_no_calibration_is_refused_with_its_line() {
        let good = example().to_csv();
        let cases = [
            (good.replace("direction,", "way,"), 1, "columns"),
            (good.replace("up,2.0", "sideways,2.0"), 4, "sideways"),
            (good.replace("up,1.000000,", "up,"), 3, "10 numbers"),
            (good.replace("up,1.000000", "up,NaN"), 3, "NaN"),
            (good.replace("up,1", "down,1").replace("up,2", "down,2"), 5, "at least two"),
        ];
        for (text, line, word) in cases {
            let (at, problem) = Calibration::parse(&text).unwrap_err();
            assert!(at == line && problem.contains(word), "line {at}: {problem}");
        }
    }
}
