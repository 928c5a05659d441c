//! Tendon actuators: tensions, displacements, rates of displacement, or jerk-limited motion to a displacement
//! goal.

use messages::{MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_RATE_M_PER_S};
use serde::{Deserialize, Serialize};

use crate::arm::{AxisLimits, AxisState, Goal, Planner, Segment};
use crate::manipulator::{MAX_TENDONS, TendonCommand};

/// Limits of `move_jp` in m/s, m/s² and m/s³: those of a lead screw of moderate speed.
const LIMITS: AxisLimits<MAX_TENDONS> = AxisLimits {
    velocity: [MAX_DISPLACEMENT_RATE_M_PER_S; MAX_TENDONS],
    acceleration: [0.05; MAX_TENDONS],
    jerk: [0.5; MAX_TENDONS],
};

/// The actuators' setpoint as plain data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
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
    /// Following setpoints at rates that a fixture limits.
    Limited {
        /// Setpoints, N or m.
        goal: [f64; MAX_TENDONS],
        /// Where the actuators are, N or m.
        now: [f64; MAX_TENDONS],
        /// Whether they are tensions.
        is_force: bool,
    },
    /// Moving at given rates.
    Velocity {
        /// Rates of the displacements, m/s.
        rate: [f64; MAX_TENDONS],
        /// Displacement setpoints, m.
        now: [f64; MAX_TENDONS],
        /// Whether a fixture slowed the last step.
        is_slowed: bool,
    },
}

/// Largest rates of the actuators, N/s or m/s, of an increase and of a decrease of each setpoint.
#[derive(Debug, Clone, Copy)]
pub(super) struct RateLimits {
    pub up: [f64; MAX_TENDONS],
    pub down: [f64; MAX_TENDONS],
}

/// The actuators of the tendons.
pub(super) struct TendonDrive {
    state: TendonDriveState,
    planner: Planner<MAX_TENDONS>,
    /// Whether a fixture limits the rates.
    is_limited: bool,
}

impl TendonDrive {
    pub(super) fn new(is_limited: bool) -> TendonDrive {
        let state = TendonDriveState::Force([0.0; MAX_TENDONS]);
        TendonDrive { state, planner: Planner::new(), is_limited }
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

    /// Commands tensions; `now_n` are the present ones.
    pub(super) fn servo_force(&mut self, tension_n: [f64; MAX_TENDONS], now_n: [f64; MAX_TENDONS]) {
        self.state = match self.is_limited {
            true => self.limited(tension_n, now_n, true),
            false => TendonDriveState::Force(tension_n),
        };
    }

    /// Commands displacements; `now_m` are the present ones.
    pub(super) fn servo_displacement(
        &mut self,
        displacement_m: [f64; MAX_TENDONS],
        now_m: [f64; MAX_TENDONS],
    ) {
        self.state = match self.is_limited {
            true => self.limited(displacement_m, now_m, false),
            false => TendonDriveState::Displacement(displacement_m),
        };
    }

    /// Commands rates of the displacements; `now_m` are the present ones, from which tendons start that had
    /// no displacement setpoints.
    pub(super) fn servo_velocity(
        &mut self,
        m_per_s: [f64; MAX_TENDONS],
        now_m: [f64; MAX_TENDONS],
        dt_s: f64,
    ) {
        let now = self.displacement_setpoints(dt_s).map_or(now_m, |setpoints| setpoints.position);
        self.state = TendonDriveState::Velocity { rate: m_per_s, now, is_slowed: false };
    }

    /// Stops tendons that move at given rates.
    pub(super) fn end_rates(&mut self) {
        if let TendonDriveState::Velocity { rate, .. } = &mut self.state {
            *rate = [0.0; MAX_TENDONS];
        }
    }

    /// Returns the displacement setpoints with their motion; `None` if tensions are controlled.
    fn displacement_setpoints(&mut self, dt_s: f64) -> Option<AxisState<MAX_TENDONS>> {
        match self.state {
            TendonDriveState::Move { ticks, .. } => Some(self.planner.sample(ticks as f64 * dt_s)),
            TendonDriveState::Displacement(now) => Some(AxisState::at_rest(now)),
            TendonDriveState::Velocity { rate, now, .. } => {
                Some(AxisState { velocity: rate, ..AxisState::at_rest(now) })
            }
            TendonDriveState::Force(_) | TendonDriveState::Limited { .. } => None,
        }
    }

    /// Follows a goal from where the actuators are: from the setpoints of the same kind, else from the
    /// present tensions or displacements.
    fn limited(
        &self,
        goal: [f64; MAX_TENDONS],
        present: [f64; MAX_TENDONS],
        is_force: bool,
    ) -> TendonDriveState {
        let now = match self.state {
            TendonDriveState::Limited { now, is_force: was_force, .. } if was_force == is_force => now,
            TendonDriveState::Force(now) if is_force => now,
            _ => present,
        };
        TendonDriveState::Limited { goal, now, is_force }
    }

    /// Returns the setpoints that a fixture's limits apply to, and whether they are tensions; `None` if the
    /// actuators are where they should be.
    pub(super) fn is_force_under_way(&self) -> Option<bool> {
        match &self.state {
            TendonDriveState::Limited { goal, now, is_force } if goal != now => Some(*is_force),
            TendonDriveState::Velocity { .. } if self.is_limited => Some(false),
            _ => None,
        }
    }

    /// Returns whether a fixture's limits keep the actuators from where they should be.
    pub(super) fn is_slowed(&self) -> bool {
        match &self.state {
            TendonDriveState::Velocity { is_slowed, .. } => *is_slowed,
            _ => self.is_force_under_way().is_some(),
        }
    }

    /// Starts a motion from the current displacements to a goal; a repeat of the current goal has no effect.
    pub(super) fn move_to(
        &mut self,
        goal_m: [f64; MAX_TENDONS],
        now_m: [f64; MAX_TENDONS],
        dt_s: f64,
    ) -> Result<(), crate::arm::TrajectoryError> {
        if self.is_limited {
            self.servo_displacement(goal_m, now_m);
            return Ok(());
        }
        if matches!(self.state, TendonDriveState::Move { segment, .. }
            if segment.goal == Goal::Independent(goal_m))
        {
            return Ok(());
        }
        let start = self.displacement_setpoints(dt_s).unwrap_or_else(|| AxisState::at_rest(now_m));
        let segment = Segment { start, goal: Goal::Independent(goal_m), limits: LIMITS };
        self.planner.plan(&segment)?;
        self.planner.commit();
        self.state = TendonDriveState::Move { segment, ticks: 0 };
        Ok(())
    }

    /// Returns the tendon command for this tick, within the limits of a fixture.
    pub(super) fn step(&mut self, dt_s: f64, limits: &RateLimits) -> TendonCommand {
        match &mut self.state {
            TendonDriveState::Limited { goal, now, is_force } => {
                for t in 0..MAX_TENDONS {
                    let missing = goal[t] - now[t];
                    let step = missing.clamp(-limits.down[t] * dt_s, limits.up[t] * dt_s);
                    now[t] = if step == missing { goal[t] } else { now[t] + step };
                }
                match is_force {
                    true => TendonCommand::EachForce(*now),
                    false => TendonCommand::EachDisplacement(*now),
                }
            }
            TendonDriveState::Velocity { rate, now, is_slowed } => {
                *is_slowed = false;
                for t in 0..MAX_TENDONS {
                    let wanted = rate[t] * dt_s;
                    let step = wanted.clamp(-limits.down[t] * dt_s, limits.up[t] * dt_s);
                    *is_slowed |= step != wanted;
                    now[t] = (now[t] + step).clamp(-MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_M);
                }
                TendonCommand::EachDisplacement(*now)
            }
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
