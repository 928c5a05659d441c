//! Errors of markups files and plans.

use foreign_text::{foreign, foreign_line};
use thiserror::Error;

/// Why a text is not a markups file. The caller names the file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MarkupsError {
    /// It begins like neither format.
    #[error(
        "is not a 3D Slicer markups file: it begins with {}, expected `{{` (.mrk.json) or `#` (.fcsv)",
        foreign(.begins)
    )]
    Neither {
        /// The first characters.
        begins: String,
    },
    /// It is not JSON, or has a number out of the 64-bit range.
    #[error("is not JSON: {}; save the markups again from 3D Slicer", foreign_line(.cause))]
    NotJson {
        /// What is wrong, with line and column.
        cause: String,
    },
    /// A field is missing.
    #[error("has no `{field}`, expected {expected}")]
    Missing {
        /// The field with its path; in `.fcsv` with its line.
        field: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// A field has an invalid value.
    #[error("`{field}` is {}, expected {expected}", foreign_line(.given))]
    Field {
        /// The field with its path; in `.fcsv` with its line.
        field: String,
        /// The value found.
        given: String,
        /// What is allowed.
        expected: &'static str,
    },
}

/// Why markups do not define a plan. The caller names the file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlanError {
    /// Neither named points nor a line or curve that identifies them.
    #[error(
        "holds no plan: found {}; expected control points named `entry` and `target` (and `bend`, where a \
         curve begins), or one line \
         from entry to target, or one curve of two or three points (entry, bend, target)",
        foreign_line(.found)
    )]
    NoPlan {
        /// The markups found.
        found: String,
    },
    /// Only one of the two ends is named.
    #[error(
        "has a control point named `{there}` but none named `{lacking}`; name the other end too (found {})",
        foreign_line(.found)
    )]
    Half {
        /// The point that is named.
        there: &'static str,
        /// The missing point.
        lacking: &'static str,
        /// The markups found.
        found: String,
    },
    /// Several points have the same name.
    #[error("has {count} control points named `{name}`, expected only one")]
    Twice {
        /// The name.
        name: &'static str,
        /// Number of points with this name.
        count: usize,
    },
    /// A point of the plan has not been placed.
    #[error("`{name}` has no position (Slicer's status is `{}`, expected `defined`); place the \
             point", foreign(.status))]
    Undefined {
        /// The point.
        name: &'static str,
        /// Slicer's status.
        status: String,
    },
    /// Two points coincide, so that there is no direction.
    #[error("`{first}` and `{second}` are {distance_mm:.3} mm apart, expected 1 mm or more")]
    TooClose {
        /// A point.
        first: &'static str,
        /// Another point.
        second: &'static str,
        /// Their distance.
        distance_mm: f64,
    },
    /// The target lies behind the bend.
    #[error(
        "`target` lies {ahead_mm:.2} mm ahead of `bend` along the line from `entry` to `bend`, expected 1 mm \
         or more: the tool cannot bend backward"
    )]
    Behind {
        /// Distance along the line; negative is behind.
        ahead_mm: f64,
    },
}
