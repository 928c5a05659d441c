//! Jerk-limited motion of the arm: limits, straight lines, refusals, snapshots.

use crate::common::arm::{DT_S, Uniform, UsedLimits, arm, finish, move_cp, moved, rest_to_rest_s};
use nalgebra::Vector3;
use simulation::arm::{
    Arm, ArmCommand, ArmError, ArmMode, ArmParameters, ArmState, AxisLimits, AxisState, Goal, Joints,
    Planner, Segment, six_joints,
};
use std::f64::consts::TAU;

#[test]
fn ruckig_takes_the_closed_form_time_from_rest_to_rest() {
    let mut uniform = Uniform(4);
    let mut planner = Planner::<1>::new();
    let mut worst: f64 = 0.0;
    for _ in 0..5_000 {
        let distance = 10f64.powf(uniform.between(-3.0, 1.0));
        let [v, a, j] = [-1.0, 0.0, 1.0].map(|low| 10f64.powf(uniform.between(low, low + 1.5)));
        let limits = AxisLimits { velocity: [v], acceleration: [a], jerk: [j] };
        let segment =
            Segment { start: AxisState::at_rest([0.2]), goal: Goal::Independent([0.2 + distance]), limits };
        let duration_s = planner.plan(&segment).unwrap();
        worst = worst.max((duration_s / rest_to_rest_s(distance, v, a, j) - 1.0).abs());
    }
    println!("Ruckig's duration against the closed form: worst relative difference {worst:.1e}");
    // Ruckig accepts an error of 1e-8 in the end position; for the smallest distance, 1e-3, the cube root
    // amounts to 3e-6, rarely reached.
    assert!(worst < 3e-6);
}

#[test]
fn joint_moves_keep_their_limits_end_exactly_and_in_proportion() {
    let mut uniform = Uniform(5);
    let mut used = UsedLimits::default();
    for _ in 0..40 {
        let mut arm = arm();
        let start = arm.state().q_rad;
        let goal: Joints =
            six_joints(std::array::from_fn(|i| uniform.between(-1.0, 1.0) * if i == 2 { 3.1 } else { 6.2 }));
        let speed_fraction = uniform.between(0.2, 1.0);
        arm.command(ArmCommand::MoveJp { q_rad: goal, speed_fraction }).unwrap();
        for _ in 0..300 {
            let before = *arm.state();
            let state = *arm.step();
            used.add(&arm, &before);
            let share = (state.q_rad[0] - start[0]) / (goal[0] - start[0]);
            for i in 0..6 {
                let expected = start[i] + share * (goal[i] - start[i]);
                assert!((state.q_rad[i] - expected).abs() < 1e-9, "joints move in proportion");
                assert!(state.qd_rad_s[i].abs() <= speed_fraction * std::f64::consts::PI * (1.0 + 1e-9));
            }
        }
        finish(&mut arm, &mut used);
        assert_eq!(arm.state().q_rad, goal);
        assert_eq!(arm.state().qd_rad_s, Joints::default());
        assert_eq!(arm.state().mode, ArmMode::MoveJp);
    }
    println!("move_jp uses {used:?} of the limits");
    used.check(1e-9);
}

/// A target that jumps randomly, also at the joint limits, at random ticks, with holds and speed changes.
#[test]
fn a_hostile_servo_never_leaves_the_limits() {
    let mut uniform = Uniform(6);
    let mut arm = arm();
    let mut used = UsedLimits::default();
    for tick in 0..100_000 {
        if uniform.between(0.0, 1.0) < if tick < 50_000 { 0.05 } else { 0.001 } {
            let q_rad = six_joints(std::array::from_fn(|i| {
                let range = if i == 2 { TAU / 2.0 } else { TAU };
                let any = uniform.between(-1.3, 1.3).clamp(-1.0, 1.0) * range;
                let near = (arm.state().q_rad[i] + uniform.between(-0.2, 0.2)).clamp(-range, range);
                if uniform.between(0.0, 1.0) < 0.5 { any } else { near }
            }));
            let speed_fraction = uniform.between(0.05, 1.0);
            let choice = uniform.between(0.0, 1.0);
            let command = if choice < 0.1 {
                ArmCommand::Hold
            } else if choice < 0.3 {
                ArmCommand::MoveJp { q_rad, speed_fraction }
            } else {
                ArmCommand::ServoJp { q_rad, speed_fraction }
            };
            arm.command(command).unwrap();
        }
        let before = *arm.state();
        arm.step();
        used.add(&arm, &before);
    }
    println!("hostile servo uses {used:?} of the limits");
    used.check(1e-9);
}

#[test]
fn a_servo_follows_a_slow_sine_closely() {
    let mut arm = arm();
    let start = arm.state().q_rad;
    let mut worst: f64 = 0.0;
    for tick in 0..4_000 {
        let wave = 0.2 * (1.0 - (tick as f64 * DT_S * TAU * 0.5).cos());
        let q_rad = six_joints(std::array::from_fn(|i| start[i] + wave));
        arm.command(ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 }).unwrap();
        arm.step();
        worst = worst.max((arm.state().q_rad[0] - q_rad[0]).abs());
    }
    // The target has no velocity, and each plan can stop at it: the lag is the stopping distance, 0.11 s at
    // 0.63 rad/s and 5 rad/s².
    println!("servo_jp behind a 0.5 Hz, 0.2 rad sine by at most {worst:.3} rad");
    assert!(worst < 0.12);
}

#[test]
fn servo_cp_reaches_its_pose() {
    let mut uniform = Uniform(8);
    let mut arm = arm();
    let home = arm.state().t_world_tool;
    for _ in 0..20 {
        let goal = moved(&home, uniform.vector(0.1), uniform.vector(0.4));
        let mut used = UsedLimits::default();
        arm.command(ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 0.8 }).unwrap();
        finish(&mut arm, &mut used);
        used.check(1e-9);
        let end = arm.state().t_world_tool;
        assert!((end.translation.vector - goal.translation.vector).norm() < 1e-12);
        assert!(end.rotation.rotation_to(&goal.rotation).vector().norm() < 1e-12);
    }
}

#[test]
fn refused_commands_leave_the_motion_as_it_was() {
    let (mut arm, mut undisturbed) = (arm(), arm());
    let goal = moved(&arm.state().t_world_tool, Vector3::new(0.02, 0.03, 0.06), Vector3::new(0.1, 0.0, 0.2));
    let q_goal = six_joints(std::array::from_fn(|i| arm.state().q_rad[i] - 0.4));
    let mut not_a_pose = goal;
    not_a_pose.translation.x = f64::NAN;
    let nan_q = six_joints([f64::NAN; 6]);
    let mut wide_q = arm.state().q_rad;
    wide_q[2] = 3.2;
    let beyond = moved(&goal, Vector3::new(0.0, 0.0, 5.0), Vector3::zeros());
    let speed_fraction = 1.0;
    let refused = [
        ArmCommand::ServoJp { q_rad: nan_q, speed_fraction },
        ArmCommand::MoveJp { q_rad: wide_q, speed_fraction },
        ArmCommand::MoveJp { q_rad: q_goal, speed_fraction: 1.5 },
        ArmCommand::MoveJp { q_rad: q_goal, speed_fraction: f64::NAN },
        ArmCommand::ServoCp { t_world_tool: not_a_pose, speed_fraction },
        ArmCommand::ServoCp { t_world_tool: beyond, speed_fraction },
        ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 0.0 },
        move_cp(not_a_pose),
        move_cp(beyond),
        ArmCommand::MoveCp { t_world_tool: goal, max_speed_m_s: Some(9.0), max_angular_speed_rad_s: None },
    ];
    for start in [move_cp(goal), ArmCommand::MoveJp { q_rad: q_goal, speed_fraction }] {
        arm.command(start).unwrap();
        undisturbed.command(start).unwrap();
        for tick in 0..400 {
            let error = arm.command(refused[tick % refused.len()]);
            assert!(error.is_err(), "{tick}");
            assert_eq!(arm.step(), undisturbed.step());
        }
    }
    let outside = arm.command(ArmCommand::MoveJp { q_rad: wide_q, speed_fraction });
    assert!(matches!(outside, Err(ArmError::JointOutsideLimits { joint: 3, .. })));
    // 5 m away: the line is refused where it leaves the reach, or just before, where the arm is stretched.
    let error = arm.command(move_cp(beyond));
    assert!(matches!(
        error,
        Err(ArmError::PathUnreachable { .. } | ArmError::PathSingular { .. } | ArmError::PathJumps { .. })
    ));
}

/// A latched command that is repeated every tick moves the arm as if it had been sent once.
#[test]
fn a_repeated_command_changes_nothing() {
    let goal =
        moved(&arm().state().t_world_tool, Vector3::new(0.02, 0.03, 0.06), Vector3::new(0.1, 0.0, 0.2));
    let q_rad = six_joints(std::array::from_fn(|i| arm().state().q_rad[i] - 0.4));
    let commands = [
        ArmCommand::MoveJp { q_rad, speed_fraction: 0.5 },
        move_cp(goal),
        ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 0.9 },
        ArmCommand::Hold,
    ];
    let (mut once, mut repeated) = (arm(), arm());
    for command in commands {
        once.command(command).unwrap();
        for _ in 0..700 {
            repeated.command(command).unwrap();
            assert_eq!(once.step(), repeated.step());
        }
    }
}

/// Regression: earlier tests of this refusal also accepted two other kinds.
#[test]
fn a_line_on_which_the_joints_would_jump_is_refused_as_such_and_where() {
    let parameters = ArmParameters::ur5(DT_S);
    let posture = |wrist_rad| six_joints([0.0, -1.2, 1.8, -2.2, wrist_rad, 0.0]);
    for (from_rad, to_rad) in [(0.3, -0.3), (0.3, -0.25), (0.2, -0.1), (-0.3, 0.25), (0.02, -0.5)] {
        let mut arm = Arm::new(parameters, &posture(from_rad)).unwrap();
        let goal = parameters.geometry.forward(&posture(to_rad));
        // The wrist would be straight here. A line is checked in 32 intervals.
        let straight = from_rad / (from_rad - to_rad);
        match arm.command(move_cp(goal)) {
            Err(ArmError::PathJumps { fraction }) => {
                assert!((fraction - straight).abs() < 1.0 / 32.0, "{from_rad} to {to_rad}: {fraction}");
            }
            other => panic!("{from_rad} to {to_rad}: {other:?}"),
        }
        assert!(arm.state().done && arm.state().q_rad == posture(from_rad));
    }
    // Up to just before the wrist is straight, the same line does not jump.
    let mut arm = Arm::new(parameters, &posture(0.3)).unwrap();
    arm.command(move_cp(parameters.geometry.forward(&posture(0.05)))).unwrap();
    let text = ArmError::PathJumps { fraction: 0.53125 }.to_string();
    assert!(text.starts_with("joint jump at 0.5312 of the path, as near a singularity"), "{text}");
}

/// Invalid parameters are refused by name.
#[test]
fn parameters_are_checked() {
    let good = ArmParameters::ur5(DT_S);
    let q = six_joints([0.0, -1.2, 1.8, -2.2, -1.5, 0.0]);
    let build = |p: ArmParameters, q: &Joints| Arm::new(p, q).err();
    assert_eq!(build(good, &q), None);
    assert!(matches!(
        build(ArmParameters { dt_s: 0.0, ..good }, &q),
        Some(ArmError::InvalidParameter { name: "dt_s", .. })
    ));
    let mut parameters = good;
    parameters.joint_limits.jerk_rad_s3[4] = f64::NAN;
    assert!(matches!(build(parameters, &q), Some(ArmError::InvalidParameter { name: "jerk_rad_s3", .. })));
    parameters = good;
    parameters.joint_limits.lower_rad[1] = 7.0;
    assert!(matches!(build(parameters, &q), Some(ArmError::InvalidRange { joint: 2, .. })));
    parameters = good;
    parameters.t_world_arm_base.translation.x = f64::INFINITY;
    assert!(matches!(build(parameters, &q), Some(ArmError::BasePose(_))));
    assert!(matches!(
        build(good, &six_joints([4.0; 6])),
        Some(ArmError::JointOutsideLimits { joint: 3, .. })
    ));
}

/// A stream of commands of every kind; the same for the same seed.
fn random_command(uniform: &mut Uniform, state: &ArmState) -> ArmCommand {
    let near = six_joints(std::array::from_fn(|i| state.q_rad[i] + uniform.between(-0.3, 0.3)));
    let speed_fraction = uniform.between(0.1, 1.0);
    let pose = moved(&state.t_world_tool, uniform.vector(0.05), uniform.vector(0.2));
    let ahead =
        moved(&state.t_world_tool, Vector3::new(0.0, 0.0, uniform.between(-0.05, 0.05)), Vector3::zeros());
    match uniform.between(0.0, 6.0) as usize {
        0 => ArmCommand::Hold,
        1 => ArmCommand::ServoJp { q_rad: near, speed_fraction },
        2 => ArmCommand::MoveJp { q_rad: near, speed_fraction },
        3 => ArmCommand::ServoCp { t_world_tool: pose, speed_fraction },
        4 => move_cp(pose),
        _ => move_cp(ahead),
    }
}

/// Snapshots at random ticks, restored into an arm with a different history: both continue bit for bit,
/// through later commands too.
#[test]
fn a_restored_arm_continues_bit_for_bit() {
    let mut uniform = Uniform(9);
    let (mut original, mut copy) = (arm(), arm());
    let mut compared = 0;
    for _ in 0..150 {
        // The copy's planners hold something else before the restore.
        let stray = random_command(&mut uniform, copy.state());
        let _ = copy.command(stray);
        copy.step();
        for _ in 0..(uniform.between(1.0, 120.0) as usize) {
            if uniform.between(0.0, 1.0) < 0.02 {
                let _ = original.command(random_command(&mut uniform, &original.state().clone()));
            }
            original.step();
        }
        copy.restore(&original.snapshot()).unwrap();
        for tick in 0..80 {
            if tick == 50 {
                let command = random_command(&mut uniform, original.state());
                assert_eq!(original.command(command), copy.command(command));
            }
            let (a, b) = (*original.step(), *copy.step());
            assert_eq!(bits(&a), bits(&b));
            assert_eq!(original.snapshot(), copy.snapshot());
            compared += 1;
        }
    }
    println!("{compared} ticks after 150 restores equal bit for bit");
}

fn bits(state: &ArmState) -> Vec<u64> {
    let pose = &state.t_world_tool;
    let joints = state.q_rad.iter().chain(&state.qd_rad_s).chain(&state.qdd_rad_s2);
    let flange = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
    let rates = state.linear_velocity_m_s.iter().chain(state.angular_velocity_rad_s.iter());
    joints
        .chain(flange)
        .chain(rates)
        .chain(state.linear_acceleration_m_s2.iter())
        .map(|x| x.to_bits())
        .collect()
}
