//! Commands of every kind at any tick: the arm's limits hold, it opens no socket, and a snapshot continues
//! bit for bit.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use crate::common::arm::{
    DT_S, Uniform, UsedLimits, about_pivot, finish_looking, guided_arm, run, seven_joint_arm,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use simulation::arm::{Arm, ArmCommand, ArmMode, ArmState};

/// A command of any kind; half of them are near the present pose, so that many are accepted.
fn any_command(uniform: &mut Uniform, arm: &Arm) -> ArmCommand {
    let state = arm.state();
    let reach = if uniform.between(0.0, 1.0) < 0.5 { 0.3 } else { 3.0 };
    let (limits, joints) = (arm.parameters().joint_limits, arm.parameters().geometry.joints());
    let mut q_rad = state.q_rad;
    for (i, q_rad) in q_rad[..joints].iter_mut().enumerate() {
        *q_rad = (*q_rad + uniform.between(-reach, reach)).clamp(limits.lower_rad[i], limits.upper_rad[i]);
    }
    let speed_fraction = uniform.between(0.05, 1.0);
    let shift = Translation3::from(uniform.vector(0.08));
    let turn = UnitQuaternion::from_scaled_axis(uniform.vector(0.3));
    let pose = state.t_world_tool * Isometry3::from_parts(shift, turn);
    let along = state.t_world_tool.rotation * Vector3::z();
    match uniform.between(0.0, 9.0) as usize {
        0 => ArmCommand::Hold,
        1 => ArmCommand::ServoJp { q_rad, speed_fraction },
        2 => ArmCommand::MoveJp { q_rad, speed_fraction },
        3 | 4 => {
            let mut qd_rad_s = limits.velocity_rad_s;
            qd_rad_s[joints..].fill(0.0);
            qd_rad_s[..joints].iter_mut().for_each(|rate| *rate *= uniform.between(-1.0, 1.0));
            ArmCommand::ServoJv { qd_rad_s }
        }
        5 => ArmCommand::ServoCp { t_world_tool: pose, speed_fraction },
        6 => ArmCommand::MoveCp {
            t_world_tool: pose,
            max_speed_m_s: Some(uniform.between(1e-3, 0.1)),
            max_angular_speed_rad_s: None,
        },
        7 => ArmCommand::Insert {
            axis_world: along,
            depth_m: uniform.between(-0.05, 0.05),
            feed_m_s: uniform.between(1e-3, 0.1),
        },
        _ => {
            let pivot_world_m = state.t_world_tool.translation.vector + along * 0.05;
            let goal = about_pivot(&state.t_world_tool, &pivot_world_m, uniform.vector(0.3), 0.04);
            ArmCommand::Rcm { t_world_tool: goal, pivot_world_m, max_speed_m_s: None }
        }
    }
}

/// Largest fractions of the tool base's limits used on its paths: speed, acceleration, jerk; angular rate and
/// acceleration.
#[derive(Default, Debug)]
struct UsedByTool {
    /// The arm follows a path, and first came to rest if it was in joint motion.
    on_path: bool,
    shares: [f64; 5],
    ticks: usize,
}

impl UsedByTool {
    /// Records an accepted command.
    fn command(&mut self, state: &ArmState, was_at_rest: bool) {
        let path = matches!(state.mode, ArmMode::MoveCp | ArmMode::Insert | ArmMode::Rcm);
        self.on_path = path && (was_at_rest || self.on_path);
    }

    fn add(&mut self, arm: &Arm, before: &ArmState) {
        let (limits, state) = (&arm.parameters().cartesian_limits, arm.state());
        // An aborted motion stops in joint space.
        self.on_path &= state.fault.is_none();
        if !self.on_path {
            return;
        }
        let jerk = (state.linear_acceleration_m_s2 - before.linear_acceleration_m_s2) / DT_S;
        let shares = [
            state.linear_velocity_m_s.norm() / limits.speed_m_s,
            state.linear_acceleration_m_s2.norm() / limits.acceleration_m_s2,
            jerk.norm() / limits.jerk_m_s3,
            state.angular_velocity_rad_s.norm() / limits.angular_speed_rad_s,
            state.angular_acceleration_rad_s2.norm() / limits.angular_acceleration_rad_s2,
        ];
        self.shares.iter_mut().zip(shares).for_each(|(most, share)| *most = most.max(share));
        self.ticks += 1;
    }
}

#[test]
fn ten_thousand_accepted_targets_of_every_kind_at_any_tick_exceed_no_limit() {
    let refused = try_targets(guided_arm, 10_000);
    println!("six joints: {refused} refused");
}

#[test]
fn three_thousand_accepted_targets_of_seven_joints_exceed_no_limit() {
    let refused = try_targets(|| seven_joint_arm(""), 3_000);
    println!("seven joints: {refused} refused");
}

/// Sends targets to an arm until `targets` are accepted; returns the number refused.
fn try_targets(start: impl Fn() -> Arm, targets: usize) -> usize {
    let mut uniform = Uniform(22);
    let mut used = UsedLimits::default();
    let mut tool = UsedByTool::default();
    let mut accepted = [0usize; 8];
    let mut refused = 0;
    let mut arm = start();
    for count in 0.. {
        if accepted.iter().sum::<usize>() == targets {
            break;
        }
        // If the arm has reached a corner where most targets are refused, another one takes over.
        if count % 500 == 0 {
            arm = start();
            tool.on_path = false;
        }
        let mut command = any_command(&mut uniform, &arm);
        if matches!(command, ArmCommand::Rcm { .. }) {
            // An arm in motion would first stop with its axis off the pivot.
            arm.command(ArmCommand::Hold).unwrap();
            finish_looking(&mut arm, |_| ());
            command = std::iter::repeat_with(|| any_command(&mut uniform, &arm))
                .find(|command| matches!(command, ArmCommand::Rcm { .. }))
                .unwrap();
        }
        let at_rest = arm.state().qd_rad_s.iter().all(|rate| rate.abs() < 1e-12);
        match arm.command(command) {
            Ok(()) => {
                accepted[arm.state().mode as usize] += 1;
                tool.command(arm.state(), at_rest);
            }
            Err(_) => refused += 1,
        }
        for _ in 0..(uniform.between(1.0, 20.0) as usize) {
            let before = *arm.state();
            arm.step();
            used.add(&arm, &before);
            tool.add(&arm, &before);
        }
    }
    println!("accepted by mode {accepted:?}, refused {refused}; used {used:?}; on paths {tool:?}");
    used.check(1e-8);
    // Ruckig's own tolerance, as above, and the rounding of 1 ms steps.
    assert!(tool.ticks > targets / 2 && tool.shares.iter().all(|share| *share <= 1.0 + 1e-4), "{tool:?}");
    assert!(accepted.iter().all(|count| *count > targets / 100), "every kind is tried");
    refused
}

/// Ruckig's crate includes a cloud client for waypoints. No command makes this process open a socket.
#[test]
#[cfg(target_os = "linux")]
fn motion_of_every_kind_opens_no_socket() {
    let sockets = || {
        let links = std::fs::read_dir("/proc/self/fd").unwrap();
        let targets = links.filter_map(|link| std::fs::read_link(link.unwrap().path()).ok());
        targets.filter(|target| target.to_string_lossy().starts_with("socket:")).count()
    };
    let before = sockets();
    let mut uniform = Uniform(23);
    let mut arm = guided_arm();
    for _ in 0..500 {
        let command = any_command(&mut uniform, &arm);
        let _ = arm.command(command);
        for _ in 0..5 {
            arm.step();
        }
        assert_eq!(sockets(), before);
    }
}

/// A snapshot amid rates, an insertion and a pivot continues bit for bit.
#[test]
fn a_restored_arm_continues_its_guided_motion_bit_for_bit() {
    let mut uniform = Uniform(24);
    let (mut original, mut copy) = (guided_arm(), guided_arm());
    for _ in 0..150 {
        let command = any_command(&mut uniform, &original);
        let _ = original.command(command);
        run(&mut original, uniform.between(1.0, 60.0) as usize);
        let _ = copy.command(any_command(&mut uniform, &copy));
        copy.step();
        copy.restore(&original.snapshot()).unwrap();
        for tick in 0..40 {
            if tick == 20 {
                let command = any_command(&mut uniform, &original);
                assert_eq!(original.command(command), copy.command(command));
            }
            assert_eq!(original.step(), copy.step());
            assert_eq!(original.snapshot(), copy.snapshot());
        }
    }
}
