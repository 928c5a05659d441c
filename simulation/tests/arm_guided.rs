//! The arm's guided motions: joint rates, insertion along an axis, remote centre of motion, and targets of every kind
//! that change at any tick.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use simulation::arm::{
    Arm, ArmCommand, ArmError, ArmMode, ArmParameters, ArmState, COMFORTABLE_Q_RAD, Joints, place_base_for,
};
use std::f64::consts::{PI, TAU};

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

/// Where the tool's base sits on the flange in these tests: beside it, and turned.
fn t_flange_tool() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(0.02, -0.01, 0.09), Vector3::new(0.3, -0.2, 0.5))
}

/// A UR5 that holds its tool comfortably at a pose of the patient frame.
fn arm() -> Arm {
    let mut parameters = ArmParameters::ur5(DT_S);
    parameters.geometry.t_flange_tool = Some(t_flange_tool());
    let wanted = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 0.5, -0.6));
    parameters.t_world_arm_base = place_base_for(&parameters.geometry, &wanted, &COMFORTABLE_Q_RAD);
    Arm::new(parameters, &COMFORTABLE_Q_RAD).unwrap()
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

    /// Within the limits but for Ruckig's own tolerance (1e-8, 1e-10, 1e-12 of the end state; the last tick may change
    /// the acceleration by as much over 1 ms).
    fn check(&self) {
        assert!(self.beyond_rad <= 1e-8, "{self:?}");
        assert!(
            self.velocity <= 1.0 + 1e-8 && self.acceleration <= 1.0 + 1e-8 && self.jerk <= 1.0 + 1e-4,
            "{self:?}"
        );
    }
}

/// Steps until done and looks at every state; returns the ticks it took.
fn finish(arm: &mut Arm, mut look: impl FnMut(&ArmState)) -> usize {
    let mut used = Used::default();
    for ticks in 1..400_000 {
        let before = *arm.state();
        arm.step();
        used.add(arm, &before);
        look(arm.state());
        assert_eq!(arm.state().fault, None);
        if arm.state().done {
            used.check();
            return ticks;
        }
    }
    panic!("the motion does not end");
}

fn run(arm: &mut Arm, ticks: usize) {
    for _ in 0..ticks {
        arm.step();
    }
}

/// Distance of a pivot from the tool's axis.
fn off_axis_m(t_world_tool: &Isometry3<f64>, pivot_world_m: &Vector3<f64>) -> f64 {
    let in_tool = t_world_tool.inverse_transform_point(&Point3::from(*pivot_world_m));
    in_tool.x.hypot(in_tool.y)
}

/// The tool's base `before_m` before the pivot, turned by `turn` about it.
fn about_pivot(
    from: &Isometry3<f64>,
    pivot_m: &Vector3<f64>,
    turn: Vector3<f64>,
    before_m: f64,
) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(turn) * from.rotation;
    let origin = pivot_m - rotation * Vector3::z() * before_m;
    Isometry3::from_parts(Translation3::from(origin), rotation)
}

#[test]
fn the_tool_stands_at_the_flange_through_its_transform() {
    let arm = arm();
    let flange = arm.t_world_flange();
    let apart = (flange * t_flange_tool()).inverse() * arm.state().t_world_tool;
    assert!(apart.translation.vector.norm() < 1e-15 && apart.rotation.angle() < 1e-15);
    // Independent of the tool: the kinematics without one.
    let mut bare = arm.parameters().geometry;
    bare.t_flange_tool = None;
    let expected = arm.parameters().t_world_arm_base * bare.forward(&arm.state().q_rad);
    assert!((expected.translation.vector - flange.translation.vector).norm() < 1e-15);
    let rates = Vector3::new(0.1, 0.2, 0.3);
    let twist = arm.jacobian() * nalgebra::Vector6::new(rates.x, rates.y, rates.z, 0.0, 0.0, 0.0);
    assert!(twist.norm() > 0.01, "the Jacobian is that of the tool's base");
}

#[test]
fn rates_are_reached_and_kept_and_a_joint_stops_at_the_end_of_its_range() {
    let mut arm = arm();
    let rates = [0.4, -0.3, 0.9, 0.0, -0.2, 1.1];
    arm.command(ArmCommand::ServoJv { qd_rad_s: rates }).unwrap();
    let mut used = Used::default();
    let mut elbow_stops_at_tick = None;
    for tick in 0..4_000 {
        let before = *arm.state();
        let state = *arm.step();
        used.add(&arm, &before);
        if tick == 400 {
            assert_eq!(state.qd_rad_s, rates);
            assert_eq!(state.qdd_rad_s2, [0.0; 6]);
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
    // Not beyond, and short of the end by less than a tick's way.
    assert!(state.q_rad[2] <= PI && state.q_rad[2] > PI - 0.9e-3 * 1.01);
    assert_eq!(state.qd_rad_s, [0.4, -0.3, 0.0, 0.0, -0.2, 1.1], "the others go on");
    assert_eq!(state.mode, ArmMode::ServoJv);
    used.check();

    // Outward again: it stays. Back: it goes. Zero: it stops and is done.
    arm.command(ArmCommand::ServoJv { qd_rad_s: [0.0, 0.0, 0.5, 0.0, 0.0, 0.0] }).unwrap();
    run(&mut arm, 1_000);
    assert!(arm.state().done && arm.state().q_rad[2] <= PI);
    arm.command(ArmCommand::ServoJv { qd_rad_s: [0.0, 0.0, -0.5, 0.0, 0.0, 0.0] }).unwrap();
    run(&mut arm, 1_000);
    assert!(arm.state().q_rad[2] < PI - 0.4 && arm.state().fault.is_none());
    arm.command(ArmCommand::ServoJv { qd_rad_s: [0.0; 6] }).unwrap();
    finish(&mut arm, |_| ());
    assert_eq!(arm.state().qd_rad_s, [0.0; 6]);

    let mut fast = [0.0; 6];
    fast[4] = 3.2;
    let refused = arm.command(ArmCommand::ServoJv { qd_rad_s: fast });
    assert!(matches!(refused, Err(ArmError::JointRateOutsideLimits { joint: 5, .. })));
    fast[4] = f64::NAN;
    assert!(arm.command(ArmCommand::ServoJv { qd_rad_s: fast }).is_err());
}

/// `insert` at the feeds of orthopaedic drilling; the line and the orientation are kept, the time is the length by the feed.
#[test]
fn an_insertion_keeps_its_line_its_orientation_and_its_feed() {
    let (mut off_m, mut off_rad) = (0.0f64, 0.0f64);
    for feed_m_s in [0.05e-3, 0.1e-3, 0.15e-3] {
        let mut arm = arm();
        let start = arm.state().t_world_tool;
        let axis_world = (start.rotation * Vector3::new(0.1, -0.2, 1.0)).normalize();
        let mut go = |arm: &mut Arm, depth_m: f64| {
            arm.command(ArmCommand::Insert { axis_world, depth_m, feed_m_s }).unwrap();
            let mut fastest = 0.0f64;
            let ticks = finish(arm, |state| {
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
        // Jerk-limited ends: at 5 m/s³ from 0 to 0.15 mm/s takes 2 sqrt(v/j) = 11 ms, at the mean half the feed.
        let expected = 0.4e-3 / feed_m_s / DT_S;
        assert!((ticks as f64 - expected).abs() < 15.0, "{ticks} ticks, {expected} expected");
        go(&mut arm, 0.6e-3);
        arm.command(ArmCommand::Hold).unwrap();
        go(&mut arm, -0.1e-3);
    }
    println!("insertion off its line by {off_m:.1e} m, off its orientation by {off_rad:.1e} rad");
    // Rounding of poses of 1 m; 1e-6 m was asked for.
    assert!(off_m < 1e-12 && off_rad < 1e-7);
}

#[test]
fn an_insertion_can_be_deepened_paused_and_slowed_on_its_way() {
    let mut arm = arm();
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
    // Smoothly: 1 s at 1 mm/s, without a stop between; the start takes about 2 mm/s times 20 ms.
    assert!((depth(&arm) - 3e-3).abs() < 0.1e-3, "{}", depth(&arm));
    arm.command(ArmCommand::Hold).unwrap();
    run(&mut arm, 500);
    let paused_m = depth(&arm);
    assert!(arm.state().done);
    run(&mut arm, 500);
    assert_eq!(depth(&arm), paused_m);
    arm.command(insert(8e-3, 2e-3)).unwrap();
    finish(&mut arm, |_| ());
    assert!((depth(&arm) - 8e-3).abs() < 1e-12);
    // An axis that is rounded anew is the same one: it began an insertion of its own, whose depth counted from here.
    let rounded = axis_world + Vector3::new(1e-9, -2e-9, 1e-9);
    arm.command(ArmCommand::Insert { axis_world: rounded, depth_m: 9e-3, feed_m_s: 2e-3 }).unwrap();
    finish(&mut arm, |_| ());
    let moved = arm.state().t_world_tool.translation.vector - start.translation.vector;
    assert!((moved - axis_world * 9e-3).norm() < 1e-12, "{moved}");
    arm.command(insert(8e-3, 2e-3)).unwrap();
    finish(&mut arm, |_| ());
    // Another axis: a new insertion from here.
    let sideways = start.rotation * Vector3::x();
    arm.command(ArmCommand::Insert { axis_world: sideways, depth_m: 1e-3, feed_m_s: 2e-3 }).unwrap();
    finish(&mut arm, |_| ());
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
        let mut arm = arm();
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
            finish(&mut arm, |state| {
                off_m = off_m.max(off_axis_m(&state.t_world_tool, &pivot_world_m));
                fastest = fastest.max(state.linear_velocity_m_s.norm());
            });
            let end = arm.state().t_world_tool;
            assert!((end.translation.vector - goal.translation.vector).norm() < 1e-12);
            assert!(end.rotation.angle_to(&goal.rotation) < 1e-7);
        }
    }
    println!("{accepted} of 30 motions about a pivot: off by {off_m:.1e} m, fastest {fastest:.4} m/s");
    assert!(off_m < 1e-12, "rounding; 1e-6 m was asked for");
    assert!(fastest <= 0.05 * (1.0 + 1e-3), "the limit is found at 33 places of the way");
    assert!(accepted >= 25);
}

/// A stop on the way keeps the pivot, and so does the next goal; axes that miss the pivot are refused with the distance.
#[test]
fn a_motion_about_a_pivot_can_be_changed_on_its_way_and_needs_the_pivot_on_the_axis() {
    let mut arm = arm();
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
    finish(&mut arm, |state| assert!(off_axis_m(&state.t_world_tool, &pivot_world_m) < 1e-12));
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

/// A command of any kind; half of them near, so that many are accepted.
fn any_command(uniform: &mut Uniform, arm: &Arm) -> ArmCommand {
    let state = arm.state();
    let reach = if uniform.between(0.0, 1.0) < 0.5 { 0.3 } else { 3.0 };
    let range = |i: usize| if i == 2 { TAU / 2.0 } else { TAU };
    let q_rad: Joints =
        std::array::from_fn(|i| (state.q_rad[i] + uniform.between(-reach, reach)).clamp(-range(i), range(i)));
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
            let fastest = arm.parameters().joint_limits.velocity_rad_s;
            ArmCommand::ServoJv { qd_rad_s: std::array::from_fn(|i| uniform.between(-1.0, 1.0) * fastest[i]) }
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

/// Greatest shares of the tool base's limits used on its paths: speed, acceleration, jerk; turning rate and acceleration.
#[derive(Default, Debug)]
struct UsedByTool {
    /// The arm follows a path, and has come to rest before it if it began in joint motion.
    on_path: bool,
    shares: [f64; 5],
    ticks: usize,
}

impl UsedByTool {
    /// A command has been accepted.
    fn command(&mut self, state: &ArmState, was_at_rest: bool) {
        let path = matches!(state.mode, ArmMode::MoveCp | ArmMode::Insert | ArmMode::Rcm);
        self.on_path = path && (was_at_rest || self.on_path);
    }

    fn add(&mut self, arm: &Arm, before: &ArmState) {
        let (limits, state) = (&arm.parameters().cartesian_limits, arm.state());
        // A motion that is given up stops in the joints.
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
    let mut uniform = Uniform(22);
    let mut used = Used::default();
    let mut tool = UsedByTool::default();
    let mut accepted = [0usize; 8];
    let mut refused = 0;
    let mut arm = arm();
    for count in 0.. {
        if accepted.iter().sum::<usize>() == 10_000 {
            break;
        }
        // Where the arm has run into a corner that refuses most targets, another one takes over.
        if count % 500 == 0 {
            arm = self::arm();
            tool.on_path = false;
        }
        let mut command = any_command(&mut uniform, &arm);
        if matches!(command, ArmCommand::Rcm { .. }) {
            // From motion the arm would first stop with its axis beside the pivot.
            arm.command(ArmCommand::Hold).unwrap();
            finish(&mut arm, |_| ());
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
    used.check();
    // Ruckig's own tolerance, as above, and the rounding of 1 ms steps.
    assert!(tool.ticks > 5_000 && tool.shares.iter().all(|share| *share <= 1.0 + 1e-4), "{tool:?}");
    assert!(accepted.iter().all(|count| *count > 100), "every kind is tried");
}

/// Ruckig's crate carries a cloud client for waypoints. Whatever the arm is told, this process opens no socket.
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
    let mut arm = arm();
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
    let (mut original, mut copy) = (arm(), arm());
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
