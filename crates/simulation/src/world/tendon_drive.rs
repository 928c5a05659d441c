//! Tendon actuators: tension control, displacement control, or jerk-limited motion to a displacement goal.

use serde::{Deserialize, Serialize};

use crate::arm::{AxisLimits, AxisState, Goal, Planner, Segment};
use crate::manipulator::{MAX_TENDONS, TendonCommand};

/// Limits of `move_jp` in m/s, m/s² and m/s³: those of a lead screw of moderate speed.
const LIMITS: AxisLimits<MAX_TENDONS> = AxisLimits {
    velocity: [0.005; MAX_TENDONS],
    acceleration: [0.05; MAX_TENDONS],
    jerk: [0.5; MAX_TENDONS],
};

/// The actuators' setpoint as plain data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[expect(
    clippy::large_enum_variant,
    reason = "one per simulation; boxing would add an indirection to every tick"
)]
pub(super) enum TendonDriveState {
    /// Tension setpoints, N.
    Force([f64; MAX_TENDONS]),
    /// Displacement setpoints, m.
    Displacement([f64; MAX_TENDONS]),
    /// Moving to a displacement goal.
    Move {
        /// The motion.
        segment: Segment<MAX_TENDONS>,
        /// Ticks since its start.
        ticks: u64,
    },
}

/// The actuators of the tendons.
pub(super) struct TendonDrive {
    state: TendonDriveState,
    planner: Planner<MAX_TENDONS>,
}

impl TendonDrive {
    pub(super) fn new() -> TendonDrive {
        TendonDrive { state: TendonDriveState::Force([0.0; MAX_TENDONS]), planner: Planner::new() }
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

    pub(super) fn servo_force(&mut self, tension_n: [f64; MAX_TENDONS]) {
        self.state = TendonDriveState::Force(tension_n);
    }

    pub(super) fn servo_displacement(&mut self, displacement_m: [f64; MAX_TENDONS]) {
        self.state = TendonDriveState::Displacement(displacement_m);
    }

    /// Starts a motion from the current displacements to a goal; a repeat of the current goal has no effect.
    pub(super) fn move_to(
        &mut self,
        goal_m: [f64; MAX_TENDONS],
        now_m: [f64; MAX_TENDONS],
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

    /// Returns the tendon command for this tick.
    pub(super) fn step(&mut self, dt_s: f64) -> TendonCommand {
        match &mut self.state {
            TendonDriveState::Force(tension_n) => TendonCommand::EachForce(*tension_n),
            TendonDriveState::Displacement(displacement_m) => {
                TendonCommand::EachDisplacement(*displacement_m)
            }
            TendonDriveState::Move { ticks, .. } => {
                *ticks += 1;
                TendonCommand::EachDisplacement(self.planner.sample(*ticks as f64 * dt_s).position)
            }
        }
    }
}
