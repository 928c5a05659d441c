//! A gantry: three linear axes that carry the tool and keep its orientation.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use crate::common::arm::{
    DT_S, Uniform, UsedLimits, about_pivot, finish, finish_looking, move_cp, moved, rest_to_rest_s, run,
    t_flange_tool,
};
use nalgebra::{Isometry3, Vector3};
use scene::ArmModel;
use simulation::arm::{
    Arm, ArmCommand, ArmError, ArmParameters, ArmState, Joints, KinematicsError, place_base_for,
};

const TRAVEL_MM: [f64; 3] = [120.0, 80.0, 200.0];

/// A gantry whose tool is offset from the flange and rotated relative to it, somewhere in the patient frame.
fn gantry() -> Arm {
    let tool = t_flange_tool();
    let scene = scene::Arm {
        model: Some(ArmModel::Gantry),
        travel_mm: Some(TRAVEL_MM),
        max_speed_mm_per_s: 40.0,
        max_acceleration_mm_per_s2: 300.0,
        max_jerk_mm_per_s3: 4000.0,
        ..scene::Arm::default()
    };
    let mut parameters = ArmParameters::of(&scene, DT_S);
    parameters.geometry = parameters.geometry.with_tool(Some(tool));
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    parameters.t_world_arm_base = place_base_for(&parameters.geometry, &wanted, &Joints::default());
    Arm::new(parameters, &Joints::default()).unwrap()
}

/// Position of the flange along the gantry's axes, from the start.
fn travelled_m(arm: &Arm) -> Vector3<f64> {
    arm.parameters()
        .t_world_arm_base
        .inverse_transform_point(&arm.t_world_flange().translation.vector.into())
        .coords
}

/// The double-S profile in closed form: time, line, orientation.
#[test]
fn an_insertion_takes_the_time_of_its_double_s_and_keeps_line_and_orientation() {
    for (depth_m, feed_m_s) in [(0.06, 0.04), (-0.05, 0.01), (0.0004, 0.03), (0.003, 0.04)] {
        let mut arm = gantry();
        let start = arm.state().t_world_tool;
        let axis_world = Vector3::new(0.36, -0.48, 0.8);
        arm.command(ArmCommand::Insert { axis_world, depth_m, feed_m_s }).unwrap();
        let mut off_m = 0.0f64;
        let ticks = finish_looking(&mut arm, |state| {
            let way = state.t_world_tool.translation.vector - start.translation.vector;
            off_m = off_m.max((way - axis_world * way.dot(&axis_world)).norm());
            assert!(state.t_world_tool.rotation.angle_to(&start.rotation) < 1e-15);
            assert_eq!(state.angular_velocity_rad_s, Vector3::zeros());
        });
        let end = arm.state().t_world_tool.translation.vector;
        let missed_m = (end - start.translation.vector - axis_world * depth_m).norm();
        let closed_s = rest_to_rest_s(depth_m.abs(), feed_m_s, 0.3, 4.0);
        println!(
            "{:.4} mm at {:.0} mm/s: {ticks} ticks, closed form {:.2}; {off_m:.1e} m off the line, ends \
             {missed_m:.1e} m away",
            1e3 * depth_m,
            1e3 * feed_m_s,
            closed_s / DT_S
        );
        assert!((ticks as f64 - (closed_s / DT_S).ceil()).abs() <= 1.0);
        assert!(off_m < 1e-12 && missed_m < 1e-12, "rounding only");
    }
}

fn any_command(uniform: &mut Uniform, arm: &Arm) -> ArmCommand {
    let here = arm.state().t_world_tool;
    let goal = moved(&here, uniform.vector(0.1), Vector3::zeros());
    match uniform.between(0.0, 6.0) as usize {
        0 => ArmCommand::Hold,
        1 | 2 => ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: uniform.between(0.05, 1.0) },
        3 => move_cp(goal),
        4 => ArmCommand::Insert {
            axis_world: here.rotation * Vector3::z(),
            depth_m: uniform.between(-0.05, 0.05),
            feed_m_s: uniform.between(1e-3, 0.04),
        },
        _ => {
            let pivot_world_m = here.translation.vector + here.rotation * Vector3::z() * 0.05;
            let t_world_tool =
                about_pivot(&here, &pivot_world_m, Vector3::zeros(), uniform.between(0.01, 0.09));
            ArmCommand::Rcm { t_world_tool, pivot_world_m, max_speed_m_s: None }
        }
    }
}

/// The state holds the pose's exact derivatives: central differences over a tick agree to their own error, a
/// sixth of the jerk's change.
fn derivatives_agree(three: &[ArmState; 3], jerk_m_s3: f64) -> bool {
    let [before, now, after] = three.map(|state| state.t_world_tool.translation.vector);
    let [velocity, acceleration] =
        [(after - before) / (2.0 * DT_S), (after - now * 2.0 + before) / (DT_S * DT_S)];
    let state = &three[1];
    (velocity - state.linear_velocity_m_s).amax() <= 0.5 * jerk_m_s3 * DT_S * DT_S + 1e-12
        && (acceleration - state.linear_acceleration_m_s2).amax() <= 2.0 * jerk_m_s3 * DT_S
}

#[test]
fn any_commands_keep_travel_limits_orientation_and_derivatives_and_a_snapshot_continues() {
    let (mut arm, mut uniform) = (gantry(), Uniform(11));
    let start = arm.state().t_world_tool;
    let (mut used, mut accepted, mut refused) = (UsedLimits::default(), 0, 0);
    let mut last = [*arm.state(); 3];
    for _ in 0..400 {
        match arm.command(any_command(&mut uniform, &arm)) {
            Ok(()) => accepted += 1,
            Err(
                ArmError::Goal(KinematicsError::BeyondTravel { .. })
                | ArmError::PathUnreachable { reason: KinematicsError::BeyondTravel { .. }, .. }
                | ArmError::TravelEnds { .. },
            ) => refused += 1,
            // It would stop off the pivot.
            Err(ArmError::PivotMissed { end: "start", .. }) => {}
            Err(other) => panic!("{other}"),
        }
        for _ in 0..uniform.between(1.0, 600.0) as usize {
            let before = *arm.state();
            arm.step();
            used.add(&arm, &before);
            last = [last[1], last[2], *arm.state()];
            assert!(derivatives_agree(&last, 3f64.sqrt() * 4.0), "{last:?}");
            assert!(arm.state().t_world_tool.rotation.angle_to(&start.rotation) < 1e-15);
            let most_m = Vector3::from(TRAVEL_MM) * 1e-3;
            assert!(travelled_m(&arm).iter().zip(&most_m).all(|(m, most)| m.abs() <= most + 1e-9));
        }
    }
    println!("{accepted} commands accepted, {refused} beyond the travel; limits used {used:?}");
    assert!(accepted > 100 && refused > 20);
    used.check(1e-9);

    arm.command(ArmCommand::Hold).unwrap();
    finish(&mut arm, &mut used);
    arm.command(move_cp(start)).unwrap();
    run(&mut arm, 60);
    let mut other = gantry();
    other.restore(&arm.snapshot()).unwrap();
    for _ in 0..12_000 {
        assert_eq!(arm.step(), other.step());
    }
    assert!((arm.state().t_world_tool.translation.vector - start.translation.vector).norm() < 1e-12);
}

#[test]
fn what_a_gantry_cannot_do_is_refused_with_what_it_can_and_changes_nothing() {
    let mut arm = gantry();
    let start = arm.state().t_world_tool;
    let q_rad = Joints::default();
    let of_joints = [
        ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 },
        ArmCommand::MoveJp { q_rad, speed_fraction: 1.0 },
        ArmCommand::ServoJv { qd_rad_s: q_rad },
    ];
    for command in of_joints {
        assert_eq!(arm.command(command), Err(ArmError::NoTurningJoints));
    }
    let turned = moved(&start, Vector3::zeros(), Vector3::new(0.0, 0.01, 0.0));
    for command in [move_cp(turned), ArmCommand::ServoCp { t_world_tool: turned, speed_fraction: 1.0 }] {
        let error = arm.command(command).unwrap_err().to_string();
        assert!(error.contains("rotated by 0.01") && error.contains("arm.model"), "{error}");
    }
    let pivot_world_m = start.translation.vector + start.rotation * Vector3::z() * 0.05;
    let about = about_pivot(&start, &pivot_world_m, Vector3::new(0.05, 0.0, 0.0), 0.05);
    let rcm = ArmCommand::Rcm { t_world_tool: about, pivot_world_m, max_speed_m_s: None };
    assert!(arm.command(rcm).unwrap_err().to_string().contains("a gantry keeps the tool's orientation"));
    // The gantry's own y in the patient frame.
    let axis_world = arm.parameters().t_world_arm_base.rotation * Vector3::y();
    let error = arm.command(ArmCommand::Insert { axis_world, depth_m: 0.081, feed_m_s: 0.01 }).unwrap_err();
    assert!(error.to_string().contains("axis y") && error.to_string().contains("-0.08 to 0.08"), "{error}");
    assert!(arm.state().done && arm.state().t_world_tool == start);
    // An orientation as sent by a client that rounds to single precision.
    let mut rounded = moved(&start, Vector3::new(0.0, 0.0, 0.01), Vector3::zeros());
    let xyzw = rounded.rotation.coords.map(|x| f64::from(x as f32)).normalize();
    rounded.rotation = nalgebra::Unit::new_normalize(nalgebra::Quaternion::from(xyzw));
    arm.command(move_cp(rounded)).unwrap();
    finish_looking(&mut arm, |state| assert!(state.t_world_tool.rotation.angle_to(&start.rotation) < 1e-15));
    assert!((arm.state().t_world_tool.translation.vector - rounded.translation.vector).norm() < 1e-12);
}
