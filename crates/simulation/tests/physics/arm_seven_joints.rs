//! A seven-joint arm: the redundant joint on a path, when pursuing a pose, and moved alone.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use nalgebra::{Isometry3, SVector, Vector3};
use simulation::arm::{Arm, ArmCommand, ArmError, ArmState, Joints, six_joints};

use crate::common;
use crate::common::arm::{
    DT_S, Uniform, UsedLimits, about_pivot, finish, finish_looking, move_cp, moved, seven_joint_arm,
};

/// Between two ticks the joints move by their mean rate, and the tool's velocity is the Jacobian times it.
fn check_derivatives(before: &ArmState, arm: &Arm, worst: &mut f64) {
    let now = arm.state();
    for i in 0..7 {
        let mean = 0.5 * (now.qd_rad_s[i] + before.qd_rad_s[i]);
        *worst = worst.max(((now.q_rad[i] - before.q_rad[i]) / DT_S - mean).abs());
    }
    let twist = arm.jacobian() * SVector::from(now.qd_rad_s);
    let linear = twist.fixed_rows::<3>(0) - now.linear_velocity_m_s;
    let angular = twist.fixed_rows::<3>(3) - now.angular_velocity_rad_s;
    *worst = worst.max(linear.norm()).max(angular.norm());
}

#[test]
fn on_a_path_the_redundant_joint_stands_and_the_tool_is_where_the_path_says() {
    for (key, redundant) in [("", 2), ("redundant_joint = \"A5\"", 4)] {
        let mut arm = seven_joint_arm(key);
        let start = *arm.state();
        let pivot_m = (start.t_world_tool * nalgebra::Point3::new(0.0, 0.0, 0.06)).coords;
        let commands = [
            ArmCommand::Insert { axis_world: Vector3::new(0.0, 0.6, 0.8), depth_m: 0.03, feed_m_s: 0.02 },
            move_cp(moved(
                &start.t_world_tool,
                Vector3::new(-0.05, 0.04, 0.03),
                Vector3::new(0.2, -0.1, 0.3),
            )),
            move_cp(start.t_world_tool),
            ArmCommand::Rcm {
                t_world_tool: about_pivot(&start.t_world_tool, &pivot_m, Vector3::new(0.1, 0.15, 0.0), 0.04),
                pivot_world_m: pivot_m,
                max_speed_m_s: None,
            },
        ];
        let (mut off, mut worst) = (0.0f64, 0.0f64);
        for command in commands {
            arm.command(command).unwrap();
            let mut used = UsedLimits::default();
            for tick in 0.. {
                let before = *arm.state();
                arm.step();
                used.add(&arm, &before);
                check_derivatives(&before, &arm, &mut worst);
                let state = arm.state();
                assert_eq!(state.fault, None);
                assert_eq!(state.q_rad[redundant], start.q_rad[redundant]);
                off = off.max(match command {
                    ArmCommand::Insert { axis_world, .. } => {
                        let way =
                            state.t_world_tool.translation.vector - start.t_world_tool.translation.vector;
                        (way - axis_world * way.dot(&axis_world)).norm()
                    }
                    ArmCommand::Rcm { .. } => {
                        let pivot = state.t_world_tool.inverse_transform_point(&pivot_m.into());
                        pivot.x.hypot(pivot.y)
                    }
                    _ => 0.0,
                });
                if state.done {
                    break;
                }
                assert!(tick < 100_000, "the motion does not end");
            }
            used.check(1e-8);
        }
        println!(
            "joint {} fixed: off line and pivot by {off:.1e} m, derivatives off by {worst:.1e}",
            redundant + 1
        );
        // The numeric inverse guarantees 1e-12; a mean of rates is off by jerk dt²/12, 50e-6/12 rad/s.
        assert!(off < 5e-12 && worst < 5e-6);
    }
}

/// Goals anywhere in the ranges: those that the hand cannot reach with the third joint in place are reached
/// by moving it.
#[test]
fn a_pose_that_needs_the_redundant_joint_is_pursued_with_it() {
    let mut arm = seven_joint_arm("");
    let (start, limits) = (*arm.state(), arm.parameters().joint_limits);
    let mut uniform = Uniform(41);
    let (mut reached, mut freed) = (0, 0);
    for _ in 0..100 {
        let q: Joints =
            std::array::from_fn(|i| uniform.between(limits.lower_rad[i], limits.upper_rad[i]) * 0.9);
        let goal = arm.parameters().t_world_arm_base * arm.parameters().geometry.forward(&q);
        let mut other = seven_joint_arm("");
        let command = ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 1.0 };
        match other.command(command) {
            Ok(()) => {
                finish_looking(&mut other, |_| ());
                let off = other.state().t_world_tool.inverse() * goal;
                assert!(off.translation.vector.norm() < 1e-10 && off.rotation.angle() < 1e-7, "{off}");
                reached += 1;
                freed += usize::from(other.state().q_rad[2] != start.q_rad[2]);
            }
            Err(refused) => assert!(matches!(refused, ArmError::Goal(_)), "{refused}"),
        }
    }
    println!("{reached} of 100 poses reached, {freed} of them by moving the third joint");
    // All goals were generated from joint angles; some have no solution with the third joint at its start.
    assert!(reached == 100 && freed >= 10);
    // Unreachable at any elbow angle.
    let far = Isometry3::translation(3.0, 0.0, 0.0) * arm.state().t_world_tool;
    let refused = arm.command(ArmCommand::ServoCp { t_world_tool: far, speed_fraction: 1.0 });
    assert!(matches!(refused, Err(ArmError::Goal(_))), "{refused:?}");
}

/// The elbow rotates about the line from shoulder to wrist by joint rates from the Jacobian's null space,
/// while the tool stays in place.
#[test]
fn the_elbow_moves_by_joint_rates_while_the_tool_stands() {
    let mut arm = seven_joint_arm("");
    let start = *arm.state();
    let mut worst = 0.0f64;
    for _ in 0..1_500 {
        // The null vector: the signed minors of the Jacobian.
        let jacobian = arm.jacobian();
        let minor =
            |i: usize| jacobian.remove_column(i).determinant() * if i.is_multiple_of(2) { 1.0 } else { -1.0 };
        let null = SVector::<f64, 7>::from_fn(|i, _| minor(i)).normalize() * 0.1;
        arm.command(ArmCommand::ServoJv { qd_rad_s: null.into() }).unwrap();
        arm.step();
        let off = arm.state().t_world_tool.translation.vector - start.t_world_tool.translation.vector;
        worst = worst.max(off.norm());
    }
    let turned = arm.state().q_rad[2] - start.q_rad[2];
    println!("third joint turned by {turned:.3} rad, the tool off by {worst:.1e} m");
    // The rates lag by the ticks that the jerk limits need to reach them.
    assert!(turned.abs() > 0.05 && worst < 1e-3);
}

/// Joint commands reach all seven joints; a snapshot continues bit for bit; a six-joint arm refuses a seventh
/// angle.
#[test]
fn all_seven_joints_are_commanded_and_six_refuse_a_seventh() {
    let mut arm = seven_joint_arm("");
    let goal: Joints = std::array::from_fn(|i| arm.state().q_rad[i] + 0.1 * (i as f64 - 3.0));
    arm.command(ArmCommand::MoveJp { q_rad: goal, speed_fraction: 0.5 }).unwrap();
    for _ in 0..200 {
        arm.step();
    }
    let mut other = seven_joint_arm("");
    other.restore(&arm.snapshot()).unwrap();
    let mut used = UsedLimits::default();
    finish(&mut arm, &mut used);
    finish(&mut other, &mut used);
    used.check(1e-8);
    assert_eq!((arm.state().q_rad, arm.state()), (goal, other.state()));

    let mut six = common::arm::arm();
    let mut q_rad = six_joints([0.0, -1.2, 1.8, -2.2, -1.5, 0.0]);
    q_rad[6] = 0.1;
    let refused = six.command(ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 });
    let expected = ArmError::NoSuchJoint { joint: 7, joints: 6, given: 0.1 };
    assert_eq!(refused, Err(expected));
    assert!(expected.to_string().contains("the arm has 6 joints"), "{expected}");
    let mut qd_rad_s = Joints::default();
    qd_rad_s[6] = f64::NAN;
    let refused = six.command(ArmCommand::ServoJv { qd_rad_s });
    assert!(matches!(refused, Err(ArmError::NoSuchJoint { joint: 7, .. })), "{refused:?}");
}
