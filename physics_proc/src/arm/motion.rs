//! The motion in progress as plain data: with a tick count, all that a snapshot needs to continue bit for bit.

use serde::{Deserialize, Serialize};

use super::line::Line;
use super::trajectory::{AxisLimits, Segment};

/// What the arm is doing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Motion {
    /// Standing still.
    Rest,
    /// The joints follow a jerk-limited segment.
    Joint(JointMotion),
    /// The flange follows a straight line, its parameter a jerk-limited segment.
    Line(LineMotion),
}

/// A segment of the six joints.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct JointMotion {
    pub(super) segment: Segment<6>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A line that begins at this segment's end.
    pub(super) next: Option<NextLine>,
}

/// A segment of a line's parameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct LineMotion {
    pub(super) line: Line,
    pub(super) segment: Segment<1>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A line that begins at this segment's end.
    pub(super) next: Option<NextLine>,
}

/// A line that waits for the arm to stand still at its start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct NextLine {
    pub(super) line: Line,
    pub(super) limits: AxisLimits<1>,
}
