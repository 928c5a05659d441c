//! The motion in progress as plain data: with a tick count, all that a snapshot needs to continue bit for bit.

use serde::{Deserialize, Serialize};

use super::path::Path;
use super::trajectory::{AxisLimits, Segment};

/// What the arm is doing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Motion {
    /// Standing still.
    Rest,
    /// The joints follow a jerk-limited segment.
    Joint(JointMotion),
    /// The tool's base follows a path, its parameter a jerk-limited segment.
    Path(PathMotion),
}

/// A segment of the six joints.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct JointMotion {
    pub(super) segment: Segment<6>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A path that begins at this segment's end.
    pub(super) next: Option<NextPath>,
}

/// A segment of a path's parameter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct PathMotion {
    pub(super) path: Path,
    pub(super) segment: Segment<1>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A path that begins at this segment's end.
    pub(super) next: Option<NextPath>,
}

/// A path that waits for the arm to stand still at its start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct NextPath {
    pub(super) path: Path,
    pub(super) limits: AxisLimits<1>,
}
