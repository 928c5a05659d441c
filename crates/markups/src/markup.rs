//! A markup, independent of the file format.

use crate::error::MarkupsError;
use crate::{fcsv, mrk_json};

/// Largest coordinate of a point: 100 m, as in a scene.
pub const FARTHEST_MM: f64 = 1e5;

/// Patient frames that programs use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    /// +x left, +y posterior, +z superior: this project's, and DICOM's.
    Lps,
    /// +x right, +y anterior, +z superior: 3D Slicer's own.
    Ras,
}

impl Frame {
    /// Converts a position of this frame to LPS, in the same unit. RAS is LPS rotated by half a turn about z,
    /// so the conversion is its own inverse.
    pub fn to_lps(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Frame::Lps => [x, y, z],
            // 0 - x instead of -x avoids negative zeros in scenes.
            Frame::Ras => [0.0 - x, 0.0 - y, z],
        }
    }

    /// Name of the frame in files.
    pub fn name(self) -> &'static str {
        match self {
            Frame::Lps => "LPS",
            Frame::Ras => "RAS",
        }
    }

    /// The frame of a name in a file.
    pub(crate) fn of_name(name: &str) -> Option<Frame> {
        [Frame::Lps, Frame::Ras].into_iter().find(|frame| frame.name().eq_ignore_ascii_case(name.trim()))
    }
}

/// Kind of a markup.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// A list of points.
    Points,
    /// A line of two points.
    Line,
    /// An open curve.
    Curve,
    /// Anything else, by Slicer's name.
    Other(String),
}

/// A control point.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Its label.
    pub label: String,
    /// Position, LPS, mm; `None` if Slicer has not placed it.
    pub position_mm: Option<[f64; 3]>,
    /// Slicer's status: `defined`, `undefined`, `preview`, `missing`.
    pub status: String,
}

/// A markup: a list of points, a line, a curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Markup {
    /// Its kind.
    pub kind: Kind,
    /// The frame stated in the file; the points are in LPS regardless.
    pub frame: Frame,
    /// The control points in order.
    pub points: Vec<Point>,
}

/// Reads a markups file, `.mrk.json` or `.fcsv`. The content decides which, not the file's name.
///
/// # Errors
/// [`MarkupsError`]: neither format, a missing frame or one that is not a patient frame, a unit other than
/// mm, or a position that is not three finite numbers within 100 m.
pub fn read(text: &str) -> Result<Vec<Markup>, MarkupsError> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    match text.trim_start().chars().next() {
        Some('{') => mrk_json::read(text),
        Some('#') => fcsv::read(text).map(|markup| vec![markup]),
        _ => Err(MarkupsError::Neither {
            begins: if text.trim().is_empty() {
                "nothing".to_owned()
            } else {
                text.chars().take(20).collect()
            },
        }),
    }
}

/// Requirement for positions.
pub(crate) const POSITION: &str = "three numbers in mm, each from -100000 to 100000";

/// A checked position in LPS.
pub(crate) fn position(frame: Frame, given: [f64; 3]) -> Option<[f64; 3]> {
    let is_near = |x: &f64| (-FARTHEST_MM..=FARTHEST_MM).contains(x);
    given.iter().all(is_near).then(|| frame.to_lps(given))
}
