//! The arm's guided motions: joint rates, insertion along an axis, remote centre of motion, and targets of
//! every kind that change at any tick.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use crate::common::arm::{
    DT_S, Uniform, UsedLimits, about_pivot, finish_looking, guided_arm, run, t_flange_tool,
};
use nalgebra::{Isometry3, Point3, SVector, Vector3};
use simulation::arm::{Arm, ArmCommand, ArmError, ArmMode, Joints, six_joints};
use std::f64::consts::PI;

/// Distance of a pivot from the tool's axis.
fn off_axis_m(t_world_tool: &Isometry3<f64>, pivot_world_m: &Vector3<f64>) -> f64 {
    let in_tool = t_world_tool.inverse_transform_point(&Point3::from(*pivot_world_m));
    in_tool.x.hypot(in_tool.y)
}

#[test]
fn the_tool_stands_at_the_flange_through_its_transform() {
    let arm = guided_arm();
    let flange = arm.t_world_flange();
    let apart = (flange * t_flange_tool()).inverse() * arm.state().t_world_tool;
    assert!(apart.translation.vector.norm() < 1e-15 && apart.rotation.angle() < 1e-15);
    // Independent of the tool: the kinematics without one.
    let bare = arm.parameters().geometry.with_tool(None);
    let expected = arm.parameters().t_world_arm_base * bare.forward(&arm.state().q_rad);
    assert!((expected.translation.vector - flange.translation.vector).norm() < 1e-15);
    // The Jacobian is that of the tool's base: a central difference, whose rounding is 1e-10 of a meter.
    let rates = six_joints([0.1, 0.2, 0.3, -0.1, 0.4, 0.2]);
    let after = |time_s: f64| {
        let q = std::array::from_fn(|i| arm.state().q_rad[i] + time_s * rates[i]);
        (arm.parameters().t_world_arm_base * arm.parameters().geometry.forward(&q)).translation.vector
    };
    let velocity = (after(1e-6) - after(-1e-6)) / 2e-6;
    let twist = arm.jacobian() * SVector::from(rates);
    assert!((twist.fixed_rows::<3>(0) - velocity).norm() < 1e-8, "{twist} {velocity}");
}

#[test]
fn rates_are_reached_and_kept_and_a_joint_stops_at_the_end_of_its_range() {
    let mut arm = guided_arm();
    let rates = six_joints([0.4, -0.3, 0.9, 0.0, -0.2, 1.1]);
    arm.command(ArmCommand::ServoJv { qd_rad_s: rates }).unwrap();
    let mut used = UsedLimits::default();
    let mut elbow_stops_at_tick = None;
    for tick in 0..4_000 {
        let before = *arm.state();
        let state = *arm.step();
        used.add(&arm, &before);
        if tick == 400 {
            assert_eq!(state.qd_rad_s, rates);
            assert_eq!(state.qdd_rad_s2, Joints::default());
        }
        if let Some(ArmError::JointRangeEnds { joint, .. }) = state.fault {
            assert_eq!(joint, 3);
            elbow_stops_at_tick.get_or_insert(tick);
        }
    }
    let state = *arm.state();
    println!("elbow at {:.6} rad, braking from tick {elbow_stops_at_tick:?}; {used:?}", state.q_rad[2]);
    // 1.34 rad at 0.9 rad/s.
    assert!(elbow_stops_at_tick.is_some_and(|tick| (1_300..1_600).contains(&tick)));
    // Not beyond the end, and short of it by less than a tick's travel.
    assert!(state.q_rad[2] <= PI && state.q_rad[2] > PI - 0.9e-3 * 1.01);
    assert_eq!(state.qd_rad_s, six_joints([0.4, -0.3, 0.0, 0.0, -0.2, 1.1]), "the others continue");
    assert_eq!(state.mode, ArmMode::ServoJv);
    used.check(1e-8);

    // Outward again: the joint stays. Back: it moves. Zero: it stops, and the motion is done.
    arm.command(ArmCommand::ServoJv { qd_rad_s: six_joints([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]) }).unwrap();
    run(&mut arm, 1_000);
    assert!(arm.state().done && arm.state().q_rad[2] <= PI);
    arm.command(ArmCommand::ServoJv { qd_rad_s: six_joints([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]) }).unwrap();
    run(&mut arm, 1_000);
    assert!(arm.state().q_rad[2] < PI - 0.4 && arm.state().fault.is_none());
    arm.command(ArmCommand::ServoJv { qd_rad_s: Joints::default() }).unwrap();
    finish_looking(&mut arm, |_| ());
    assert_eq!(arm.state().qd_rad_s, Joints::default());

    let mut fast = Joints::default();
    fast[4] = 3.2;
    let refused = arm.command(ArmCommand::ServoJv { qd_rad_s: fast });
    assert!(matches!(refused, Err(ArmError::JointRateOutsideLimits { joint: 5, .. })));
    fast[4] = f64::NAN;
    assert!(arm.command(ArmCommand::ServoJv { qd_rad_s: fast }).is_err());
}

/// `insert` at the feeds of orthopaedic drilling: line and orientation are kept, and the time is length over
/// feed.
#[test]
fn an_insertion_keeps_its_line_its_orientation_and_its_feed() {
    let (mut off_m, mut off_rad) = (0.0f64, 0.0f64);
    for feed_m_s in [0.05e-3, 0.1e-3, 0.15e-3] {
        let mut arm = guided_arm();
        let start = arm.state().t_world_tool;
        let axis_world = (start.rotation * Vector3::new(0.1, -0.2, 1.0)).normalize();
        let mut go = |arm: &mut Arm, depth_m: f64| {
            arm.command(ArmCommand::Insert { axis_world, depth_m, feed_m_s }).unwrap();
            let mut fastest = 0.0f64;
            let ticks = finish_looking(arm, |state| {
                let moved = state.t_world_tool.translation.vector - start.translation.vector;
                off_m = off_m.max((moved - axis_world * moved.dot(&axis_world)).norm());
                off_rad = off_rad.max(state.t_world_tool.rotation.angle_to(&start.rotation));
                fastest = fastest.max(state.linear_velocity_m_s.norm());
            });
            let reached = arm.state().t_world_tool.translation.vector - start.translation.vector;
            assert!((reached - axis_world * depth_m).norm() < 1e-12, "depths count from the first insertion");
            assert!((fastest / feed_m_s - 1.0).abs() < 1e-6, "{fastest} m/s");
            ticks
        };
        let ticks = go(&mut arm, 0.4e-3);
        // Jerk-limited ends: reaching 0.15 mm/s at 5 m/s³ takes 2 sqrt(v/j) = 11 ms, at half the feed on
        // average.
        let expected = 0.4e-3 / feed_m_s / DT_S;
        assert!((ticks as f64 - expected).abs() < 15.0, "{ticks} ticks, {expected} expected");
        go(&mut arm, 0.6e-3);
        arm.command(ArmCommand::Hold).unwrap();
        go(&mut arm, -0.1e-3);
    }
    println!("insertion off its line by {off_m:.1e} m, off its orientation by {off_rad:.1e} rad");
    // Rounding of poses of about 1 m; the requirement is 1e-6 m.
    assert!(off_m < 1e-12 && off_rad < 1e-7);
}

#[test]
fn an_insertion_can_be_deepened_paused_and_slowed_on_its_way() {
    let mut arm = guided_arm();
    let start = arm.state().t_world_tool;
    let axis_world = start.rotation * Vector3::z();
    let insert = |depth_m, feed_m_s| ArmCommand::Insert { axis_world, depth_m, feed_m_s };
    let depth =
        |arm: &Arm| (arm.state().t_world_tool.translation.vector - start.translation.vector).dot(&axis_world);
    arm.command(insert(5e-3, 2e-3)).unwrap();
    run(&mut arm, 1_000);
    arm.command(insert(8e-3, 1e-3)).unwrap();
    assert!(depth(&arm) > 1.9e-3 && !arm.state().done);
    run(&mut arm, 1_000);
    // Smoothly: 1 s at 1 mm/s without an intermediate stop; the start takes about 2 mm/s times 20 ms.
    assert!((depth(&arm) - 3e-3).abs() < 0.1e-3, "{}", depth(&arm));
    arm.command(ArmCommand::Hold).unwrap();
    run(&mut arm, 500);
    let paused_m = depth(&arm);
    assert!(arm.state().done);
    run(&mut arm, 500);
    assert_eq!(depth(&arm), paused_m);
    arm.command(insert(8e-3, 2e-3)).unwrap();
    finish_looking(&mut arm, |_| ());
    assert!((depth(&arm) - 8e-3).abs() < 1e-12);
    // Regression: an axis that differs only by rounding is the same axis; it used to begin a new insertion,
    // with the depth counted from here.
    let rounded = axis_world + Vector3::new(1e-9, -2e-9, 1e-9);
    arm.command(ArmCommand::Insert { axis_world: rounded, depth_m: 9e-3, feed_m_s: 2e-3 }).unwrap();
    finish_looking(&mut arm, |_| ());
    let moved = arm.state().t_world_tool.translation.vector - start.translation.vector;
    assert!((moved - axis_world * 9e-3).norm() < 1e-12, "{moved}");
    arm.command(insert(8e-3, 2e-3)).unwrap();
    finish_looking(&mut arm, |_| ());
    // Another axis: a new insertion from here.
    let sideways = start.rotation * Vector3::x();
    arm.command(ArmCommand::Insert { axis_world: sideways, depth_m: 1e-3, feed_m_s: 2e-3 }).unwrap();
    finish_looking(&mut arm, |_| ());
    assert!((depth(&arm) - 8e-3).abs() < 1e-12);

    for (axis_world, depth_m, feed_m_s) in [
        (axis_world * 1.1, 1e-3, 1e-3),
        (axis_world * f64::NAN, 1e-3, 1e-3),
        (axis_world, 0.6, 1e-3),
        (axis_world, f64::NAN, 1e-3),
        (axis_world, 1e-3, 0.0),
        (axis_world, 1e-3, 0.2),
    ] {
        let refused = arm.command(ArmCommand::Insert { axis_world, depth_m, feed_m_s });
        assert!(refused.is_err(), "{axis_world} {depth_m} {feed_m_s}");
    }
}

#[test]
fn the_pivot_stays_on_the_axis_of_the_tool() {
    let mut uniform = Uniform(21);
    let (mut off_m, mut fastest, mut accepted) = (0.0f64, 0.0f64, 0);
    for _ in 0..15 {
        let mut arm = guided_arm();
        let start = arm.state().t_world_tool;
        let pivot_world_m = start.translation.vector + start.rotation * Vector3::z() * 0.06;
        for _ in 0..2 {
            let before_m = uniform.between(0.01, 0.1);
            let goal = about_pivot(&start, &pivot_world_m, uniform.vector(0.4), before_m);
            let command = ArmCommand::Rcm { t_world_tool: goal, pivot_world_m, max_speed_m_s: Some(0.05) };
            if arm.command(command).is_err() {
                continue;
            }
            accepted += 1;
            finish_looking(&mut arm, |state| {
                off_m = off_m.max(off_axis_m(&state.t_world_tool, &pivot_world_m));
                fastest = fastest.max(state.linear_velocity_m_s.norm());
            });
            let end = arm.state().t_world_tool;
            assert!((end.translation.vector - goal.translation.vector).norm() < 1e-12);
            assert!(end.rotation.angle_to(&goal.rotation) < 1e-7);
        }
    }
    println!("{accepted} of 30 motions about a pivot: off by {off_m:.1e} m, fastest {fastest:.4} m/s");
    assert!(off_m < 1e-12, "rounding; the requirement is 1e-6 m");
    assert!(fastest <= 0.05 * (1.0 + 1e-3), "the limit is evaluated at 33 points of the path");
    assert!(accepted >= 25);
}

/// A stop along the way keeps the pivot, and so does the next goal; axes that miss the pivot are refused with
/// the distance.
#[test]
fn a_motion_about_a_pivot_can_be_changed_on_its_way_and_needs_the_pivot_on_the_axis() {
    let mut arm = guided_arm();
    let start = arm.state().t_world_tool;
    let pivot_world_m = start.translation.vector + start.rotation * Vector3::z() * 0.05;
    let rcm = |turn, before_m| ArmCommand::Rcm {
        t_world_tool: about_pivot(&start, &pivot_world_m, turn, before_m),
        pivot_world_m,
        max_speed_m_s: None,
    };
    arm.command(rcm(Vector3::new(0.3, 0.0, 0.1), 0.03)).unwrap();
    for _ in 0..400 {
        arm.step();
        assert!(off_axis_m(&arm.state().t_world_tool, &pivot_world_m) < 1e-12);
    }
    assert!(!arm.state().done);
    arm.command(rcm(Vector3::new(-0.2, 0.2, 0.0), 0.06)).unwrap();
    finish_looking(&mut arm, |state| assert!(off_axis_m(&state.t_world_tool, &pivot_world_m) < 1e-12));
    assert_eq!(arm.state().mode, ArmMode::Rcm);

    let beside = pivot_world_m + start.rotation * Vector3::x() * 2e-6;
    let refused = arm.command(ArmCommand::Rcm {
        t_world_tool: about_pivot(&start, &pivot_world_m, Vector3::zeros(), 0.02),
        pivot_world_m: beside,
        max_speed_m_s: None,
    });
    assert!(matches!(refused, Err(ArmError::PivotMissed { end: "start", .. })), "{refused:?}");
    let mut goal = about_pivot(&start, &pivot_world_m, Vector3::zeros(), 0.02);
    goal.translation.x += 1e-4;
    let refused = arm.command(ArmCommand::Rcm { t_world_tool: goal, pivot_world_m, max_speed_m_s: None });
    assert!(matches!(refused, Err(ArmError::PivotMissed { end: "goal", .. })), "{refused:?}");
    let not_a_number = Vector3::new(f64::NAN, 0.0, 0.0);
    let refused = arm.command(ArmCommand::Rcm {
        t_world_tool: start,
        pivot_world_m: not_a_number,
        max_speed_m_s: None,
    });
    assert!(refused.is_err());
}
