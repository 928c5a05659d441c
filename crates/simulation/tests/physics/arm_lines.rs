//! Straight lines of the tool's base: on the line, at the requested speed, stopped, extended and left.

use crate::common::arm::{DT_S, Uniform, UsedLimits, arm, finish, move_cp, moved, rest_to_rest_s};
use nalgebra::{Isometry3, Vector3};
use simulation::arm::{ArmCommand, ArmMode, ArmState, six_joints};

/// Distance of the flange from the straight line `from`-`to`, and the angle by which its rotation deviates
/// from the fixed-axis rotation.
fn off_line(state: &ArmState, from: &Isometry3<f64>, to: &Isometry3<f64>) -> (f64, f64) {
    let way = to.translation.vector - from.translation.vector;
    let here = state.t_world_tool.translation.vector - from.translation.vector;
    let length = way.norm();
    let off_m = if length > 0.0 { here.cross(&way).norm() / length } else { here.norm() };
    let turn = (to.rotation * from.rotation.inverse()).scaled_axis();
    let turned = (state.t_world_tool.rotation * from.rotation.inverse()).scaled_axis();
    let share = if length > 0.0 {
        here.dot(&way) / way.norm_squared()
    } else {
        turned.dot(&turn) / turn.norm_squared()
    };
    (off_m, (turned - turn * share).norm())
}

#[test]
fn the_flange_stays_on_its_line() {
    let mut uniform = Uniform(7);
    let (mut off_m, mut off_rad, mut accepted) = (0.0f64, 0.0f64, 0);
    let mut used = UsedLimits::default();
    for _ in 0..60 {
        let mut arm = arm();
        let from = arm.state().t_world_tool;
        let to = moved(&from, uniform.vector(0.12), uniform.vector(0.5));
        if arm.command(move_cp(to)).is_err() {
            continue;
        }
        accepted += 1;
        let (mut fastest, mut ticks) = (0.0f64, 0);
        while !arm.state().done {
            let before = *arm.state();
            let state = *arm.step();
            used.add(&arm, &before);
            let off = off_line(&state, &from, &to);
            (off_m, off_rad) = (off_m.max(off.0), off_rad.max(off.1));
            fastest = fastest.max(state.linear_velocity_m_s.norm());
            ticks += 1;
            assert!(ticks < 100_000 && state.fault.is_none());
        }
        assert!(fastest <= 0.1 * (1.0 + 1e-9), "{fastest} m/s");
        let end = arm.state().t_world_tool;
        assert!((end.translation.vector - to.translation.vector).norm() < 1e-12);
        assert!(end.rotation.rotation_to(&to.rotation).vector().norm() < 1e-12);
    }
    println!("{accepted} of 60 lines; off the line by {off_m:.1e} m, {off_rad:.1e} rad; joints use {used:?}");
    assert!(off_m < 1e-12 && off_rad < 1e-11, "rounding only; the requirement is 1e-6 m");
    // From the comfortable configuration nearly every direction is reachable.
    assert!(accepted >= 55);
    used.check(1e-9);
}

#[test]
fn from_the_placed_base_an_insertion_of_100_mm_works_in_every_direction() {
    for axis in 0..3 {
        for length_m in [-0.1, 0.1] {
            let mut arm = arm();
            let mut shift = Vector3::zeros();
            shift[axis] = length_m;
            let goal = moved(&arm.state().t_world_tool, shift, Vector3::zeros());
            arm.command(move_cp(goal)).unwrap();
            finish(&mut arm, &mut UsedLimits::default());
        }
    }
}

#[test]
fn a_slow_insertion_keeps_its_speed() {
    let mut arm = arm();
    let from = arm.state().t_world_tool;
    let to = moved(&from, Vector3::new(0.0, 0.0, 0.01), Vector3::zeros());
    let speed_m_s = 0.5e-3;
    let command = ArmCommand::MoveCp {
        t_world_tool: to,
        max_speed_m_s: Some(speed_m_s),
        max_angular_speed_rad_s: None,
    };
    arm.command(command).unwrap();
    let ticks = finish(&mut arm, &mut UsedLimits::default());
    let expected_s = rest_to_rest_s(0.01, speed_m_s, 0.5, 5.0);
    println!("10 mm at 0.5 mm/s: {ticks} ticks, closed form {expected_s:.4} s");
    assert!((ticks as f64 * DT_S - expected_s).abs() <= DT_S + 1e-9);
}

/// Velocity and acceleration of the flange are the derivatives of the published pose.
#[test]
fn the_published_velocity_is_the_derivative_of_the_published_pose() {
    let mut arm = arm();
    let goal =
        moved(&arm.state().t_world_tool, Vector3::new(0.05, -0.04, 0.06), Vector3::new(0.3, 0.2, -0.1));
    let q_goal = six_joints(std::array::from_fn(|i| arm.state().q_rad[i] + 0.3));
    let mut worst = [0.0f64; 3];
    for command in [move_cp(goal), ArmCommand::MoveJp { q_rad: q_goal, speed_fraction: 0.3 }] {
        arm.command(command).unwrap();
        let (mut first, mut second) = (*arm.state(), *arm.step());
        while !arm.state().done {
            let third = *arm.step();
            let linear = (third.t_world_tool.translation.vector - first.t_world_tool.translation.vector)
                / (2.0 * DT_S);
            let turn = third.t_world_tool.rotation * first.t_world_tool.rotation.inverse();
            let angular = turn.scaled_axis() / (2.0 * DT_S);
            let acceleration = (third.linear_velocity_m_s - first.linear_velocity_m_s) / (2.0 * DT_S);
            worst[0] = worst[0].max((linear - second.linear_velocity_m_s).norm());
            worst[1] = worst[1].max((angular - second.angular_velocity_rad_s).norm());
            worst[2] = worst[2].max((acceleration - second.linear_acceleration_m_s2).norm());
            (first, second) = (second, third);
        }
        let twist = arm.jacobian() * nalgebra::SVector::from(second.qd_rad_s);
        assert!((twist.fixed_rows::<3>(0) - second.linear_velocity_m_s).norm() < 1e-15);
    }
    println!(
        "central differences differ by {:.1e} m/s, {:.1e} rad/s, {:.1e} m/s²",
        worst[0], worst[1], worst[2]
    );
    // Truncation h²/6 times the third derivative: 2e-7 times the jerks, up to 50 rad/s³ and, at the arm's
    // radius, m/s³. Where the jerk switches, the acceleration's difference quotient is off by half a tick of
    // the jump, 2 · 50 · 0.5e-3.
    assert!(worst[0] < 5e-5 && worst[1] < 5e-5 && worst[2] < 5e-2);
}

#[test]
fn a_hold_on_a_line_stops_on_the_line() {
    let mut arm = arm();
    let from = arm.state().t_world_tool;
    let to = moved(&from, Vector3::new(0.02, 0.01, 0.09), Vector3::new(0.1, 0.0, 0.0));
    arm.command(move_cp(to)).unwrap();
    for _ in 0..500 {
        arm.step();
    }
    let at_hold = arm.state().t_world_tool;
    arm.command(ArmCommand::Hold).unwrap();
    assert!(!arm.state().done);
    for _ in 0..1_000 {
        let off = off_line(arm.step(), &from, &to);
        assert!(off.0 < 1e-12 && off.1 < 1e-12);
    }
    assert!(arm.state().done && arm.state().mode == ArmMode::Hold);
    let rolled_m = (arm.state().t_world_tool.translation.vector - at_hold.translation.vector).norm();
    // From 0.1 m/s by 0.5 m/s² and 5 m/s³: v/2 (v/a + a/j) = 15 mm.
    assert!((rolled_m - 0.015).abs() < 1e-3, "{rolled_m}");
}

/// A goal farther along the same line or a new speed: no stop, and no deviation from the line. Any other
/// goal: stop, then go.
#[test]
fn a_line_can_be_extended_and_left() {
    let mut arm = arm();
    let from = arm.state().t_world_tool;
    let far = moved(&from, Vector3::new(0.0, 0.0, 0.1), Vector3::zeros());
    arm.command(move_cp(moved(&from, Vector3::new(0.0, 0.0, 0.05), Vector3::zeros()))).unwrap();
    for _ in 0..400 {
        arm.step();
    }
    let mut used = UsedLimits::default();
    let slower = [(0.03, 0.03 - 0.5 * 0.5 / (2.0 * 5.0)), (0.001, 0.0)];
    for (speed_m_s, least_m_s) in slower {
        let speed = Some(speed_m_s);
        arm.command(ArmCommand::MoveCp {
            t_world_tool: far,
            max_speed_m_s: speed,
            max_angular_speed_rad_s: None,
        })
        .unwrap();
        let way = (far.translation.vector - from.translation.vector).normalize();
        let mut slowest = f64::INFINITY;
        for _ in 0..1_000 {
            let before = *arm.state();
            arm.step();
            used.add(&arm, &before);
            slowest = slowest.min(arm.state().linear_velocity_m_s.dot(&way));
            assert!(off_line(arm.state(), &from, &far).0 < 1e-9);
        }
        println!("speed cut to {speed_m_s} m/s: slowest {slowest:.6} m/s");
        // Ruckig brakes at full deceleration down to the new limit, so it undershoots it by a²/2j.
        assert!(slowest >= least_m_s - 1e-9, "never turns back");
        assert!((arm.state().linear_velocity_m_s.norm() - speed_m_s).abs() < 1e-9);
    }

    let aside = moved(&arm.state().t_world_tool, Vector3::new(0.05, 0.0, 0.0), Vector3::zeros());
    arm.command(move_cp(aside)).unwrap();
    let mut stopped_at = None;
    while !arm.state().done {
        let before = *arm.state();
        let state = *arm.step();
        used.add(&arm, &before);
        if stopped_at.is_none() && state.linear_velocity_m_s.norm() == 0.0 {
            stopped_at = Some(state.t_world_tool);
        }
        match &stopped_at {
            None => assert!(off_line(&state, &from, &far).0 < 1e-9),
            Some(corner) => assert!(off_line(&state, corner, &aside).0 < 1e-12),
        }
    }
    assert!((arm.state().t_world_tool.translation.vector - aside.translation.vector).norm() < 1e-12);
    used.check(1e-9);
}

#[test]
fn a_line_begun_in_joint_motion_waits_for_the_stop() {
    let mut arm = arm();
    let goal = moved(&arm.state().t_world_tool, Vector3::new(0.03, 0.02, 0.05), Vector3::zeros());
    let q_rad = six_joints(std::array::from_fn(|i| arm.state().q_rad[i] + 0.5));
    let mut used = UsedLimits::default();
    arm.command(ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 }).unwrap();
    for _ in 0..150 {
        arm.step();
    }
    arm.command(move_cp(goal)).unwrap();
    finish(&mut arm, &mut used);
    assert!((arm.state().t_world_tool.translation.vector - goal.translation.vector).norm() < 1e-12);
    used.check(1e-9);
}
