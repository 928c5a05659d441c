//! Jerk-limited point-to-point motion of N axes: a thin wrapper around the official Ruckig library that
//! excludes waypoints.
//!
//! Ruckig (Berscheid and Kröger, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States",
//! RSS 2021) is used offline: a [`Segment`] is planned once, then sampled at any time. The plan is a pure
//! function of the segment, so a snapshot needs only the segment and a time.
//!
//! **No waypoints, ever.** The crate is compiled with a cloud client that would send intermediate positions
//! to a remote host. This file is the only one that uses Ruckig. It creates every object without room for
//! waypoints (Ruckig then refuses them itself) and checks before each calculation that there are none.
//!
//! Ruckig allocates: about eleven small C++ vectors per plan, and three Rust and three C++ vectors per
//! sample. Ruckig takes `cbrt`, `acos`, `atan`, `sin` and `cos` from the platform's C library: plans are
//! bit-identical on one machine and build, and across machines only with the same C library.

use ruckig::{ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Position, velocity and acceleration of N axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AxisState<const N: usize> {
    /// Position, in the axis's unit.
    #[serde(with = "serde_arrays")]
    pub position: [f64; N],
    /// First derivative with respect to time in seconds.
    #[serde(with = "serde_arrays")]
    pub velocity: [f64; N],
    /// Second derivative with respect to time.
    #[serde(with = "serde_arrays")]
    pub acceleration: [f64; N],
}

impl<const N: usize> AxisState<N> {
    /// Returns the state at rest at `position`.
    pub fn at_rest(position: [f64; N]) -> Self {
        Self { position, velocity: [0.0; N], acceleration: [0.0; N] }
    }
}

/// End condition of a segment: at rest, except for [`Goal::Velocity`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Goal<const N: usize> {
    /// At rest at this position, each axis in minimum time. An axis that can stop within its range does so.
    Independent(#[serde(with = "serde_arrays")] [f64; N]),
    /// At rest at this position, all axes synchronised along a straight line. Only from rest.
    StraightLine(#[serde(with = "serde_arrays")] [f64; N]),
    /// At rest anywhere, in minimum time.
    Standstill,
    /// At these velocities, each in minimum time, then constant.
    Velocity(#[serde(with = "serde_arrays")] [f64; N]),
}

/// Symmetric limits of N axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AxisLimits<const N: usize> {
    /// Maximum absolute velocity.
    #[serde(with = "serde_arrays")]
    pub velocity: [f64; N],
    /// Maximum absolute acceleration.
    #[serde(with = "serde_arrays")]
    pub acceleration: [f64; N],
    /// Maximum absolute jerk.
    #[serde(with = "serde_arrays")]
    pub jerk: [f64; N],
}

/// One jerk-limited motion from a start state to a goal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Segment<const N: usize> {
    /// State at time zero. A state beyond the limits is first brought back within them.
    pub start: AxisState<N>,
    /// The end condition.
    pub goal: Goal<N>,
    /// Limits during the motion.
    pub limits: AxisLimits<N>,
}

/// Error of planning a segment.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum TrajectoryError {
    /// Ruckig rejected the input or found no profile.
    #[error("Ruckig found no trajectory (result {code}: {meaning}); change the goal or the limits")]
    NoTrajectory {
        /// Ruckig's own result code.
        code: i32,
        /// Its meaning, in words.
        meaning: &'static str,
    },
    /// The guard against Ruckig's cloud client found a waypoint.
    #[error(
        "{count} intermediate positions were set: Ruckig would send them to a remote host; plan point to \
         point"
    )]
    WaypointsRefused {
        /// Number of intermediate positions.
        count: usize,
    },
}

/// Plans and samples segments of N axes. Holds the active trajectory and a candidate, so a refused plan
/// leaves the active one unchanged.
pub struct Planner<const N: usize> {
    ruckig: Ruckig,
    input: InputParameter,
    active: Trajectory,
    candidate: Trajectory,
}

impl<const N: usize> Planner<N> {
    /// Creates a planner without an active trajectory.
    pub fn new() -> Self {
        Self {
            ruckig: Ruckig::new_direct_and_offline(N),
            input: InputParameter::new(N),
            active: Trajectory::new_direct(N),
            candidate: Trajectory::new_direct(N),
        }
    }

    /// Plans `segment` as the candidate and returns its duration in seconds. The active trajectory is
    /// unchanged.
    pub fn plan(&mut self, segment: &Segment<N>) -> Result<f64, TrajectoryError> {
        let input = &mut self.input;
        let (here, rest) = (segment.start.position, [0.0; N]);
        let (interface, synchronization, target, velocity) = match segment.goal {
            Goal::Independent(target) => (ControlInterface::Position, Synchronization::None, target, rest),
            Goal::StraightLine(target) => (ControlInterface::Position, Synchronization::Phase, target, rest),
            Goal::Standstill => (ControlInterface::Velocity, Synchronization::None, here, rest),
            Goal::Velocity(velocity) => (ControlInterface::Velocity, Synchronization::None, here, velocity),
        };
        input.control_interface = interface;
        input.synchronization = synchronization;
        input.current_position.copy_from_slice(&segment.start.position);
        input.current_velocity.copy_from_slice(&segment.start.velocity);
        input.current_acceleration.copy_from_slice(&segment.start.acceleration);
        input.target_position.copy_from_slice(&target);
        input.target_velocity.copy_from_slice(&velocity);
        input.max_velocity.copy_from_slice(&segment.limits.velocity);
        input.max_acceleration.copy_from_slice(&segment.limits.acceleration);
        input.max_jerk.copy_from_slice(&segment.limits.jerk);
        self.calculate()
    }

    /// Makes the candidate of the last successful [`Self::plan`] the active trajectory.
    pub fn commit(&mut self) {
        std::mem::swap(&mut self.active, &mut self.candidate);
    }

    /// Returns the state of the active trajectory `time_s` after its start; the end state after its duration.
    pub fn sample(&self, time_s: f64) -> AxisState<N> {
        sample(&self.active, time_s)
    }

    /// Returns the state of the candidate, like [`Self::sample`].
    pub fn sample_candidate(&self, time_s: f64) -> AxisState<N> {
        sample(&self.candidate, time_s)
    }

    /// Calls Ruckig. The guard is directly before the call, so no waypoint can pass, regardless of how the
    /// input was set.
    fn calculate(&mut self) -> Result<f64, TrajectoryError> {
        let count = self.input.intermediate_positions.len();
        if count != 0 {
            return Err(TrajectoryError::WaypointsRefused { count });
        }
        match self.ruckig.calculate(&mut self.input, &mut self.candidate) {
            ruckig::Result::Working | ruckig::Result::Finished => Ok(self.candidate.get_duration()),
            refused => {
                Err(TrajectoryError::NoTrajectory { meaning: meaning(&refused), code: refused as i32 })
            }
        }
    }
}

impl<const N: usize> Default for Planner<N> {
    fn default() -> Self {
        Self::new()
    }
}

fn sample<const N: usize>(trajectory: &Trajectory, time_s: f64) -> AxisState<N> {
    let time_s = time_s.min(trajectory.get_duration());
    let (position, velocity, acceleration) = trajectory.at_time(time_s);
    let mut state = AxisState::at_rest([0.0; N]);
    state.position.copy_from_slice(&position);
    state.velocity.copy_from_slice(&velocity);
    state.acceleration.copy_from_slice(&acceleration);
    state
}

fn meaning(result: &ruckig::Result) -> &'static str {
    match result {
        ruckig::Result::Working | ruckig::Result::Finished => "no error",
        ruckig::Result::Error => "unspecified error",
        ruckig::Result::ErrorInvalidInput => "the state or a limit is not a valid number",
        ruckig::Result::ErrorTrajectoryDuration => "the motion would take longer than 7600 s",
        ruckig::Result::ErrorPositionalLimits => "the motion leaves the positional limits",
        ruckig::Result::ErrorZeroLimits => "a limit is zero",
        ruckig::Result::ErrorExecutionTimeCalculation => "no profile for one axis",
        ruckig::Result::ErrorSynchronizationCalculation => "the axes cannot be synchronised",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A call with a waypoint in the input is rejected before Ruckig sees it.
    #[test]
    fn waypoints_are_refused_before_ruckig_is_called() {
        let mut planner = Planner::<1>::new();
        let segment = Segment {
            start: AxisState::at_rest([0.0]),
            goal: Goal::Independent([1.0]),
            limits: AxisLimits { velocity: [1.0], acceleration: [1.0], jerk: [1.0] },
        };
        assert!(planner.plan(&segment).is_ok());
        planner.input.intermediate_positions.push(vec![0.5]);
        assert_eq!(planner.plan(&segment), Err(TrajectoryError::WaypointsRefused { count: 1 }));
    }

    /// Collects the Rust sources of all crates.
    fn sources(folder: &std::path::Path, found: &mut Vec<std::path::PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() && name != "target" && !name.starts_with('.') {
                sources(&path, found);
            } else if name.ends_with(".rs") {
                found.push(path);
            }
        }
    }

    /// Only this file names Ruckig, only its guard names waypoints, and no object is created with room for
    /// them.
    #[test]
    fn no_other_file_reaches_ruckig_or_a_waypoint() {
        let mut found = Vec::new();
        sources(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../.."), &mut found);
        found.retain(|path| !path.ends_with("arm/trajectory.rs"));
        assert!(found.len() > 100, "{} sources", found.len());
        for path in found {
            let source = std::fs::read_to_string(&path).unwrap();
            assert!(
                !source.contains("ruckig::") && !source.contains("intermediate_positions"),
                "{}: Ruckig belongs in trajectory.rs",
                path.display()
            );
        }
        let (code, _) =
            include_str!("trajectory.rs").split_once("#[cfg(test)]").expect("the tests follow the code");
        assert_eq!(code.matches("intermediate_positions").count(), 1, "the guard alone names waypoints");
        for with_room in ["Ruckig::new(", "new_offline(", "Trajectory::new(", "OutputParameter"] {
            assert!(!code.contains(with_room), "{with_room} makes room for waypoints");
        }
    }
}
