//! The motion in progress as plain data. Together with the tick count, a snapshot needs nothing else to
//! continue bit for bit.

use messages::MAX_ARM_JOINTS;
use serde::{Deserialize, Serialize};

use super::path::Path;
use super::trajectory::{AxisLimits, Segment};

/// The motion in progress.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) enum Motion {
    /// At rest.
    Rest,
    /// The joints follow a jerk-limited segment.
    Joint(JointMotion),
    /// The tool's base follows a path whose parameter is a jerk-limited segment.
    Path(PathMotion),
}

/// Motion along a joint-space segment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct JointMotion {
    pub(super) segment: Segment<MAX_ARM_JOINTS>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A path to start at the end of this segment.
    pub(super) next: Option<NextPath>,
}

/// Motion along a path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct PathMotion {
    pub(super) path: Path,
    pub(super) segment: Segment<1>,
    pub(super) duration_s: f64,
    /// Ticks since the segment's start.
    pub(super) tick: u64,
    /// A path to start at the end of this segment.
    pub(super) next: Option<NextPath>,
}

/// A pending path: it starts once the arm is at rest at the path's start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct NextPath {
    pub(super) path: Path,
    pub(super) limits: AxisLimits<1>,
}
