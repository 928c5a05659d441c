//! Turns the requests so far into the command that answers each state.

use messages::{ArmMode, BurrMode, Command, MAX_ARM_JOINTS, MAX_TENDONS, Pose, TendonMode, TubeMode};

use crate::trajectory::Trajectory;

/// How long a velocity holds without being repeated, s: a program or network that has failed must not move
/// joints, tendons or burr forever.
pub const VELOCITY_HOLDS_S: f64 = 0.5;

/// CRTK's operating states (Collaborative Robotics Toolkit, "Operating state").
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OperatingState {
    /// Motion commands are rejected until `enable`.
    Disabled,
    /// Motion commands are executed.
    Enabled,
    /// The run is paused.
    Paused,
    /// The arm abandoned a motion; the next motion command, or `enable`, clears this.
    Fault,
}

impl OperatingState {
    /// The state's name in CRTK.
    pub fn word(self) -> &'static str {
        match self {
            OperatingState::Disabled => "DISABLED",
            OperatingState::Enabled => "ENABLED",
            OperatingState::Paused => "PAUSED",
            OperatingState::Fault => "FAULT",
        }
    }
}

/// A checked request for motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// `servo_jp` of the arm.
    ArmServoJp([f64; MAX_ARM_JOINTS]),
    /// `servo_jv` of the arm.
    ArmServoJv([f64; MAX_ARM_JOINTS]),
    /// `move_jp` of the arm.
    ArmMoveJp([f64; MAX_ARM_JOINTS]),
    /// `servo_cp` of the arm.
    ArmServoCp(Pose),
    /// `move_cp` of the arm.
    ArmMoveCp(Pose),
    /// `servo_jf` of the tendons.
    TendonServoJf([f64; MAX_TENDONS]),
    /// `servo_jp` of the tendons.
    TendonServoJp([f64; MAX_TENDONS]),
    /// `move_jp` of the tendons.
    TendonMoveJp([f64; MAX_TENDONS]),
    /// `servo_jv` of the tendons.
    TendonServoJv([f64; MAX_TENDONS]),
    /// `servo_jv` of the burr.
    BurrServoJv(f64),
    /// `move_jp` of the tube: deployed length, m, and roll, rad.
    TubeMoveJp([f64; 2]),
}

/// The newest request for each part, repeated in every command, so that a command that was late, and replaced
/// by the safe one, takes effect again.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Commander {
    arm: Option<Arm>,
    /// The motion, and until when it holds if it is a rate.
    tendon: Option<(Motion, f64)>,
    burr: Option<(f64, f64)>,
    tube: Option<Tube>,
    disabled: bool,
}

#[derive(Debug, Clone, PartialEq)]
enum Arm {
    Hold,
    Goes(Motion),
    /// Until this time.
    Turns(Motion, f64),
    /// From these joint angles, at this time.
    Follows(Trajectory, [f64; MAX_ARM_JOINTS], f64),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Tube {
    Hold,
    Goes([f64; 2]),
}

impl Commander {
    /// Returns whether `disable` was the last state command.
    pub fn is_disabled(&self) -> bool {
        self.disabled
    }

    /// Accepts a request at a time (any monotonic clock, s).
    pub fn take(&mut self, motion: Motion, now_s: f64) {
        match motion {
            Motion::ArmServoJv(_) => self.arm = Some(Arm::Turns(motion, now_s + VELOCITY_HOLDS_S)),
            Motion::ArmServoJp(_) | Motion::ArmMoveJp(_) | Motion::ArmServoCp(_) | Motion::ArmMoveCp(_) => {
                self.arm = Some(Arm::Goes(motion))
            }
            Motion::TendonServoJf(_) | Motion::TendonServoJp(_) | Motion::TendonMoveJp(_) => {
                self.tendon = Some((motion, f64::INFINITY));
            }
            Motion::TendonServoJv(_) => self.tendon = Some((motion, now_s + VELOCITY_HOLDS_S)),
            Motion::BurrServoJv(speed) => self.burr = Some((speed, now_s + VELOCITY_HOLDS_S)),
            Motion::TubeMoveJp(goal) => self.tube = Some(Tube::Goes(goal)),
        }
    }

    /// Accepts a trajectory of the arm at a simulated time, from the present joint angles of its drives.
    pub fn follow(&mut self, trajectory: Trajectory, start_rad: [f64; MAX_ARM_JOINTS], sim_time_s: f64) {
        self.arm = Some(Arm::Follows(trajectory, start_rad, sim_time_s));
    }

    /// Stops all motion: arm, tube, burr and tendon rates stop, the tension stays. Parts that have never been
    /// moved are left alone.
    pub fn release(&mut self) {
        if self.arm.is_some() {
            self.arm = Some(Arm::Hold);
        }
        if self.tube.is_some() {
            self.tube = Some(Tube::Hold);
        }
        if let Some((Motion::TendonServoJv(rates), _)) = &mut self.tendon {
            *rates = [0.0; MAX_TENDONS];
        }
        if let Some((speed, _)) = &mut self.burr {
            *speed = 0.0;
        }
    }

    /// Forgets all motion, for a reset: no part is driven until it is moved again.
    pub fn forget(&mut self) {
        *self = Commander { disabled: self.disabled, ..Commander::default() };
    }

    /// `disable`: like [`Commander::release`], and nothing moves until [`Commander::enable`].
    pub fn disable(&mut self) {
        self.release();
        self.disabled = true;
    }

    /// `enable`: motion commands are executed again; an arm that abandoned a motion holds still, and its
    /// fault is cleared. `drives_arm`: whether this controller drives the arm.
    pub fn enable(&mut self, drives_arm: bool) {
        self.disabled = false;
        if drives_arm {
            self.arm = Some(Arm::Hold);
        }
    }

    /// Fills in the command that answers a state at a time (on the clock of [`Commander::take`]). Returns
    /// which velocities have just timed out.
    pub fn fill(&mut self, now_s: f64, sim_time_s: f64, command: &mut Command) -> Option<&'static str> {
        let mut ran_out = None;
        if let Some(Arm::Turns(_, until_s)) = self.arm
            && now_s > until_s
        {
            self.arm = Some(Arm::Hold);
            ran_out = Some("servo_jv of the arm");
        }
        if let Some((Motion::TendonServoJv(rates), until_s)) = &mut self.tendon
            && now_s > *until_s
            && rates.iter().any(|rate| *rate != 0.0)
        {
            *rates = [0.0; MAX_TENDONS];
            ran_out = Some("servo_jv of the tendons");
        }
        if let Some((speed, until_s)) = &mut self.burr
            && now_s > *until_s
            && *speed != 0.0
        {
            *speed = 0.0;
            ran_out = Some("servo_jv of the burr");
        }
        match &self.arm {
            None => {}
            Some(Arm::Hold) => command.arm_mode = ArmMode::Hold.code(),
            Some(Arm::Goes(motion) | Arm::Turns(motion, _)) => motion.put_in(command),
            Some(Arm::Follows(trajectory, start_rad, begun_s)) => {
                let joints_rad = trajectory.at(start_rad, sim_time_s - begun_s);
                Motion::ArmServoJp(joints_rad).put_in(command);
            }
        }
        self.tendon.iter().for_each(|(motion, _)| motion.put_in(command));
        if let Some((speed, _)) = self.burr {
            command.burr_mode = BurrMode::Speed.code();
            command.burr_speed_rad_per_s = speed;
        }
        match self.tube {
            None => {}
            Some(Tube::Hold) => command.tube_mode = TubeMode::Hold.code(),
            Some(Tube::Goes(goal)) => {
                command.tube_mode = TubeMode::MoveJp.code();
                [command.tube_deployed_m, command.tube_roll_rad] = goal;
            }
        }
        ran_out
    }
}

impl Motion {
    /// Writes the motion of the arm or the tendons into a command.
    fn put_in(self, command: &mut Command) {
        match self {
            Motion::ArmServoJp(joints) | Motion::ArmMoveJp(joints) => command.arm_joint_position_rad = joints,
            Motion::ArmServoJv(rates) => command.arm_joint_velocity_rad_per_s = rates,
            Motion::ArmServoCp(pose) | Motion::ArmMoveCp(pose) => command.t_world_base = pose,
            Motion::TendonServoJf(forces) => command.tendon_force_n = forces,
            Motion::TendonServoJp(goal) | Motion::TendonMoveJp(goal) => command.tendon_displacement_m = goal,
            Motion::TendonServoJv(rates) => command.tendon_velocity_m_per_s = rates,
            Motion::BurrServoJv(_) | Motion::TubeMoveJp(_) => {}
        }
        match self {
            Motion::ArmServoJp(_) => command.arm_mode = ArmMode::ServoJp.code(),
            Motion::ArmServoJv(_) => command.arm_mode = ArmMode::ServoJv.code(),
            Motion::ArmMoveJp(_) => command.arm_mode = ArmMode::MoveJp.code(),
            Motion::ArmServoCp(_) => command.arm_mode = ArmMode::ServoCp.code(),
            Motion::ArmMoveCp(_) => command.arm_mode = ArmMode::MoveCp.code(),
            Motion::TendonServoJf(_) => command.tendon_mode = TendonMode::ServoJf.code(),
            Motion::TendonServoJp(_) => command.tendon_mode = TendonMode::ServoJp.code(),
            Motion::TendonMoveJp(_) => command.tendon_mode = TendonMode::MoveJp.code(),
            Motion::TendonServoJv(_) => command.tendon_mode = TendonMode::ServoJv.code(),
            Motion::BurrServoJv(_) | Motion::TubeMoveJp(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use zerocopy::FromZeros;

    use super::*;
    use crate::trajectory::Waypoint;

    fn filled(commander: &mut Commander, now_s: f64) -> Command {
        let mut command = Command::new_zeroed();
        commander.fill(now_s, now_s, &mut command);
        command
    }

    #[test]
    fn nothing_is_driven_before_something_is_asked() {
        let command = filled(&mut Commander::default(), 0.0);
        assert_eq!((command.arm_mode, command.tendon_mode, command.burr_mode), (0, 0, 0));
        let mut released = Commander::default();
        released.release();
        assert_eq!(filled(&mut released, 0.0).arm_mode, 0);
    }

    #[test]
    fn a_velocity_runs_out_and_a_position_stays() {
        let mut commander = Commander::default();
        commander.take(Motion::ArmServoJv([0.1; 7]), 10.0);
        commander.take(Motion::BurrServoJv(800.0), 10.0);
        commander.take(Motion::TendonServoJf([5.0, 0.0, 0.0, 0.0]), 10.0);
        let before = filled(&mut commander, 10.4);
        assert_eq!((before.arm_mode(), before.burr_speed_rad_per_s), (Ok(ArmMode::ServoJv), 800.0));
        let after = filled(&mut commander, 10.6);
        assert_eq!((after.arm_mode(), after.burr_speed_rad_per_s), (Ok(ArmMode::Hold), 0.0));
        assert_eq!(after.burr_mode(), Ok(BurrMode::Speed));
        assert_eq!(after.tendon_force_n[0], 5.0);
        commander.take(Motion::ArmServoJp([0.2; 7]), 11.0);
        assert_eq!(filled(&mut commander, 1e6).arm_mode(), Ok(ArmMode::ServoJp));
    }

    #[test]
    fn a_trajectory_is_followed_held_at_its_end_and_replaced_by_the_next_motion() {
        let mut commander = Commander::default();
        let points = vec![Waypoint { time_s: 2.0, joints_rad: [1.0; MAX_ARM_JOINTS] }];
        commander.follow(Trajectory::new(points).unwrap(), [0.0; MAX_ARM_JOINTS], 10.0);
        for (now_s, expected) in [(10.0, 0.0), (11.0, 0.5), (12.0, 1.0), (1e6, 1.0)] {
            let command = filled(&mut commander, now_s);
            assert_eq!(
                (command.arm_mode(), command.arm_joint_position_rad[3]),
                (Ok(ArmMode::ServoJp), expected)
            );
        }
        commander.release();
        assert_eq!(filled(&mut commander, 13.0).arm_mode(), Ok(ArmMode::Hold));
    }

    #[test]
    fn tendon_rates_run_out_after_half_a_second_and_end_with_their_publisher() {
        let mut commander = Commander::default();
        let rates = [2e-3, -1e-3, 0.0, 0.0];
        commander.take(Motion::TendonServoJv(rates), 10.0);
        let before = filled(&mut commander, 10.4);
        assert_eq!((before.tendon_mode(), before.tendon_velocity_m_per_s), (Ok(TendonMode::ServoJv), rates));
        let mut after = Command::new_zeroed();
        assert_eq!(commander.fill(10.6, 10.6, &mut after), Some("servo_jv of the tendons"));
        assert_eq!((after.tendon_mode(), after.tendon_velocity_m_per_s), (Ok(TendonMode::ServoJv), [0.0; 4]));
        assert_eq!(commander.fill(10.7, 10.7, &mut after), None, "reported once");
        commander.take(Motion::TendonServoJv(rates), 11.0);
        let mut forgotten = commander.clone();
        forgotten.forget();
        assert_eq!(filled(&mut forgotten, 11.1).tendon_mode, 0);
        commander.release();
        assert_eq!(filled(&mut commander, 11.1).tendon_velocity_m_per_s, [0.0; 4]);
        commander.take(Motion::TendonServoJf([5.0; 4]), 11.2);
        assert_eq!(filled(&mut commander, 1e6).tendon_force_n, [5.0; 4]);
    }

    #[test]
    fn who_is_gone_leaves_a_standing_arm_and_tube_a_standing_burr_and_the_tension() {
        let mut commander = Commander::default();
        commander.take(Motion::ArmMoveJp([0.1; 7]), 0.0);
        commander.take(Motion::BurrServoJv(800.0), 0.0);
        commander.take(Motion::TendonServoJf([5.0; 4]), 0.0);
        commander.take(Motion::TubeMoveJp([0.02, -0.5]), 0.0);
        let command = filled(&mut commander, 0.1);
        assert_eq!((command.tube_deployed_m, command.tube_roll_rad), (0.02, -0.5));
        assert_eq!(command.tube_mode(), Ok(TubeMode::MoveJp));
        commander.release();
        let command = filled(&mut commander, 0.1);
        assert_eq!(command.tube_mode(), Ok(TubeMode::Hold));
        assert_eq!((command.arm_mode(), command.burr_speed_rad_per_s), (Ok(ArmMode::Hold), 0.0));
        assert_eq!(command.tendon_mode(), Ok(TendonMode::ServoJf));
    }
}
