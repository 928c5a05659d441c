//! A straight plan that the arm follows: to the entry, then to the target.

use ipc_types::messages::{ArmMode, ArmStatus, BurrMode, Command, MAX_DEPTH_M, Pose, State};
use ipc_types::scene::Drives;
use nalgebra::{UnitQuaternion, Vector3};
use ros_interface::robot::isometry;

use super::incoming::in_reach;
use crate::ras;

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

/// Computes the arm's part of a command, state by state. It commands only what its controller drives, and
/// only values in the range of commands: a command that physics refuses would end a lockstep run.
#[derive(Debug)]
pub(crate) struct Follower {
    speeds: Speeds,
    drives: Vec<Drives>,
    stage: Stage,
}

impl Follower {
    /// `drives`: what the controller drives; empty for an observer.
    pub(crate) fn new(speeds: Speeds, drives: Vec<Drives>) -> Follower {
        Follower { speeds, drives, stage: Stage::Idle }
    }

    /// Returns whether the controller drives a part of the tool.
    pub(crate) fn drives(&self, part: Drives) -> bool {
        self.drives.contains(&part)
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
    /// Entry (or tip) and target are the same point, or further apart than an insertion can be deep; the base
    /// would be out of a command's range.
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
        let length_m = (target_m - from_m).norm();
        if length_m > MAX_DEPTH_M {
            let from = if entry_m.is_some() { "entry" } else { "the tip" };
            let (length_mm, most_mm) = (1000.0 * length_m, 1000.0 * MAX_DEPTH_M);
            return Err(format!(
                "Plan: the path from {from} to the target is {length_mm:.1} mm long; allowed: up to {most_mm} mm"
            ));
        }
        self.stage = match entry_m {
            None => Stage::Feed { axis, depth_m: length_m },
            Some(_) => {
                let goal = base_at(state, from_m, axis);
                in_reach("Plan: base", ras::position_mm(goal.position_m))?;
                Stage::Approach { goal, target_m, told: false }
            }
        };
        Ok(())
    }

    /// Fills in the command for this state; leaves it unchanged if there is nothing to do. Returns whether
    /// the arm abandons its goal with this state.
    pub(crate) fn fill(&mut self, state: &State, command: &mut Command) -> bool {
        let gives_up = self.advance(state);
        match &mut self.stage {
            Stage::Idle => {}
            Stage::Base { goal, told } | Stage::Approach { goal, told, .. } => {
                command.arm_mode = ArmMode::MoveCp.code();
                command.t_world_base = *goal;
                command.arm_speed_m_per_s = self.speeds.approach_m_per_s;
                *told = true;
            }
            &mut Stage::Feed { axis, depth_m } => {
                command.arm_mode = ArmMode::Insert.code();
                command.arm_axis = axis.into();
                command.arm_depth_m = depth_m;
                command.arm_speed_m_per_s = self.speeds.feed_m_per_s;
                self.spin(command, self.speeds.burr_rad_per_s);
            }
            Stage::Halt => {
                if self.drives(Drives::Arm) {
                    command.arm_mode = ArmMode::Hold.code();
                }
                self.spin(command, 0.0);
            }
        }
        gives_up
    }

    fn spin(&self, command: &mut Command, burr_rad_per_s: f64) {
        if self.drives(Drives::Burr) {
            command.burr_mode = BurrMode::Speed.code();
            command.burr_speed_rad_per_s = burr_rad_per_s;
        }
    }

    fn advance(&mut self, state: &State) -> bool {
        let moves = state.arm_mode() == Ok(ArmMode::MoveCp);
        let arrived = moves && state.arm_status() == Ok(ArmStatus::Done);
        let has_goal =
            matches!(self.stage, Stage::Base { told: true, .. } | Stage::Approach { told: true, .. });
        let gives_up = has_goal && moves && state.arm_status() == Ok(ArmStatus::Fault);
        self.stage = match self.stage {
            _ if gives_up => Stage::Halt,
            Stage::Approach { told: true, target_m, goal }
                if arrived && is_near(&state.t_world_base, &goal) =>
            {
                let way = target_m - Vector3::from(state.t_world_tip.position_m);
                match way.try_normalize(1e-6) {
                    // The tip is at the entry only nearly, so the path may be a little longer than planned.
                    Some(axis) => Stage::Feed { axis, depth_m: way.norm().min(MAX_DEPTH_M) },
                    None => Stage::Halt,
                }
            }
            stage => stage,
        };
        gives_up
    }
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

    fn follower() -> Follower {
        Follower::new(SPEEDS, vec![Drives::Arm, Drives::Burr])
    }

    fn command(follower: &mut Follower, state: &State) -> Command {
        let mut command = Command::zeroed();
        follower.fill(state, &mut command);
        command
    }

    #[test]
    fn the_tip_goes_to_the_entry_and_then_straight_to_the_target() {
        let mut state = state();
        let mut follower = follower();
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
        let mut follower = follower();
        follower.go(Pose { position_m: [9.0, 0.0, 0.0], ..Pose::IDENTITY });
        assert!(!follower.fill(&state, &mut Command::zeroed()));
        (state.arm_mode, state.arm_status) = (ArmMode::MoveCp.code(), ArmStatus::Fault.code());
        let mut halt = Command::zeroed();
        assert!(follower.fill(&state, &mut halt) && !follower.fill(&state, &mut Command::zeroed()));
        assert_eq!(
            (halt.arm_mode(), halt.burr_mode(), halt.burr_speed_rad_per_s),
            (Ok(ArmMode::Hold), Ok(BurrMode::Speed), 0.0)
        );
    }

    #[test]
    fn a_plan_without_length_is_refused() {
        let state = state();
        assert!(follower().plan(Some([0.1; 3]), [0.1; 3], &state).is_err());
    }

    /// Regression: a target 1 m away was accepted, and physics refused the depth at every tick.
    #[test]
    fn a_plan_deeper_than_an_insertion_can_be_is_refused_and_changes_nothing() {
        let state = state();
        for entry_m in [None, Some([0.0, 0.0, 0.1])] {
            let mut follower = follower();
            let why = follower.plan(entry_m, [0.0, 0.0, 1.1], &state).unwrap_err();
            assert!(why.contains("1000.0 mm long; allowed: up to 500 mm"), "{why}");
            assert_eq!(command(&mut follower, &state).arm_mode(), Ok(ArmMode::None));
            follower.plan(entry_m, [0.0, 0.0, 0.6], &state).unwrap();
        }
    }

    /// Regression: with an entry in range and a base beyond it, physics refused the goal at every tick.
    #[test]
    fn a_plan_whose_base_is_out_of_range_is_refused_and_changes_nothing() {
        let mut follower = follower();
        let why = follower.plan(Some([0.0, 0.0, -9.95]), [0.0, 0.0, -9.9], &state()).unwrap_err();
        assert!(why.starts_with("Plan: base: a coordinate is -1.005"), "{why}");
        assert_eq!(command(&mut follower, &state()).arm_mode(), Ok(ArmMode::None));
    }

    /// Regression: physics refused commands for a burr that the scene assigns to another controller.
    #[test]
    fn only_what_the_controller_drives_is_commanded() {
        let state = state();
        let mut arm = Follower::new(SPEEDS, vec![Drives::Arm]);
        arm.plan(None, [0.0, 0.0, 0.2], &state).unwrap();
        let feed = command(&mut arm, &state);
        assert_eq!((feed.arm_mode(), feed.burr_mode()), (Ok(ArmMode::Insert), Ok(BurrMode::None)));
        let mut burr = Follower::new(SPEEDS, vec![Drives::Burr]);
        burr.halt();
        let halt = command(&mut burr, &state);
        assert_eq!((halt.arm_mode(), halt.burr_mode()), (Ok(ArmMode::None), Ok(BurrMode::Speed)));
    }
}
