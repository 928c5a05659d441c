//! Jerk-limited motion of the arm: limits, straight lines, refusals, snapshots.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use simulation::arm::{
    Arm, ArmCommand, ArmError, ArmMode, ArmParameters, ArmState, AxisLimits, AxisState, COMFORTABLE_Q_RAD,
    Goal, Joints, Planner, Segment, place_base_for,
};
use std::f64::consts::TAU;

const DT_S: f64 = 1e-3;

/// SplitMix64: a fixed stream of uniform numbers.
struct Uniform(u64);

impl Uniform {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn vector(&mut self, range: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.between(-range, range))
    }
}

/// A UR5 whose flange stands at a pose of the patient frame, comfortably.
fn arm() -> Arm {
    let mut parameters = ArmParameters::ur5(DT_S);
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    let q = COMFORTABLE_Q_RAD;
    let base = place_base_for(&parameters.geometry, &wanted, &q);
    parameters.t_world_arm_base = base;
    let Ok(arm) = Arm::new(parameters, &q) else { unreachable!("the UR5's own parameters are valid") };
    arm
}

/// The flange moved by `shift` along its own axes and turned by `turn` about them.
fn moved(from: &Isometry3<f64>, shift: Vector3<f64>, turn: Vector3<f64>) -> Isometry3<f64> {
    from * Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::from_scaled_axis(turn))
}

fn move_cp(t_world_tool: Isometry3<f64>) -> ArmCommand {
    ArmCommand::MoveCp { t_world_tool, max_speed_m_s: None, max_angular_speed_rad_s: None }
}

/// Distance of the flange from the straight line `from`-`to`, and the angle by which its turn misses the fixed-axis turn.
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

/// Greatest shares of the joint limits used between two ticks: position excess (rad), velocity, acceleration, jerk.
#[derive(Default, Debug)]
struct Used {
    beyond_rad: f64,
    velocity: f64,
    acceleration: f64,
    jerk: f64,
}

impl Used {
    fn add(&mut self, arm: &Arm, before: &ArmState) {
        let limits = &arm.parameters().joint_limits;
        let s = arm.state();
        for i in 0..6 {
            let beyond = (s.q_rad[i] - limits.upper_rad[i]).max(limits.lower_rad[i] - s.q_rad[i]);
            self.beyond_rad = self.beyond_rad.max(beyond);
            self.velocity = self.velocity.max(s.qd_rad_s[i].abs() / limits.velocity_rad_s[i]);
            self.acceleration = self.acceleration.max(s.qdd_rad_s2[i].abs() / limits.acceleration_rad_s2[i]);
            let jerk = (s.qdd_rad_s2[i] - before.qdd_rad_s2[i]).abs() / DT_S;
            self.jerk = self.jerk.max(jerk / limits.jerk_rad_s3[i]);
        }
    }

    /// Velocity, acceleration and jerk within their limits but for Ruckig's own tolerance (1e-8, 1e-10, 1e-12 in its
    /// README, of the end state; the last tick may change the acceleration by as much over 1 ms).
    fn check(&self) {
        assert!(self.beyond_rad <= 1e-9, "{self:?}");
        assert!(
            self.velocity <= 1.0 + 1e-8 && self.acceleration <= 1.0 + 1e-8 && self.jerk <= 1.0 + 1e-4,
            "{self:?}"
        );
    }
}

/// Steps until done; returns the ticks it took.
fn finish(arm: &mut Arm, used: &mut Used) -> usize {
    let mut ticks = 0;
    while ticks == 0 || !arm.state().done {
        let before = *arm.state();
        arm.step();
        used.add(arm, &before);
        ticks += 1;
        assert!(ticks < 400_000, "the motion does not end");
    }
    ticks
}

/// Rest-to-rest time over `distance` by symmetric jerk limits: the double-S profile of Biagiotti and Melchiorri,
/// "Trajectory Planning for Automatic Machines and Robots" (2008), section 3.4.
fn rest_to_rest_s(distance: f64, v: f64, a: f64, j: f64) -> f64 {
    let (jerk_s, acceleration_s) =
        if v * j >= a * a { (a / j, a / j + v / a) } else { ((v / j).sqrt(), 2.0 * (v / j).sqrt()) };
    let cruise_s = distance / v - acceleration_s;
    if cruise_s >= 0.0 {
        2.0 * acceleration_s + cruise_s
    } else if v * j >= a * a && distance >= 2.0 * a * a * a / (j * j) {
        jerk_s + (jerk_s * jerk_s + 4.0 * distance / a).sqrt()
    } else {
        4.0 * (distance / (2.0 * j)).cbrt()
    }
}

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
    // Ruckig accepts 1e-8 of the end position; of the smallest distance 1e-3 the third root is 3e-6, seldom reached.
    assert!(worst < 3e-6);
}

#[test]
fn joint_moves_keep_their_limits_end_exactly_and_in_proportion() {
    let mut uniform = Uniform(5);
    let mut used = Used::default();
    for _ in 0..40 {
        let mut arm = arm();
        let start = arm.state().q_rad;
        let goal: Joints =
            std::array::from_fn(|i| uniform.between(-1.0, 1.0) * if i == 2 { 3.1 } else { 6.2 });
        let speed_fraction = uniform.between(0.2, 1.0);
        arm.command(ArmCommand::MoveJp { q_rad: goal, speed_fraction }).unwrap();
        for _ in 0..300 {
            let before = *arm.state();
            let state = *arm.step();
            used.add(&arm, &before);
            let share = (state.q_rad[0] - start[0]) / (goal[0] - start[0]);
            for i in 0..6 {
                let expected = start[i] + share * (goal[i] - start[i]);
                assert!((state.q_rad[i] - expected).abs() < 1e-9, "joints go in proportion");
                assert!(state.qd_rad_s[i].abs() <= speed_fraction * std::f64::consts::PI * (1.0 + 1e-9));
            }
        }
        finish(&mut arm, &mut used);
        assert_eq!(arm.state().q_rad, goal);
        assert_eq!(arm.state().qd_rad_s, [0.0; 6]);
        assert_eq!(arm.state().mode, ArmMode::MoveJp);
    }
    println!("move_jp uses {used:?} of the limits");
    used.check();
}

/// A target that jumps about, also at the limits of the joints, at random ticks, with holds and speed changes.
#[test]
fn a_hostile_servo_never_leaves_the_limits() {
    let mut uniform = Uniform(6);
    let mut arm = arm();
    let mut used = Used::default();
    for tick in 0..100_000 {
        if uniform.between(0.0, 1.0) < if tick < 50_000 { 0.05 } else { 0.001 } {
            let q_rad: Joints = std::array::from_fn(|i| {
                let range = if i == 2 { TAU / 2.0 } else { TAU };
                let any = uniform.between(-1.3, 1.3).clamp(-1.0, 1.0) * range;
                let near = (arm.state().q_rad[i] + uniform.between(-0.2, 0.2)).clamp(-range, range);
                if uniform.between(0.0, 1.0) < 0.5 { any } else { near }
            });
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
    used.check();
}

#[test]
fn a_servo_follows_a_slow_sine_closely() {
    let mut arm = arm();
    let start = arm.state().q_rad;
    let mut worst: f64 = 0.0;
    for tick in 0..4_000 {
        let wave = 0.2 * (1.0 - (tick as f64 * DT_S * TAU * 0.5).cos());
        let q_rad: Joints = std::array::from_fn(|i| start[i] + wave);
        arm.command(ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 }).unwrap();
        arm.step();
        worst = worst.max((arm.state().q_rad[0] - q_rad[0]).abs());
    }
    // The target comes without its velocity, and each plan can stop on it: the lag is the stopping distance's, 0.11 s at
    // 0.63 rad/s and 5 rad/s².
    println!("servo_jp behind a 0.5 Hz, 0.2 rad sine by at most {worst:.3} rad");
    assert!(worst < 0.12);
}

#[test]
fn the_flange_stays_on_its_line() {
    let mut uniform = Uniform(7);
    let (mut off_m, mut off_rad, mut accepted) = (0.0f64, 0.0f64, 0);
    let mut used = Used::default();
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
    assert!(off_m < 1e-12 && off_rad < 1e-11, "rounding only; 1e-6 m was asked for");
    // From the comfortable configuration nearly every direction is open.
    assert!(accepted >= 55);
    used.check();
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
            finish(&mut arm, &mut Used::default());
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
    let ticks = finish(&mut arm, &mut Used::default());
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
    let q_goal = arm.state().q_rad.map(|q| q + 0.3);
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
        let twist = arm.jacobian() * nalgebra::Vector6::from(second.qd_rad_s);
        assert!((twist.fixed_rows::<3>(0) - second.linear_velocity_m_s).norm() < 1e-15);
    }
    println!(
        "central differences differ by {:.1e} m/s, {:.1e} rad/s, {:.1e} m/s²",
        worst[0], worst[1], worst[2]
    );
    // Truncation h²/6 times the third derivative: 2e-7 times the jerks, up to 50 rad/s³ and, at the arm's radius, m/s³.
    // Where the jerk switches, the acceleration's quotient is off by half a tick of the jump, 2 · 50 · 0.5e-3.
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

/// A goal further along the same line and a new speed: no stop, no step off the line. Any other goal: stop, then go.
#[test]
fn a_line_can_be_extended_and_left() {
    let mut arm = arm();
    let from = arm.state().t_world_tool;
    let far = moved(&from, Vector3::new(0.0, 0.0, 0.1), Vector3::zeros());
    arm.command(move_cp(moved(&from, Vector3::new(0.0, 0.0, 0.05), Vector3::zeros()))).unwrap();
    for _ in 0..400 {
        arm.step();
    }
    let mut used = Used::default();
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
    used.check();
}

#[test]
fn a_line_begun_in_joint_motion_waits_for_the_stop() {
    let mut arm = arm();
    let goal = moved(&arm.state().t_world_tool, Vector3::new(0.03, 0.02, 0.05), Vector3::zeros());
    let q_rad = arm.state().q_rad.map(|q| q + 0.5);
    let mut used = Used::default();
    arm.command(ArmCommand::ServoJp { q_rad, speed_fraction: 1.0 }).unwrap();
    for _ in 0..150 {
        arm.step();
    }
    arm.command(move_cp(goal)).unwrap();
    finish(&mut arm, &mut used);
    assert!((arm.state().t_world_tool.translation.vector - goal.translation.vector).norm() < 1e-12);
    used.check();
}

#[test]
fn servo_cp_reaches_its_pose() {
    let mut uniform = Uniform(8);
    let mut arm = arm();
    let home = arm.state().t_world_tool;
    for _ in 0..20 {
        let goal = moved(&home, uniform.vector(0.1), uniform.vector(0.4));
        let mut used = Used::default();
        arm.command(ArmCommand::ServoCp { t_world_tool: goal, speed_fraction: 0.8 }).unwrap();
        finish(&mut arm, &mut used);
        used.check();
        let end = arm.state().t_world_tool;
        assert!((end.translation.vector - goal.translation.vector).norm() < 1e-12);
        assert!(end.rotation.rotation_to(&goal.rotation).vector().norm() < 1e-12);
    }
}

#[test]
fn refused_commands_leave_the_motion_as_it_was() {
    let (mut arm, mut undisturbed) = (arm(), arm());
    let goal = moved(&arm.state().t_world_tool, Vector3::new(0.02, 0.03, 0.06), Vector3::new(0.1, 0.0, 0.2));
    let q_goal = arm.state().q_rad.map(|q| q - 0.4);
    let mut not_a_pose = goal;
    not_a_pose.translation.x = f64::NAN;
    let nan_q = [f64::NAN; 6];
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
    // 5 m away: the line is refused where it leaves the reach or at the stretched arm just before.
    let error = arm.command(move_cp(beyond));
    assert!(matches!(error, Err(ArmError::PathUnreachable { .. } | ArmError::PathSingular { .. })));
}

/// A latched command that is given again every tick moves the arm as if it had been given once.
#[test]
fn a_repeated_command_changes_nothing() {
    let goal =
        moved(&arm().state().t_world_tool, Vector3::new(0.02, 0.03, 0.06), Vector3::new(0.1, 0.0, 0.2));
    let q_rad = arm().state().q_rad.map(|q| q - 0.4);
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

#[test]
fn a_line_through_a_singularity_is_refused() {
    let parameters = ArmParameters::ur5(DT_S);
    // Wrist 2 near straight; the goal is the mirrored wrist: the flange turns through q5 = 0.
    let q = [0.0, -1.2, 1.8, -2.2, 0.3, 0.0];
    let mut arm = Arm::new(parameters, &q).unwrap();
    let goal = parameters.geometry.forward(&[0.0, -1.2, 1.8, -2.2, -0.3, 0.0]);
    let error = arm.command(move_cp(goal)).unwrap_err();
    println!("{error}");
    assert!(matches!(error, ArmError::PathSingular { .. } | ArmError::PathUnreachable { .. }));
    assert!(arm.state().done);
}

/// Broken parameters are refused by name.
#[test]
fn parameters_are_checked() {
    let good = ArmParameters::ur5(DT_S);
    let q = [0.0, -1.2, 1.8, -2.2, -1.5, 0.0];
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
    assert!(matches!(build(good, &[4.0; 6]), Some(ArmError::JointOutsideLimits { joint: 3, .. })));
}

/// A stream of commands of every kind; the same for the same seed.
fn random_command(uniform: &mut Uniform, state: &ArmState) -> ArmCommand {
    let near: Joints = std::array::from_fn(|i| state.q_rad[i] + uniform.between(-0.3, 0.3));
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

/// Snapshot at random ticks into an arm with another past: both continue bit for bit, through later commands too.
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
