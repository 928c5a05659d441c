//! The tendons' actuators: tension, displacement, or a displacement goal reached with limited jerk.

use serde::{Deserialize, Serialize};

use crate::arm::{AxisLimits, AxisState, Goal, Planner, Segment};
use crate::manipulator::TendonCommand;

/// Limits of `move_jp`: a lead screw of moderate speed. m/s, m/s², m/s³.
const LIMITS: AxisLimits<2> = AxisLimits { velocity: [0.005; 2], acceleration: [0.05; 2], jerk: [0.5; 2] };

/// What the actuators follow, as plain data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) enum TendonDriveState {
    /// Tensions.
    Force([f64; 2]),
    /// Displacements.
    Displacement([f64; 2]),
    /// On the way to a displacement.
    Move {
        /// The motion.
        segment: Segment<2>,
        /// Ticks made of it.
        ticks: u64,
    },
}

/// The actuators of the tendon pair.
pub(super) struct TendonDrive {
    state: TendonDriveState,
    planner: Planner<2>,
}

impl TendonDrive {
    pub(super) fn new() -> TendonDrive {
        TendonDrive { state: TendonDriveState::Force([0.0; 2]), planner: Planner::new() }
    }

    pub(super) fn snapshot(&self) -> TendonDriveState {
        self.state
    }

    pub(super) fn restore(&mut self, state: &TendonDriveState) {
        self.state = *state;
        if let TendonDriveState::Move { segment, .. } = state
            && self.planner.plan(segment).is_ok()
        {
            self.planner.commit();
        }
    }

    pub(super) fn servo_force(&mut self, tension_n: [f64; 2]) {
        self.state = TendonDriveState::Force(tension_n);
    }

    pub(super) fn servo_displacement(&mut self, displacement_m: [f64; 2]) {
        self.state = TendonDriveState::Displacement(displacement_m);
    }

    /// Starts toward a displacement from where the tendons are; the goal already followed changes nothing.
    pub(super) fn move_to(
        &mut self,
        goal_m: [f64; 2],
        now_m: [f64; 2],
        dt_s: f64,
    ) -> Result<(), crate::arm::TrajectoryError> {
        let start = match self.state {
            TendonDriveState::Move { segment, .. } if segment.goal == Goal::Independent(goal_m) => {
                return Ok(());
            }
            TendonDriveState::Move { ticks, .. } => self.planner.sample(ticks as f64 * dt_s),
            TendonDriveState::Displacement(displacement_m) => AxisState::at_rest(displacement_m),
            TendonDriveState::Force(_) => AxisState::at_rest(now_m),
        };
        let segment = Segment { start, goal: Goal::Independent(goal_m), limits: LIMITS };
        self.planner.plan(&segment)?;
        self.planner.commit();
        self.state = TendonDriveState::Move { segment, ticks: 0 };
        Ok(())
    }

    /// What the tendons are told in this tick.
    pub(super) fn step(&mut self, dt_s: f64) -> TendonCommand {
        match &mut self.state {
            TendonDriveState::Force(tension_n) => TendonCommand::Force(*tension_n),
            TendonDriveState::Displacement(displacement_m) => TendonCommand::Displacement(*displacement_m),
            TendonDriveState::Move { ticks, .. } => {
                *ticks += 1;
                TendonCommand::Displacement(self.planner.sample(*ticks as f64 * dt_s).position)
            }
        }
    }
}
