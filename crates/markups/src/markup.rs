//! A markup, whatever format it came in.

use crate::error::MarkupsError;
use crate::{fcsv, mrk_json};

/// Farthest coordinate of a point: 100 m, as in a scene.
pub const FARTHEST_MM: f64 = 1e5;

/// Patient frames that programs use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    /// +x left, +y posterior, +z superior: ours, and DICOM's.
    Lps,
    /// +x right, +y anterior, +z superior: 3D Slicer's own.
    Ras,
}

impl Frame {
    /// A position of this frame in LPS, in the same unit. RAS is LPS turned by half a turn about z, so this
    /// is its own inverse.
    pub fn to_lps(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Frame::Lps => [x, y, z],
            // 0 - x and not -x: no negative zero in a scene that people read.
            Frame::Ras => [0.0 - x, 0.0 - y, z],
        }
    }

    /// As files name it.
    pub fn name(self) -> &'static str {
        match self {
            Frame::Lps => "LPS",
            Frame::Ras => "RAS",
        }
    }

    /// By the name that files give it.
    pub(crate) fn of_name(name: &str) -> Option<Frame> {
        [Frame::Lps, Frame::Ras].into_iter().find(|frame| frame.name().eq_ignore_ascii_case(name.trim()))
    }
}

/// What kind of markup it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// A list of points.
    Points,
    /// A line of two points.
    Line,
    /// An open curve.
    Curve,
    /// Anything else, by Slicer's name for it.
    Other(String),
}

/// A control point.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// What the user calls it.
    pub label: String,
    /// Where it is, LPS, mm; `None` where Slicer says that it has not been set.
    pub position_mm: Option<[f64; 3]>,
    /// Slicer's word for whether it has been set: `defined`, `undefined`, `preview`, `missing`.
    pub status: String,
}

/// A markup: a list of points, a line, a curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Markup {
    /// What it is.
    pub kind: Kind,
    /// The frame that the file says; the points are in LPS all the same.
    pub frame: Frame,
    /// The control points in their order.
    pub points: Vec<Point>,
}

/// Reads a file of markups: `.mrk.json`, or `.fcsv`. The text tells which of them it is, not the file's name.
///
/// # Errors
/// [`MarkupsError`]: neither of the two, a frame that is not said or is not a patient's, a unit other than mm, a position that is not three
/// finite numbers within 100 m.
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

/// What a position must be.
pub(crate) const POSITION: &str = "three numbers of mm, each from -100000 to 100000";

/// A position, checked and in LPS.
pub(crate) fn position(frame: Frame, given: [f64; 3]) -> Option<[f64; 3]> {
    let is_near = |x: &f64| (-FARTHEST_MM..=FARTHEST_MM).contains(x);
    given.iter().all(is_near).then(|| frame.to_lps(given))
}
