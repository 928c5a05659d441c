//! Rigid bodies that controllers drive: wrenches on free ones, poses of driven ones.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built fails the test")]

use std::path::Path;

use messages::{
    BodyMode, Command, CommandSource, Latched, LatchedCommand, Pose, State, TendonMode,
    Wrench as WrenchMessage,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use scene::Scene;
use simulation::Simulation;
use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorModel, ManipulatorParameters, TendonCommand, Wrench,
};
use simulation::rigid::{
    BodyDrive, BodyMotion, BodyParameters, BodyShape, DriveError, FASTEST_DRIVEN, RigidScene, ToolDrive,
};

const DT_S: f64 = 1e-3;

fn block(at_m: [f64; 3], half_m: [f64; 3], motion: BodyMotion) -> BodyParameters {
    BodyParameters {
        name: "block".to_owned(),
        shape: BodyShape::Box { half_extents_m: half_m.into() },
        t_world_body: Isometry3::from_parts(
            Translation3::from(Vector3::from(at_m)),
            UnitQuaternion::identity(),
        ),
        motion,
        density_kg_per_m3: 1000.0,
        friction: 0.0,
    }
}

fn tool(at: Isometry3<f64>) -> Manipulator {
    let parameters = ManipulatorParameters { damping_ratio: 1.0, ..ManipulatorParameters::jhu_27() };
    Manipulator::new(parameters, &BaseMotion::at_rest(at)).unwrap()
}

/// A tool far from the bodies.
fn tool_far_away() -> Manipulator {
    tool(Isometry3::translation(1.0, 0.0, 0.0))
}

fn rigid(bodies: &[BodyParameters], gravity_z: f64) -> RigidScene {
    RigidScene::new(bodies, &Vector3::new(0.0, 0.0, gravity_z), DT_S, 100).unwrap()
}

fn step(rigid: &mut RigidScene, tool: &mut Manipulator, tension_n: f64) {
    let mut planes = Vec::new();
    rigid.find_contacts(tool.proxy_spheres(), 2e-4, &mut planes);
    let tendon = TendonCommand::Force([tension_n, 0.0]);
    let drive = ToolDrive { base: *tool.base(), tendon, tip_wrench: Wrench::zero() };
    rigid.step(tool, &drive, &mut planes).unwrap();
}

fn pose(rigid: &RigidScene, body: usize) -> Isometry3<f64> {
    *rigid.poses().nth(body).unwrap()
}

fn wrench(force_n: [f64; 3], torque_nm: [f64; 3]) -> BodyDrive {
    BodyDrive::Wrench(Wrench { force_n: force_n.into(), torque_nm: torque_nm.into() })
}

#[test]
fn a_free_body_hovers_under_its_weight_and_gains_f_t_over_m() {
    let half = [0.01, 0.02, 0.03];
    let mut scene = rigid(&[block([0.0; 3], half, BodyMotion::Free)], -9.81);
    let (tool, mass_kg) = (&mut tool_far_away(), scene.mass_kg(0).unwrap());
    scene.drive(0, wrench([0.0, 0.0, 9.81 * mass_kg], [0.0; 3])).unwrap();
    (0..1000).for_each(|_| step(&mut scene, tool, 0.0));
    let hovering = pose(&scene, 0).translation.vector;
    scene.drive(0, wrench([0.2, 0.0, 9.81 * mass_kg], [0.0, 0.0, 1e-3])).unwrap();
    (0..500).for_each(|_| step(&mut scene, tool, 0.0));
    let (speed, turning) = scene.velocity(0).unwrap();
    let inertia_kg_m2 = mass_kg / 3.0 * (half[0] * half[0] + half[1] * half[1]);
    let expected = [0.2 * 0.5 / mass_kg, 1e-3 * 0.5 / inertia_kg_m2];
    println!(
        "hovers within {:.1e} m of its place; {:.6} m/s, F t/m {:.6}; {:.6} rad/s, M t/I {:.6}",
        hovering.norm(),
        speed.x,
        expected[0],
        turning.z,
        expected[1]
    );
    assert!(hovering.norm() < 1e-14);
    assert!((speed.x / expected[0] - 1.0).abs() < 1e-9 && (turning.z / expected[1] - 1.0).abs() < 1e-9);
    // Without the wrench it falls.
    scene.drive(0, wrench([0.0; 3], [0.0; 3])).unwrap();
    (0..100).for_each(|_| step(&mut scene, tool, 0.0));
    assert!((scene.velocity(0).unwrap().0.z + 0.981).abs() < 1e-9);
}

/// The tool and a wrench act on the same body: its momentum changes by the sum of their impulses, and the
/// reported wrench is the tool's share.
#[test]
fn tool_and_wrench_give_a_body_the_sum_of_their_impulses() {
    for mass_kg in [1e-3, 1e-2, 0.1] {
        let half = [0.010, 0.01, 0.01];
        let density_kg_per_m3 = mass_kg / (8.0 * half[0] * half[1] * half[2]);
        let body = BodyParameters {
            density_kg_per_m3,
            ..block([0.010 + 0.00425, 0.0, 0.0715], half, BodyMotion::Free)
        };
        let (mut scene, tool) = (rigid(&[body], 0.0), &mut tool(Isometry3::identity()));
        let against = Vector3::new(-0.3, 0.0, 0.0);
        scene.drive(0, wrench(against.into(), [0.0; 3])).unwrap();
        let (mut off, mut pressed_n) = (0.0_f64, 0.0_f64);
        for _ in 0..300 {
            let before = scene.velocity(0).unwrap().0;
            step(&mut scene, tool, 10.0);
            let given_n = scene.tool_wrenches().next().unwrap().force_n;
            let change = (scene.velocity(0).unwrap().0 - before) * mass_kg;
            off = off.max((change - (given_n + against) * DT_S).norm());
            pressed_n = pressed_n.max(given_n.x);
        }
        println!("{mass_kg} kg: the tool presses with up to {pressed_n:.3} N, momentum off by {off:.1e} N s");
        assert!(off < 1e-12 && pressed_n > 0.3);
    }
}

/// A driven plate pushes a free block, carries it along, and is not slowed by it. Goals out of reach are
/// followed at the largest speeds, the short way round.
#[test]
fn a_driven_body_pushes_free_ones_and_follows_far_goals_at_its_largest_speed() {
    let bodies = [
        block([0.0; 3], [0.01; 3], BodyMotion::Driven),
        block([0.021, 0.0, 0.0], [0.01; 3], BodyMotion::Free),
    ];
    let (mut scene, tool) = (rigid(&bodies, 0.0), &mut tool_far_away());
    for k in 1..=100 {
        let goal = Isometry3::translation(5e-5 * f64::from(k), 0.0, 0.0);
        scene.drive(0, BodyDrive::Pose(goal)).unwrap();
        step(&mut scene, tool, 0.0);
        assert_eq!(pose(&scene, 0), goal);
    }
    let pushed = scene.velocity(1).unwrap().0;
    let gap_m = pose(&scene, 1).translation.x - pose(&scene, 0).translation.x - 0.02;
    println!("pushed at {:.6} m/s by a plate at 0.05 m/s; gap {:.1e} m", pushed.x, gap_m);
    // Rapier leaves its allowed error of 50 um, and pushes overlap out slowly.
    assert!((pushed.x - 0.05).abs() < 5e-3 && gap_m.abs() < 6e-5);
    step(&mut scene, tool, 0.0);
    assert_eq!(scene.velocity(0).unwrap().0.norm(), 0.0, "it stays at its goal");

    let mut scene = rigid(&bodies[..1], 0.0);
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * 0.1);
    let other_sign = UnitQuaternion::new_unchecked(-rotation.into_inner());
    let goal = Isometry3::from_parts(Translation3::new(0.0, 0.0, 0.05), other_sign);
    scene.drive(0, BodyDrive::Pose(goal)).unwrap();
    let mut angle = 0.0;
    for k in 1..=50 {
        step(&mut scene, tool, 0.0);
        let at = pose(&scene, 0);
        assert!((at.translation.z - (FASTEST_DRIVEN[0] * DT_S * f64::from(k)).min(0.05)).abs() < 1e-12);
        let (speed, turning) = scene.velocity(0).unwrap();
        assert!((speed.z - 1.0).abs() < 1e-9 && turning.norm() < FASTEST_DRIVEN[1], "{speed} {turning}");
        angle = at.rotation.angle();
    }
    assert!((angle - 0.1).abs() < 1e-12 && pose(&scene, 0).rotation.coords == rotation.coords);
}

#[test]
fn a_body_refuses_a_drive_that_its_motion_does_not_allow() {
    let [free, driven, fixed] = [BodyMotion::Free, BodyMotion::Driven, BodyMotion::Fixed]
        .map(|motion| block([0.0; 3], [0.01; 3], motion));
    let mut scene = rigid(&[free, driven, fixed], 0.0);
    let (push, place) = (wrench([1.0, 0.0, 0.0], [0.0; 3]), BodyDrive::Pose(Isometry3::identity()));
    let outcomes = [0, 1, 2, 3].map(|body| [scene.drive(body, push), scene.drive(body, place)]);
    use DriveError::{NoBody, NotDriven, NotFree};
    let expected = [
        [Ok(()), Err(NotDriven)],
        [Err(NotFree), Ok(())],
        [Err(NotFree), Err(NotDriven)],
        [Err(NoBody), Err(NoBody)],
    ];
    assert_eq!(outcomes, expected);
}

/// A plate 0.75 mm beside the burr, on the side to which the tool bends, and a ball far away.
const SCENE: &str = r#"
name = "driven"
[run]
mode = "lockstep"
duration_s = 60.0
[manipulator]
damping_ratio = 1.0
[contact]
friction = 0.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[body]]
name = "plate"
cuboid = { half_extents_mm = [2.0, 20.0, 2.0] }
motion = "driven"
position_mm = [6.0, 0.0, 0.0]
[[body]]
name = "ball"
ball = { radius_mm = 5.0 }
motion = "free"
position_mm = [100.0, 0.0, 0.0]
[[controller]]
name = "plate"
drives = ["body"]
body = "plate"
external = true
[[controller]]
name = "ball"
drives = ["body", "tendon"]
body = "ball"
external = true
"#;

fn simulation() -> Simulation<'static> {
    Simulation::new(&Scene::parse(SCENE, Path::new("driven.toml")).unwrap(), None).unwrap()
}

fn latched(tick: u64, source: CommandSource, commands: [Command; 2]) -> Latched {
    let mut latched = Latched { tick, controller_count: 2, ..Latched::zeroed() };
    for (index, command) in commands.into_iter().enumerate() {
        let controller_index = index as u32;
        latched.commands[index] =
            LatchedCommand { source: source.code(), controller_index, age_ticks: 0, command };
    }
    latched
}

/// The plate moved by `x_m` from its start.
fn place(x_m: f64) -> Command {
    let t_world_body_goal =
        Pose { position_m: [0.006 + x_m, 0.0, 0.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
    Command { sequence: 1, body_mode: BodyMode::ServoCp.code(), t_world_body_goal, ..Command::zeroed() }
}

fn push(force_n: [f64; 3], tension_n: f64) -> Command {
    Command {
        sequence: 1,
        body_mode: BodyMode::ServoCf.code(),
        body_wrench: WrenchMessage { force_n, torque_nm: [0.0; 3] },
        tendon_mode: TendonMode::ServoJf.code(),
        tendon_force_n: [tension_n, 0.0, 0.0, 0.0],
        ..Command::zeroed()
    }
}

/// The plate moves by a sine: the tip keeps to its face, with the force that the flange carries, and the
/// plate's work is the ledger's.
#[test]
fn a_plate_that_moves_by_a_sine_pushes_the_tip_with_the_force_that_it_gets() {
    let mut simulation = simulation();
    let (mut worst_gap_m, mut most_n, mut work_j) = (0.0_f64, 0.0_f64, 0.0);
    let (mut worst_flange, mut slip_m) = (0.0_f64, 0.0_f64);
    for tick in 0..2000 {
        let x_m = -0.0015 * (1.0 - (core::f64::consts::TAU * (tick + 1) as f64 * DT_S).cos());
        let before_m = simulation.state().t_world_body[0].position_m[0];
        let commands = [place(x_m), push([0.0; 3], 0.0)];
        simulation.step(&latched(tick, CommandSource::Fresh, commands)).unwrap();
        assert!(simulation.refusals().is_empty(), "{:?}", simulation.refusals());
        let state = *simulation.state();
        let at_m = Vector3::from(state.t_world_body[0].position_m);
        assert_eq!(at_m, Vector3::new(0.006 + x_m, 0.0, 0.0), "tick {tick}");
        // The contacts of this scene are those on the plate.
        let on_plate = Vector3::from(state.wrench_on_body[0].force_n);
        let (mut force_n, mut torque_nm) = (Vector3::zeros(), Vector3::zeros());
        for contact in &state.contacts[..state.contact_count as usize] {
            let pushed_n = -(Vector3::from(contact.normal) * contact.normal_force_n)
                - Vector3::from(contact.friction_force_n);
            force_n += pushed_n;
            // About the centre at the start of the tick.
            torque_nm += (Vector3::from(contact.point_m) - Vector3::new(before_m, 0.0, 0.0)).cross(&pushed_n);
        }
        assert_eq!(on_plate, force_n, "tick {tick}");
        assert!((torque_nm - Vector3::from(state.wrench_on_body[0].torque_nm)).norm() < 1e-12);
        assert_eq!(state.wrench_on_body[1], WrenchMessage::zeroed());
        if on_plate.x > 0.03 {
            let gap_m = at_m.x - 0.002 - (state.t_world_burr.position_m[0] + 3.25e-3);
            worst_gap_m = worst_gap_m.max(gap_m.abs());
            let flange_n = Vector3::from(state.flange_wrench.force_n);
            worst_flange = worst_flange.max((flange_n.x + on_plate.x).abs() / on_plate.x);
            slip_m = slip_m.max(state.t_world_burr.position_m[1].abs());
        }
        most_n = most_n.max(on_plate.x);
        work_j -= on_plate.x * (at_m.x - before_m);
    }
    let state = *simulation.state();
    println!(
        "up to {most_n:.4} N; the burr within {:.3} um of the face; flange off by {:.2} %; work {:.4} of {work_j:.4e} J",
        worst_gap_m * 1e6,
        worst_flange * 1e2,
        state.body_work_j / work_j,
    );
    assert!(most_n > 0.1 && worst_gap_m < 2e-6 && worst_flange < 0.01 && slip_m < 1e-9);
    // What the tool gives back is almost what it took.
    assert!((state.body_work_j - work_j).abs() < 0.02 * most_n * 0.0015, "{} J", state.body_work_j);
    let in_j = state.tendon_work_j + state.arm_work_j + state.gravity_work_j + state.body_work_j;
    let lost_j = state.friction_energy_j + state.damping_energy_j + state.numerical_energy_j;
    assert!((in_j - state.tool_energy_j - lost_j).abs() < 1e-12);
    assert_eq!(state.energy_created_j, 0.0);
}

/// A plate at 0.5 m/s, ten times as fast as overlap is pushed out, carries the tip along without overlap; one
/// that slides by drags it sideways with the friction of the cone.
#[test]
fn a_fast_plate_carries_the_tip_along_and_a_sliding_one_drags_it() {
    let text = SCENE.replace("friction = 0.0", "friction = 0.2");
    for model in ["constant_curvature", "modal", "planar", "spatial", "full"] {
        let text = text.replace("damping_ratio", &format!("model = \"{model}\"\ndamping_ratio"));
        let scene = Scene::parse(&text, Path::new("driven.toml")).unwrap();
        let mut simulation = Simulation::new(&scene, None).unwrap();
        let mut overlap_m = 0.0_f64;
        let mut run = |command: Command| {
            let tick = simulation.state().tick;
            let commands = [command, push([0.0; 3], 0.0)];
            simulation.step(&latched(tick, CommandSource::Fresh, commands)).unwrap();
            let contacts = &simulation.state().contacts[..simulation.state().contact_count as usize];
            overlap_m = contacts.iter().fold(overlap_m, |most, contact| most.max(-contact.gap_m));
            *simulation.state()
        };
        // By 2 mm toward the tool, of which 1.25 mm push it.
        for k in 1..=4 {
            run(place(-5e-4 * f64::from(k)));
        }
        let rest = (0..300).map(|_| run(place(-2e-3))).last().unwrap();
        let pushed = rest.wrench_on_body[0].force_n;
        let mut slide = |y_m: f64| {
            let mut command = place(-2e-3);
            command.t_world_body_goal.position_m[1] = y_m;
            run(command)
        };
        let mut ratios = [0.0; 2];
        for k in 1..=150 {
            let state = slide(2e-5 * f64::from(k));
            ratios[0] = state.wrench_on_body[0].force_n[1] / state.wrench_on_body[0].force_n[0];
        }
        for k in 1..=150 {
            let state = slide(3e-3 - 2e-5 * f64::from(k));
            ratios[1] = state.wrench_on_body[0].force_n[1] / state.wrench_on_body[0].force_n[0];
        }
        println!(
            "{model}: pressed with {:.4} N, overlap up to {:.2} um, friction {:.4} and {:.4} of the force",
            pushed[0],
            overlap_m * 1e6,
            ratios[0],
            ratios[1]
        );
        assert!(pushed[0] > 0.03 && overlap_m < 5e-6, "{model}");
        // The plate slides toward +y and back: the tool holds it back.
        assert!((ratios[0] + 0.2).abs() < 0.02 && (ratios[1] - 0.2).abs() < 0.02, "{model}: {ratios:?}");
    }
}

/// A wrench and a goal far away last until the next command, through snapshots, keyframes and mode 0. A
/// reset ends both.
#[test]
fn drives_last_through_keyframes_and_end_with_a_reset() {
    let (mut whole, mut other) = (simulation(), simulation());
    let far = [place(-0.004), push([1e-3, 0.0, 0.0], 3.0)];
    whole.step(&latched(0, CommandSource::Fresh, far)).unwrap();
    whole.step(&latched(1, CommandSource::Fresh, [Command::zeroed(); 2])).unwrap();
    let mut bytes = vec![0; 1 << 20];
    let length = whole.write_keyframe(&mut bytes).unwrap();
    let saved = whole.snapshot();
    let mut hashes = Vec::new();
    let run = |simulation: &mut Simulation<'_>| {
        (2..200).for_each(|tick| simulation.step(&latched(tick, CommandSource::Held, far)).unwrap());
        simulation.state().hash
    };
    hashes.push(run(&mut whole));
    let ended = *whole.state();
    assert_eq!(ended.t_world_body[0].position_m, [0.006 - 0.004, 0.0, 0.0]);
    assert!(ended.wrench_on_body[0].force_n[0] > 0.1, "{:?}", ended.wrench_on_body[0]);
    let moved_m = ended.t_world_body[1].position_m[0] - 0.1;
    let mass_kg = 1900.0 * 4.0 / 3.0 * core::f64::consts::PI * 0.005_f64.powi(3);
    // Semi-implicit Euler in four substeps of a tick: n (n + 1) instead of n^2.
    let expected_m = 0.5 * 1e-3 / mass_kg * 0.2 * (0.2 + DT_S / 4.0);
    println!("the ball moved by {:.6} mm, F t^2 / 2 m {:.6} mm", moved_m * 1e3, expected_m * 1e3);
    assert!((moved_m / expected_m - 1.0).abs() < 1e-9);
    other.restore_keyframe(&bytes[..length]).unwrap();
    hashes.push(run(&mut other));
    other.restore(&saved).unwrap();
    hashes.push(run(&mut other));
    assert_eq!(hashes, [hashes[0]; 3]);
    // A reset in the middle of both.
    whole.restore(&saved).unwrap();
    let mut start = latched(2, CommandSource::None, [Command::zeroed(); 2]);
    start.reset = 1;
    whole.step(&start).unwrap();
    for tick in 3..50 {
        whole.step(&latched(tick, CommandSource::None, [Command::zeroed(); 2])).unwrap();
    }
    let poses = |state: &State| [state.t_world_body[0], state.t_world_body[1]];
    assert_eq!(poses(whole.state()), poses(simulation().state()));
}

/// Regression: a ball that a controller had pushed went on to gain speed after the controller's end.
#[test]
fn the_safe_command_ends_a_wrench_and_leaves_a_driven_body_where_it_goes() {
    let mut simulation = simulation();
    let far = [place(-0.004), push([1e-3, 0.0, 0.0], 0.0)];
    simulation.step(&latched(0, CommandSource::Fresh, far)).unwrap();
    let speed = |simulation: &mut Simulation<'_>, tick| {
        let before_m = simulation.state().t_world_body[1].position_m[0];
        simulation.step(&latched(tick, CommandSource::Safe, [Command::zeroed(); 2])).unwrap();
        simulation.state().t_world_body[1].position_m[0] - before_m
    };
    let first = speed(&mut simulation, 1);
    let last = (2..100).map(|tick| speed(&mut simulation, tick)).last().unwrap();
    assert!(first > 0.0 && (last / first - 1.0).abs() < 1e-9, "{first} m a tick, then {last}");
    assert_eq!(simulation.state().t_world_body[0].position_m, [0.006 - 0.004, 0.0, 0.0]);
}

#[test]
fn a_command_that_does_not_suit_the_body_is_refused() {
    let mut simulation = simulation();
    let commands = [push([1.0, 0.0, 0.0], 0.0), place(0.0)];
    simulation.step(&latched(0, CommandSource::Fresh, commands)).unwrap();
    let reasons: Vec<&str> = simulation.refusals().iter().map(|refusal| refusal.reason.as_str()).collect();
    assert_eq!(
        reasons,
        [
            "body: servo_cf needs a body whose `motion` is \"free\"; use servo_cp for a driven one",
            "body: servo_cp needs a body whose `motion` is \"driven\"; use servo_cf for a free one"
        ]
    );
}
