//! Any number of tendons, in channels anywhere in the cross-section, against closed forms.
#![allow(clippy::unwrap_used, reason = "a helper that fails is a failed test")]

use messages::{Command, SOURCE_FRESH, TENDON_SERVO_JF, TENDON_SERVO_JP};
use nalgebra::Vector3;
use simulation::Simulation;
use simulation::manipulator::{
    AnyManipulator, Integrator, ManipulatorModel, ManipulatorParameters, Rung, StepInput, TendonCommand,
    TendonRoute, Wrench,
};

use crate::common::{latched, rest, scene, try_scene, wall_at};

const LENGTH_M: f64 = 0.035;
const RIGIDITY_NM2: f64 = 1.3369e-3;
const OFFSET_M: f64 = 2.0e-3;

/// A round beam, critically damped, on a mount stiff enough to be negligible, without shear (thin).
fn beam(links: usize, channels_m: &[[f64; 2]]) -> ManipulatorParameters {
    let mut p = ManipulatorParameters::uniform_beam(links, LENGTH_M, RIGIDITY_NM2);
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    p.tube_radii_m = [1e-5, 0.0];
    p.tendon.offset_m = OFFSET_M;
    p.lateral_stiffness_ratio = Some(1.0);
    let routes = || channels_m.iter().map(|channel_m| TendonRoute::from(*channel_m)).collect();
    p.tendon_routes = (!channels_m.is_empty()).then(routes);
    p
}

fn settled(
    rung: Rung,
    p: ManipulatorParameters,
    tendon: TendonCommand,
    moment_nm: Vector3<f64>,
) -> AnyManipulator {
    let base = rest();
    let mut m = AnyManipulator::new(rung, p, &base).unwrap();
    let tip_wrench = Wrench { torque_nm: moment_nm, ..Wrench::zero() };
    for _ in 0..400 {
        m.step(1e-3, &StepInput { base, tendon, tip_wrench, contacts: &[] }).unwrap();
    }
    m
}

fn tip_m(m: &AnyManipulator) -> Vector3<f64> {
    m.t_world_tip().translation.vector
}

/// Tip of an arc bent by a tension in its channel's plane.
fn arc_m(tension_n: f64, channel_m: [f64; 2]) -> Vector3<f64> {
    let offset_m = channel_m[0].hypot(channel_m[1]);
    let bend = tension_n * offset_m * LENGTH_M / RIGIDITY_NM2;
    let across = (1.0 - bend.cos()) * LENGTH_M / bend;
    let [x, y] = channel_m.map(|x| x / offset_m * across);
    Vector3::new(x, y, bend.sin() * LENGTH_M / bend)
}

#[test]
fn each_tendon_bends_toward_its_channel() {
    let channels = [[OFFSET_M, 0.0], [0.0, OFFSET_M], [-OFFSET_M, 0.0], [0.0, -OFFSET_M]];
    for rung in [Rung::Spatial, Rung::Full] {
        for (t, channel) in channels.into_iter().enumerate() {
            let mut tension_n = [0.0; 4];
            tension_n[t] = 12.0;
            let m = settled(rung, beam(26, &channels), TendonCommand::EachForce(tension_n), Vector3::zeros());
            let off_m = (tip_m(&m) - arc_m(12.0, channel)).norm();
            println!("{rung:?}, tendon {t}: {off_m:.2e} m off the arc");
            // The chain's own error at 26 links (9.6 um at 90 degrees, this is 36), and the chord d cos(q/2).
            assert!(off_m < 10e-6, "{rung:?} {t} {off_m}");
        }
    }
}

#[test]
fn two_orthogonal_tendons_bend_in_the_plane_between_them() {
    for rung in [Rung::Spatial, Rung::Full] {
        let off = |links: usize| {
            let p = beam(links, &[[OFFSET_M, 0.0], [0.0, OFFSET_M]]);
            let m = settled(rung, p, TendonCommand::Force([9.0, 9.0]), Vector3::zeros());
            // Two equal tensions equal twice the tension halfway between the channels.
            (tip_m(&m) - arc_m(18.0, [0.5 * OFFSET_M; 2])).norm()
        };
        let (coarse, fine) = (off(16), off(32));
        println!("{rung:?}: {coarse:.2e} m off at 16 links, {fine:.2e} m at 32");
        // A flexure rotates about two axes one after the other, which twists it by half the product of the
        // angles; over the tool theta^2 / (4 n), 3.5e-3 rad at 32 links, on a deflection of 11 mm: first
        // order, a dozen micrometres.
        assert!(fine < coarse / 1.8 && fine < 30e-6, "{coarse} {fine}");
    }
}

/// An elastic tendon held at its actuator adds `kt d^2` to the moment per bend of the whole tool while it is
/// taut; a slack one adds nothing.
#[test]
fn pretension_keeps_both_tendons_taut_and_stiffens() {
    let (moment, n) = (1.0e-3, 20.0);
    for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
        for (pull_m, taut) in [(0.0, 1.0), (0.3e-3, 2.0)] {
            let p = beam(n as usize, &[]);
            let (k, kt) = (p.joint_stiffness_nm_per_rad[0], p.tendon.stiffness_n_per_m);
            let m = settled(rung, p, TendonCommand::Displacement([pull_m; 2]), Vector3::y() * moment);
            let expected = moment * n / (k + taut * kt * OFFSET_M * OFFSET_M * n);
            println!("{rung:?}, pulled by {pull_m}: {} rad, {expected} expected", m.bend_rad());
            // The chord's cosine, and in the full rung the shortening by the pretension: the angle is at most
            // 2e-3 rad per flexure.
            assert!((m.bend_rad() / expected - 1.0).abs() < 1e-4, "{rung:?} {} {expected}", m.bend_rad());
        }
    }
}

#[test]
fn four_elastic_tendons_stiffen_both_planes() {
    let channels = [[OFFSET_M, 0.0], [0.0, OFFSET_M], [-OFFSET_M, 0.0], [0.0, -OFFSET_M]];
    let (moment, n) = (Vector3::new(0.4e-3, 0.9e-3, 0.0), 20.0);
    for rung in [Rung::Spatial, Rung::Full] {
        let p = beam(n as usize, &channels);
        let (k, kt) = (p.joint_stiffness_nm_per_rad[0], p.tendon.stiffness_n_per_m);
        let m = settled(rung, p, TendonCommand::EachDisplacement([0.3e-3; 4]), moment);
        let stiff = (k + 2.0 * kt * OFFSET_M * OFFSET_M * n) / n;
        // A moment about y bends toward +x, one about x toward -y; the rotation of the tip is moment over
        // stiffness.
        let turn = m.t_world_tip().rotation.scaled_axis();
        println!("{rung:?}: turned by {turn:?}, expected {:?}", moment / stiff);
        // The planes couple at second order in the rotation, 0.01 rad.
        assert!((turn - moment / stiff).norm() < 2e-4 * turn.norm(), "{turn} {}", moment / stiff);
    }
}

/// Equal tensions T on both sides of a flexure with a free gap g bend it further by `2 T g/2 sin(q/2)`: it
/// buckles at T = 2 k / g.
#[test]
fn equal_pulls_buckle_at_the_critical_tension() {
    for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
        for (share, buckles) in [(0.98, false), (1.02, true)] {
            let mut p = beam(8, &[]);
            p.tendon.gap_m = 1.0e-3;
            p.damping_ratio = 0.05;
            let critical = 2.0 * p.joint_stiffness_nm_per_rad[0] / p.tendon.gap_m;
            let base = rest();
            let mut m = AnyManipulator::new(rung, p, &base).unwrap();
            let tendon = TendonCommand::Force([share * critical; 2]);
            for k in 0..1500 {
                let push = if k < 20 { 1e-5 } else { 0.0 };
                let tip_wrench = Wrench { torque_nm: Vector3::y() * push, ..Wrench::zero() };
                m.step(1e-3, &StepInput { base, tendon, tip_wrench, contacts: &[] }).unwrap();
            }
            println!("{rung:?} at {share} of {critical:.0} N: {:.2e} rad", m.bend_rad());
            assert_eq!(m.bend_rad().abs() > 1e-2, buckles, "{rung:?} {share} {}", m.bend_rad());
        }
    }
}

/// Pulls with a half-second ramp; returns the speed of the fastest flexure two seconds later, rad/s.
fn left_swinging_rad_per_s(
    rung: Rung,
    p: ManipulatorParameters,
    pull: impl Fn(f64) -> TendonCommand,
    dt_s: f64,
) -> f64 {
    let base = rest();
    let mut m = AnyManipulator::new(rung, p, &base).unwrap();
    let steps = (2.5 / dt_s) as usize;
    let mut fastest = 0.0_f64;
    for k in 0..steps {
        let tendon = pull((k as f64 * dt_s / 0.5).min(1.0));
        m.step(dt_s, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] }).unwrap();
        if k + 50 >= steps {
            fastest = m.joint_velocities_rad_per_s().iter().fold(fastest, |a, b| a.max(b.abs()));
        }
    }
    fastest
}

/// Regression: a saturated tendon was assumed to keep sliding as in the last step. Where it reversed in every
/// step, its friction drove the flexures back and forth forever, at up to 18 rad/s.
#[test]
fn a_tendon_that_turns_within_a_step_does_not_drive_the_tool() {
    let force: fn(f64) -> TendonCommand = |share| TendonCommand::Force([10.0 * share, 0.0]);
    let short: fn(f64) -> TendonCommand = |share| TendonCommand::Displacement([1.8e-3 * share, 0.0]);
    let middle: fn(f64) -> TendonCommand = |share| TendonCommand::Displacement([3.0e-3 * share, 0.0]);
    let long: fn(f64) -> TendonCommand = |share| TendonCommand::Displacement([6.0e-3 * share, 0.0]);
    for rung in Rung::ALL {
        let mut fastest = 0.0_f64;
        for integrator in [Integrator::LinearlyImplicitEuler, Integrator::Hybrid] {
            for (dt_s, friction) in [(1e-3, 0.3), (5e-3, 0.1), (5e-3, 0.3), (10e-3, 0.1), (10e-3, 0.3)] {
                for pull in [force, short, middle, long] {
                    let mut p = ManipulatorParameters { integrator, ..ManipulatorParameters::jhu_27() };
                    p.tendon.friction_coefficient = friction;
                    let rate = left_swinging_rad_per_s(rung, p, pull, dt_s);
                    // A tool at rest; a decaying swing is below this after two seconds at the standard
                    // damping.
                    assert!(
                        rate < 1e-3,
                        "{rung:?} {integrator:?} {dt_s} {friction} {:?}: {rate} rad/s",
                        pull(1.0)
                    );
                    fastest = fastest.max(rate);
                }
            }
        }
        println!("{rung:?}: at most {fastest:.1e} rad/s left");
    }
}

/// Bend (rad) and take-up (m) of the standard tool at rest under a tension, flexure by flexure: `k q = T d
/// cos(q/2) exp(-mu s phi)`, minus the torque of a stop beyond 5 degrees, each solved by bisection.
fn bend_at_rest(p: &ManipulatorParameters, tension_n: f64, sliding: f64) -> (f64, f64) {
    let (mut wrap, mut take_up_m) = (0.0, 0.0);
    for k in &p.joint_stiffness_nm_per_rad {
        let unbalanced = |q: f64| {
            let share = (-p.tendon.friction_coefficient * sliding * (wrap + 0.5 * q)).exp();
            let stop = p.joint_stop_stiffness_nm_per_rad * (q - p.joint_limit_rad).max(0.0);
            tension_n * share * p.tendon.offset_m * (0.5 * q).cos() - k * q - stop
        };
        let (mut low, mut high) = (0.0, 0.5);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            *(if unbalanced(middle) > 0.0 { &mut low } else { &mut high }) = middle;
        }
        wrap += low;
        take_up_m += 2.0 * p.tendon.offset_m * (0.5 * low).sin();
    }
    (wrap, take_up_m)
}

/// Flexures on their stops, and a wall that lifts the tool off them at 20 mm/s. As rows of the contact
/// solver, the stops did not converge in 40 Gauss-Seidel sweeps.
#[test]
fn a_wall_takes_a_tool_off_its_stops_within_the_tolerance() {
    let base = rest();
    let p = ManipulatorParameters::jhu_27();
    for rung in [Rung::Planar, Rung::Spatial] {
        for dt_s in [1e-3, 5e-3] {
            let mut m = AnyManipulator::new(rung, p.clone(), &base).unwrap();
            let (mut iterations, mut most, mut fewest_stops) = (0, 0, 99);
            let steps = (1.0 / dt_s) as usize;
            for k in 0..2 * steps {
                let time_s = k as f64 * dt_s;
                let planes = wall_at(&m, if k < steps { 1.0 } else { 0.032 - 0.02 * (time_s - 1.0) });
                let tendon = TendonCommand::Force([25.0 * time_s.min(1.0), 0.0]);
                let input = StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &planes };
                let report = m.step(dt_s, &input).unwrap();
                if k >= steps {
                    iterations += report.contact_iterations;
                    most = most.max(report.contact_iterations);
                    fewest_stops = fewest_stops.min(report.stopped_joint_count);
                }
            }
            let mean = iterations as f64 / steps as f64;
            println!(
                "{rung:?}, {dt_s} s: {mean:.1} iterations per step, {most} at most, {fewest_stops} stops at \
                 least"
            );
            // One contact and one stop about to change: one or two Newton iterations.
            assert!(mean < 4.0 && most < 40 && fewest_stops > 0, "{rung:?} {dt_s}: {mean} {most}");
        }
    }
}

/// Released slowly from 14 N, where flexures are on their stops: the tool follows the law with the sliding
/// state of the play operator. The stops hold flexures that would reverse the tendon if they were free.
#[test]
fn a_tendon_that_is_let_out_follows_the_play_operator_off_the_stops() {
    for friction in [0.1, 0.2, 0.3] {
        let mut p = ManipulatorParameters::jhu_27();
        p.tendon.friction_coefficient = friction;
        let (_, most_m) = bend_at_rest(&p, 14.0, 1.0);
        let exact = |tension_n: f64| {
            let (mut low, mut high) = (-1.0, 1.0);
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                let play = 1.0 - (most_m - bend_at_rest(&p, tension_n, middle).1) / p.tendon.presliding_m;
                *(if middle > play { &mut high } else { &mut low }) = middle;
            }
            bend_at_rest(&p, tension_n, low).0.to_degrees()
        };
        for rung in [Rung::Planar, Rung::Spatial] {
            for dt_s in [1e-3, 5e-3] {
                let base = rest();
                let mut m = AnyManipulator::new(rung, p.clone(), &base).unwrap();
                let steps = (8.0 / dt_s) as usize;
                let mut worst_deg = 0.0_f64;
                for k in 0..2 * steps {
                    let tension_n = 14.0 * if k <= steps { k } else { 2 * steps - k } as f64 / steps as f64;
                    let tendon = TendonCommand::Force([tension_n, 0.0]);
                    m.step(dt_s, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] })
                        .unwrap();
                    // At 11.9, 10.5, ... 2.1 N.
                    if k > steps && k % (steps / 10) == steps / 20 && tension_n > 2.0 && tension_n < 12.0 {
                        worst_deg = worst_deg.max((m.bend_rad().to_degrees() - exact(tension_n)).abs());
                    }
                }
                println!("{rung:?}, friction {friction}, {dt_s} s: at most {worst_deg:.3} degrees off");
                // The tension falls by 9 mN within a step of 5 ms, which is 0.08 degrees.
                assert!(worst_deg < 0.08, "{rung:?} {friction} {dt_s}: {worst_deg}");
            }
        }
    }
}

/// One step of the antagonist pair given as channels equals that of the pair, bit for bit.
#[test]
fn the_pair_as_channels_is_the_pair() {
    let mut p = ManipulatorParameters::jhu_27();
    p.tendon.friction_coefficient = 0.2;
    let d = p.tendon.offset_m;
    let named =
        ManipulatorParameters { tendon_routes: Some(vec![[d, 0.0].into(), [-d, 0.0].into()]), ..p.clone() };
    let base = rest();
    for rung in Rung::ALL {
        let [mut a, mut b] = [&p, &named].map(|p| AnyManipulator::new(rung, p.clone(), &base).unwrap());
        for k in 0..60 {
            let pair = if k < 30 { [6.0, 0.5] } else { [1.5, 0.2] };
            let each = TendonCommand::EachForce([pair[0], pair[1], 0.0, 0.0]);
            for (m, tendon) in [(&mut a, TendonCommand::Force(pair)), (&mut b, each)] {
                m.step(1e-3, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] }).unwrap();
            }
        }
        assert_eq!(a.snapshot(), b.snapshot(), "{rung:?}");
    }
}

#[test]
fn a_scenes_tendons_are_commanded_one_by_one() {
    let text = r#"
name = "three_tendons"
[run]
mode = "lockstep"
duration_s = 1.0
[manipulator]
model = "spatial"
damping_ratio = 1.0
lateral_stiffness_ratio = 1.0
torsion_stiffness_ratio = 0.75
[[tendon]]
toward_mm = 2.5
[[tendon]]
toward_mm = -1.25
across_mm = 2.165
[[tendon]]
toward_mm = -1.25
across_mm = -2.165
"#;
    let flat = text.replace("spatial", "planar");
    let refused = try_scene(&flat).unwrap_err().to_string();
    assert!(refused.contains("`tendon.across_mm` bends the tool out of the plane"), "{refused}");
    let scene = scene(text);
    let mut simulation = Simulation::new(&scene, None).unwrap();
    assert_eq!(simulation.state().tendon_count, 3);
    let start = simulation.state().t_world_burr.position_m;
    let mut go = |mode: u32, values: [f64; 4]| {
        let mut command = Command { sequence: 1, tendon_mode: mode, ..Command::zeroed() };
        command.tendon_force_n = values;
        command.tendon_displacement_m = values;
        for tick in 0..300 {
            simulation.step(&latched(tick, SOURCE_FRESH, 0, command)).unwrap();
        }
        *simulation.state()
    };
    // The second tendon: 120 degrees about the direction, from `bend_toward` toward direction times it, which
    // is +y.
    let state = go(TENDON_SERVO_JF, [0.0, 4.0, 0.0, 9.0]);
    let moved = [0, 1].map(|i| state.t_world_burr.position_m[i] - start[i]);
    assert!(moved[0] < -1e-3 && (moved[1] / moved[0] + 3.0_f64.sqrt()).abs() < 0.05, "{moved:?}");
    assert_eq!(state.tendon_tension_n, [0.0, 4.0, 0.0, 0.0]);
    // All three pulled equally: straight, and every tension is the pull times the stiffness.
    let state = go(TENDON_SERVO_JP, [1e-4, 1e-4, 1e-4, 0.0]);
    assert!(
        state.tendon_tension_n[..3].iter().all(|t| (t - 3.0).abs() < 1e-3),
        "{:?}",
        state.tendon_tension_n
    );
    assert!((0..2).all(|i| (state.t_world_burr.position_m[i] - start[i]).abs() < 1e-6));
}
