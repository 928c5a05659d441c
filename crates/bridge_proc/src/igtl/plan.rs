//! A straight plan that the arm follows: to the entry, then to the target.

use ipc_types::messages::{ArmMode, ArmStatus, BurrMode, Command, Pose, State};
use nalgebra::{UnitQuaternion, Vector3};
use ros_interface::robot::isometry;

/// Speeds of the arm and the burr along a plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Speeds {
    /// On the way to the entry.
    pub(crate) approach_m_per_s: f64,
    /// On the way to the target.
    pub(crate) feed_m_per_s: f64,
    /// Of the burr on the way to the target.
    pub(crate) burr_rad_per_s: f64,
}

/// Progress of a plan.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Stage {
    Idle,
    /// A single goal of the tool base.
    Base {
        goal: Pose,
        told: bool,
    },
    /// To the entry, with the tool's axis along the path to the target; `told` is set once a command has been
    /// sent.
    Approach {
        goal: Pose,
        target_m: Vector3<f64>,
        told: bool,
    },
    /// To the target along a fixed axis.
    Feed {
        axis: Vector3<f64>,
        depth_m: f64,
    },
    /// Burr off, arm held.
    Halt,
}

/// Computes the arm's part of a command, state by state.
#[derive(Debug)]
pub(crate) struct Follower {
    speeds: Speeds,
    stage: Stage,
}

impl Follower {
    pub(crate) fn new(speeds: Speeds) -> Follower {
        Follower { speeds, stage: Stage::Idle }
    }

    /// Moves the tool base to a pose.
    pub(crate) fn go(&mut self, goal: Pose) {
        self.stage = Stage::Base { goal, told: false };
    }

    /// Abandons the current motion and holds the arm, burr off.
    pub(crate) fn halt(&mut self) {
        self.stage = Stage::Halt;
    }

    /// Starts a plan. The tip's path to the target is straight, so the tool must be straight: this bridge
    /// does not bend the tool.
    ///
    /// # Errors
    /// Entry (or tip) and target are the same point.
    pub(crate) fn plan(
        &mut self,
        entry_m: Option<[f64; 3]>,
        target_m: [f64; 3],
        state: &State,
    ) -> Result<(), String> {
        let target_m = Vector3::from(target_m);
        let tip_m = Vector3::from(state.t_world_tip.position_m);
        let from_m = entry_m.map_or(tip_m, Vector3::from);
        let Some(axis) = (target_m - from_m).try_normalize(1e-6) else {
            return Err("Plan: the path to the target has zero length".into());
        };
        self.stage = match entry_m {
            None => Stage::Feed { axis, depth_m: (target_m - from_m).norm() },
            Some(_) => Stage::Approach { goal: base_at(state, from_m, axis), target_m, told: false },
        };
        Ok(())
    }

    /// Fills in the command for this state; leaves it unchanged if there is nothing to do.
    pub(crate) fn fill(&mut self, state: &State, command: &mut Command) {
        self.advance(state);
        match &mut self.stage {
            Stage::Idle => {}
            Stage::Base { goal, told } | Stage::Approach { goal, told, .. } => {
                command.arm_mode = ArmMode::MoveCp.code();
                command.t_world_base = *goal;
                command.arm_speed_m_per_s = self.speeds.approach_m_per_s;
                *told = true;
            }
            Stage::Feed { axis, depth_m } => {
                command.arm_mode = ArmMode::Insert.code();
                command.arm_axis = (*axis).into();
                command.arm_depth_m = *depth_m;
                command.arm_speed_m_per_s = self.speeds.feed_m_per_s;
                spin(command, self.speeds.burr_rad_per_s);
            }
            Stage::Halt => {
                command.arm_mode = ArmMode::Hold.code();
                spin(command, 0.0);
            }
        }
    }

    fn advance(&mut self, state: &State) {
        let moves = state.arm_mode() == Ok(ArmMode::MoveCp);
        let arrived = moves && state.arm_status() == Ok(ArmStatus::Done);
        let gave_up = moves && state.arm_status() == Ok(ArmStatus::Fault);
        self.stage = match self.stage {
            Stage::Base { told: true, .. } | Stage::Approach { told: true, .. } if gave_up => Stage::Halt,
            Stage::Approach { told: true, target_m, goal }
                if arrived && is_near(&state.t_world_base, &goal) =>
            {
                let way = target_m - Vector3::from(state.t_world_tip.position_m);
                match way.try_normalize(1e-6) {
                    Some(axis) => Stage::Feed { axis, depth_m: way.norm() },
                    None => Stage::Halt,
                }
            }
            stage => stage,
        };
    }
}

fn spin(command: &mut Command, burr_rad_per_s: f64) {
    command.burr_mode = BurrMode::Speed.code();
    command.burr_speed_rad_per_s = burr_rad_per_s;
}

/// Returns whether the base is at its goal: a report for an older goal does not count.
fn is_near(base: &Pose, goal: &Pose) -> bool {
    (Vector3::from(base.position_m) - Vector3::from(goal.position_m)).norm() < 1e-3
}

/// Returns the base's pose with the tip at a point and the tool's +z along an axis, turned from the current
/// pose by the smallest angle.
fn base_at(state: &State, tip_m: Vector3<f64>, axis: Vector3<f64>) -> Pose {
    let (base, tip) = (isometry(&state.t_world_base), isometry(&state.t_world_tip));
    let z = base.rotation * Vector3::z();
    // For opposite directions the axis of rotation is undetermined; use any perpendicular one.
    let turn = UnitQuaternion::rotation_between(&z, &axis).unwrap_or_else(|| {
        UnitQuaternion::from_axis_angle(&(base.rotation * Vector3::x_axis()), core::f64::consts::PI)
    });
    let rotation = turn * base.rotation;
    let t_base_tip = base.inverse() * tip;
    let position_m = tip_m - rotation * t_base_tip.translation.vector;
    let [x, y, z, w] = [rotation.i, rotation.j, rotation.k, rotation.w];
    Pose { position_m: position_m.into(), orientation_xyzw: [x, y, z, w] }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPEEDS: Speeds = Speeds { approach_m_per_s: 0.02, feed_m_per_s: 0.001, burr_rad_per_s: 200.0 };

    /// A straight tool 100 mm long along +z at the origin.
    fn state() -> Box<State> {
        let mut state = Box::new(State::zeroed());
        state.t_world_base = Pose::IDENTITY;
        state.t_world_tip = Pose { position_m: [0.0, 0.0, 0.1], ..Pose::IDENTITY };
        state
    }

    fn command(follower: &mut Follower, state: &State) -> Command {
        let mut command = Command::zeroed();
        follower.fill(state, &mut command);
        command
    }

    #[test]
    fn the_tip_goes_to_the_entry_and_then_straight_to_the_target() {
        let mut state = state();
        let mut follower = Follower::new(SPEEDS);
        assert_eq!(command(&mut follower, &state).arm_mode(), Ok(ArmMode::None));
        follower.plan(Some([0.05, 0.0, 0.2]), [0.08, 0.0, 0.2], &state).unwrap();
        let approach = command(&mut follower, &state);
        assert_eq!((approach.arm_mode(), approach.burr_mode()), (Ok(ArmMode::MoveCp), Ok(BurrMode::None)));
        let goal = isometry(&approach.t_world_base);
        let tip = goal * nalgebra::Point3::new(0.0, 0.0, 0.1);
        assert!((tip.coords - Vector3::new(0.05, 0.0, 0.2)).norm() < 1e-12, "{tip}");
        assert!((goal.rotation * Vector3::z() - Vector3::x()).norm() < 1e-12);

        (state.arm_mode, state.arm_status) = (ArmMode::MoveCp.code(), ArmStatus::Moving.code());
        assert_eq!(command(&mut follower, &state).arm_mode(), Ok(ArmMode::MoveCp));
        // "Done" of an older goal does not apply to this one.
        state.arm_status = ArmStatus::Done.code();
        assert_eq!(command(&mut follower, &state).arm_mode(), Ok(ArmMode::MoveCp));
        state.t_world_base = approach.t_world_base;
        state.t_world_tip.position_m = [0.05, 0.0, 0.2];
        let feed = command(&mut follower, &state);
        assert_eq!((feed.arm_mode(), feed.burr_speed_rad_per_s), (Ok(ArmMode::Insert), 200.0));
        assert!((feed.arm_depth_m - 0.03).abs() < 1e-12);
        assert!((Vector3::from(feed.arm_axis) - Vector3::x()).norm() < 1e-12);
    }

    #[test]
    fn a_goal_that_the_arm_gives_up_ends_with_the_burr_off() {
        let mut state = state();
        let mut follower = Follower::new(SPEEDS);
        follower.go(Pose { position_m: [9.0, 0.0, 0.0], ..Pose::IDENTITY });
        command(&mut follower, &state);
        (state.arm_mode, state.arm_status) = (ArmMode::MoveCp.code(), ArmStatus::Fault.code());
        let halt = command(&mut follower, &state);
        assert_eq!(
            (halt.arm_mode(), halt.burr_mode(), halt.burr_speed_rad_per_s),
            (Ok(ArmMode::Hold), Ok(BurrMode::Speed), 0.0)
        );
    }

    #[test]
    fn a_plan_without_length_is_refused() {
        let state = state();
        assert!(Follower::new(SPEEDS).plan(Some([0.1; 3]), [0.1; 3], &state).is_err());
    }
}
