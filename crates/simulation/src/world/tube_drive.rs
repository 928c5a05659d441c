//! Drive of a tool that slides out of an outer tube and rolls in it: jerk-limited motion of both axes to a
//! goal.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use scene::ToolOuterTube;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{Simulation, SimulationError};
use crate::arm::{AxisLimits, AxisState, Goal, Planner, Segment, TrajectoryError};
use crate::manipulator::{BaseMotion, ManipulatorModel, Wrench};

/// Time in which the drive reaches its speed from rest, s; its acceleration builds up in half of it. Assumed,
/// typical of a small lead screw.
const SPEED_UP_S: f64 = 0.1;

/// Why the tube drive rejected a command.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum TubeRefusal {
    /// The tool has no outer tube.
    #[error("the tool has no `outer_tube` to slide out of")]
    NoTube,
    /// The goal is beyond the travel of the drive.
    #[error("`tube_deployed_m` is {asked_m}; allowed: 0 to {travel_m} (the tool's `outer_tube.travel_mm`)")]
    BeyondTravel {
        /// Commanded goal, m.
        asked_m: f64,
        /// Travel, m.
        travel_m: f64,
    },
    /// The arm is in a protective stop because the tool pressed too hard.
    #[error("the arm is in a protective stop; send the arm `hold` to release it")]
    ProtectiveStop,
    /// The motion cannot be planned.
    #[error(transparent)]
    NoMotion(#[from] TrajectoryError),
}

/// State of the tube: deployment, m, and roll, rad.
type Tube = AxisState<2>;

/// The drive's motion as plain data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct TubeDriveState {
    segment: Segment<2>,
    /// Ticks since its start.
    ticks: u64,
    /// State after the last tick.
    at: Tube,
}

/// The drive of the tube.
pub(super) struct TubeDrive {
    state: TubeDriveState,
    planner: Planner<2>,
    travel_m: f64,
    limits: AxisLimits<2>,
}

impl TubeDrive {
    /// Creates the drive of a fully retracted tool.
    pub(super) fn new(outer: &ToolOuterTube) -> TubeDrive {
        let velocity = [outer.speed_mm_per_s * 1e-3, outer.roll_speed_deg_per_s.to_radians()];
        let acceleration = velocity.map(|speed| speed / SPEED_UP_S);
        let limits =
            AxisLimits { velocity, acceleration, jerk: acceleration.map(|a| a / (0.5 * SPEED_UP_S)) };
        let at = AxisState::at_rest([0.0; 2]);
        let segment = Segment { start: at, goal: Goal::Independent([0.0; 2]), limits };
        let mut drive = TubeDrive {
            state: TubeDriveState { segment, ticks: 0, at },
            planner: Planner::new(),
            travel_m: outer.travel_mm * 1e-3,
            limits,
        };
        drive.plan_again();
        drive
    }

    fn plan_again(&mut self) {
        // A segment that was planned before can be planned again.
        if self.planner.plan(&self.state.segment).is_ok() {
            self.planner.commit();
        }
    }

    pub(super) fn snapshot(&self) -> TubeDriveState {
        self.state
    }

    pub(super) fn restore(&mut self, state: &TubeDriveState) {
        self.state = *state;
        self.plan_again();
    }

    fn start(&mut self, goal: Goal<2>, speed_m_per_s: f64) -> Result<(), TrajectoryError> {
        let mut limits = self.limits;
        if speed_m_per_s > 0.0 {
            limits.velocity[0] = limits.velocity[0].min(speed_m_per_s);
        }
        if self.state.segment.goal == goal && self.state.segment.limits == limits {
            return Ok(());
        }
        let segment = Segment { start: self.state.at, goal, limits };
        self.planner.plan(&segment)?;
        self.planner.commit();
        (self.state.segment, self.state.ticks) = (segment, 0);
        Ok(())
    }

    /// Starts a motion from the present one to a goal; a repeat of the present goal has no effect.
    pub(super) fn move_to(
        &mut self,
        [deployed_m, roll_rad]: [f64; 2],
        speed_m_per_s: f64,
    ) -> Result<(), TubeRefusal> {
        if deployed_m > self.travel_m {
            return Err(TubeRefusal::BeyondTravel { asked_m: deployed_m, travel_m: self.travel_m });
        }
        Ok(self.start(Goal::Independent([deployed_m, roll_rad]), speed_m_per_s)?)
    }

    /// Stops as fast as the limits allow.
    pub(super) fn hold(&mut self) -> Result<(), TubeRefusal> {
        Ok(self.start(Goal::Standstill, 0.0)?)
    }

    /// Puts the tube into another state. A motion is planned again from there to its goal; a tube at rest at
    /// its goal stays where it is put.
    pub(super) fn displace(&mut self, at: &Tube) -> Result<(), TrajectoryError> {
        let mut segment = Segment { start: *at, ..self.state.segment };
        if segment.goal == Goal::Independent(self.state.at.position) {
            segment.goal = Goal::Independent(at.position);
        }
        self.planner.plan(&segment)?;
        self.planner.commit();
        self.state = TubeDriveState { segment, ticks: 0, at: *at };
        Ok(())
    }

    /// Advances by one tick.
    pub(super) fn step(&mut self, dt_s: f64) {
        self.state.ticks += 1;
        let mut at = self.planner.sample(self.state.ticks as f64 * dt_s);
        // A stop while retracting may end a rounding error beyond the fully retracted position.
        at.position[0] = at.position[0].clamp(0.0, self.travel_m);
        self.state.at = at;
    }

    /// Returns the position and velocity of the tube.
    pub(super) fn at(&self) -> &Tube {
        &self.state.at
    }

    pub(super) fn deployed_m(&self) -> f64 {
        self.state.at.position[0]
    }

    /// Returns the transform from the tool base to the tube base, which slides along +z and rolls about it.
    pub(super) fn t_base_tube(&self) -> Isometry3<f64> {
        let [deployed_m, roll_rad] = self.state.at.position;
        Isometry3::from_parts(
            Translation3::new(0.0, 0.0, deployed_m),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll_rad),
        )
    }

    /// Returns the motion of the tube base on a moving tool base.
    pub(super) fn carried(&self, base: &BaseMotion) -> BaseMotion {
        let axis = base.t_world_base.rotation * Vector3::z();
        let [deployed_m, _] = self.state.at.position;
        let [sliding_m_per_s, rolling_rad_per_s] = self.state.at.velocity;
        let turned = base.angular_velocity_rad_per_s.cross(&(axis * deployed_m));
        BaseMotion {
            t_world_base: base.t_world_base * self.t_base_tube(),
            linear_velocity_m_per_s: base.linear_velocity_m_per_s + turned + axis * sliding_m_per_s,
            angular_velocity_rad_per_s: base.angular_velocity_rad_per_s + axis * rolling_rad_per_s,
        }
    }

    /// Converts a wrench about the tube base, whose pose is `t_world_tube`, to one about the tool base.
    pub(super) fn about_base(&self, wrench: &Wrench, t_world_tube: &Isometry3<f64>) -> Wrench {
        let lever_m = t_world_tube.rotation * Vector3::new(0.0, 0.0, self.deployed_m());
        Wrench { force_n: wrench.force_n, torque_nm: wrench.torque_nm + lever_m.cross(&wrench.force_n) }
    }
}

impl Simulation<'_> {
    /// Moves the tube on the tool base, or stops it if the arm is in a protective stop. Returns the motion of
    /// the tube base.
    pub(super) fn slide_tube(&mut self, base: BaseMotion) -> Result<BaseMotion, SimulationError> {
        let is_stopped = self.arm.state().protective_stop.is_stopped();
        let Some(tube) = &mut self.tube else { return Ok(base) };
        if is_stopped {
            tube.hold()?;
        }
        tube.step(self.dt_s);
        self.manipulator.set_deployed(tube.deployed_m());
        Ok(tube.carried(&base))
    }

    /// Returns the wrench of the tool on the flange in the last step, about the tool's base.
    pub(super) fn flange_wrench(&self) -> Wrench {
        let (tool, wrench) = (&self.manipulator, self.manipulator.flange_wrench());
        self.tube.as_ref().map_or(wrench, |tube| tube.about_base(&wrench, &tool.base().t_world_base))
    }
}
