//! Why markups are refused.

use foreign_text::{foreign, foreign_line};
use thiserror::Error;

/// Why a text is not a file of markups. The caller names the file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MarkupsError {
    /// It begins like neither format.
    #[error(
        "is no file of markups: it begins with {}, expected `{{` (.mrk.json) or `#` (.fcsv) of 3D Slicer",
        foreign(.begins)
    )]
    Neither {
        /// The first characters.
        begins: String,
    },
    /// It is not JSON; also a number beyond what 64 bits hold.
    #[error("is not JSON: {}; save the markups again from 3D Slicer", foreign_line(.cause))]
    NotJson {
        /// What is wrong, with line and column.
        cause: String,
    },
    /// A field is not there.
    #[error("has no `{field}`, expected {expected}")]
    Missing {
        /// The field with its path; in `.fcsv` with its line.
        field: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// A field has a value that it must not have.
    #[error("`{field}` is {}, expected {expected}", foreign_line(.given))]
    Field {
        /// The field with its path; in `.fcsv` with its line.
        field: String,
        /// What is there.
        given: String,
        /// What is allowed.
        expected: &'static str,
    },
}

/// Why markups make no plan. The caller names the file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlanError {
    /// Neither named points nor a line or curve that says which is which.
    #[error(
        "holds no plan: there are {}; expected control points named `entry` and `target` (and `bend`, where a curve begins), or one line \
         from entry to target, or one curve of two or three points (entry, bend, target)",
        foreign_line(.found)
    )]
    NoPlan {
        /// The markups that there are.
        found: String,
    },
    /// One of the two ends has a name and the other has not.
    #[error(
        "has a control point named `{there}` and none named `{lacking}`; name the other end, too (there are {})",
        foreign_line(.found)
    )]
    Half {
        /// The point that has its name.
        there: &'static str,
        /// The one that is missing.
        lacking: &'static str,
        /// The markups that there are.
        found: String,
    },
    /// Two points have one name.
    #[error("has {count} control points named `{name}`, expected one")]
    Twice {
        /// The name.
        name: &'static str,
        /// How often it is there.
        count: usize,
    },
    /// A point of the plan was never set.
    #[error("`{name}` has no position (Slicer's status is `{}`), expected `defined`; place the point", foreign(.status))]
    Undefined {
        /// The point.
        name: &'static str,
        /// Slicer's word for it.
        status: String,
    },
    /// Two points lie in one place, so that there is no direction.
    #[error("`{first}` and `{second}` are {distance_mm:.3} mm apart, expected 1 mm or more")]
    TooClose {
        /// A point.
        first: &'static str,
        /// Another point.
        second: &'static str,
        /// Their distance.
        distance_mm: f64,
    },
    /// The curve would have to turn back.
    #[error(
        "`target` lies {ahead_mm:.2} mm ahead of `bend` along the line from `entry` to `bend`, expected 1 mm or more: the tool bends forward"
    )]
    Behind {
        /// Along the line; negative is behind.
        ahead_mm: f64,
    },
}
