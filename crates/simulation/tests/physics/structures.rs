//! Clearances from critical structures, their events, and the stop of the arm.
#![allow(clippy::unwrap_used, missing_docs)]

use crate::common::{feed, scene};
use messages::{Approach, ArmMode, ArmProtectiveStop, Command, Latched, SensorKind, State, TendonMode};
use nalgebra::Vector3;
use simulation::Simulation;

/// In front of the burr, 12 mm away: a ball; beside its path, 10 mm away: a vessel.
const STRUCTURES: &str = r#"
name = "near"
run = { mode = "lockstep", duration_s = 10.0 }
[[structure]]
name = "ball"
margin_mm = 3.0
ball = { centre_mm = [1.0, 0.0, 20.0], radius_mm = 5.0 }
[[structure]]
name = "vessel"
margin_mm = 1.0
tube = { points_mm = [[0.0, 12.0, -50.0], [0.0, 12.0, 0.0], [0.0, 12.0, 50.0]], radius_mm = 2.0 }
"#;
const BURR_M: f64 = 3.25e-3;

fn simulation(text: &str) -> Simulation<'static> {
    Simulation::new(&scene(text), None).unwrap()
}

/// Returns the clearances of the present state.
fn clearances_m(simulation: &Simulation<'_>) -> [f64; 2] {
    let reading = simulation.readings().first().unwrap();
    assert_eq!((reading.kind(), reading.tick), (Ok(SensorKind::Clearance), simulation.state().tick));
    [reading.value[0], reading.value[2]]
}

fn burr_m(state: &State) -> Vector3<f64> {
    state.t_world_burr.position_m.into()
}

/// Feeds and returns the approaches with their ticks.
fn feed(simulation: &mut Simulation<'_>, ticks: u64) -> Vec<(Approach, u64)> {
    let mut found = Vec::new();
    for _ in 0..ticks {
        let tick = simulation.state().tick;
        simulation.step(&feed::latched(tick, 18e-3)).unwrap();
        let tick = simulation.state().tick;
        found.extend(simulation.approaches().iter().map(|approach| (approach.clone(), tick)));
    }
    found
}

/// The burr is the nearest part; its clearance is that of two balls. The clearance of the vessel is that of
/// its line from the tube, which stays on the axis.
#[test]
fn clearances_are_the_closed_forms_and_events_come_at_their_ticks() {
    let mut simulation = simulation(STRUCTURES);
    let ball_m = Vector3::new(1e-3, 0.0, 20e-3);
    let (mut margin, mut inside) = (None, None);
    let mut found = Vec::new();
    for _ in 0..6000 {
        let [ball, vessel] = clearances_m(&simulation);
        let state = simulation.state();
        let exact_m = (burr_m(state) - ball_m).norm() - 5e-3 - BURR_M;
        // The tube is up to 0.3 mm thinner than the burr, and behind it.
        assert!(exact_m < 0.0 || (ball - exact_m).abs() < 1e-12, "{ball}, expected {exact_m}");
        assert!((vessel - (12e-3 - 2e-3 - BURR_M)).abs() < 1e-4, "{vessel}");
        if ball < 3e-3 {
            margin.get_or_insert(state.tick);
        }
        if ball < 0.0 {
            inside.get_or_insert(state.tick);
        }
        found.extend(feed(&mut simulation, 1));
    }
    let told: Vec<(&str, bool, &str, u64)> =
        found.iter().map(|(it, tick)| (&*it.structure, it.has_entered, it.part, *tick)).collect();
    let (margin, inside) = (margin.unwrap(), inside.unwrap());
    assert_eq!(told, [("ball", false, "burr", margin), ("ball", true, "burr", inside)]);
    assert!(found[0].0.clearance_m < 3e-3 && found[0].0.clearance_m > 2.99e-3, "{:?}", found[0]);
    assert!(found[1].0.to_string().contains("the burr entered `ball` at ("), "{}", found[1].0);
}

/// Structures change no bit of the state.
#[test]
fn a_structure_without_a_stop_changes_no_bit() {
    let bare = STRUCTURES.split("[[structure]]").next().unwrap();
    let (mut with, mut without) = (simulation(STRUCTURES), simulation(bare));
    feed(&mut with, 2000);
    feed(&mut without, 2000);
    assert_eq!(with.state().hash, without.state().hash);
    assert_eq!(without.readings(), []);
}

/// The arm stops within its deceleration, accepts only `hold`, and can then go back, though the tool is still
/// within the margin.
#[test]
fn a_structure_stops_the_arm_at_its_margin_and_hold_lets_it_go_back() {
    let text = STRUCTURES.replacen("margin_mm = 3.0", "margin_mm = 3.0\non_margin = \"stop\"", 1);
    let mut simulation = simulation(&text);
    let found = feed(&mut simulation, 6000);
    assert_eq!(found.len(), 1);
    assert!(
        found[0].0.stops && found[0].0.to_string().ends_with("protective stop of the arm"),
        "{}",
        found[0].0
    );
    let stopped = || Ok(ArmProtectiveStop::Stopped);
    assert_eq!(simulation.state().arm_protective_stop(), stopped());
    let [at_m, _] = clearances_m(&simulation);
    // v²/2a of 3 mm/s at 200 mm/s², with its jerk, and a tick.
    assert!((2.9e-3..3e-3).contains(&at_m), "{at_m}");
    let command = |simulation: &mut Simulation<'_>, command: Command| {
        let tick = simulation.state().tick;
        let mut latched = Latched { tick, ..feed::latched(0, 18e-3) };
        latched.commands[0].command = command;
        simulation.step(&latched).unwrap();
    };
    let back = Command {
        sequence: 2,
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: -2e-3,
        arm_speed_m_per_s: 3e-3,
        ..Command::zeroed()
    };
    command(&mut simulation, back);
    assert!(simulation.refusals()[0].reason.contains("protective stop"), "{:?}", simulation.refusals());
    command(&mut simulation, Command { sequence: 3, arm_mode: ArmMode::Hold.code(), ..Command::zeroed() });
    command(&mut simulation, Command { sequence: 4, ..back });
    assert!(simulation.refusals().is_empty(), "{:?}", simulation.refusals());
    for _ in 0..1500 {
        let tick = simulation.state().tick;
        simulation.step(&Latched { tick, ..feed::latched(1, 0.0) }).unwrap();
    }
    assert!(clearances_m(&simulation)[0] > 3.5e-3);
}

/// From a keyframe, readings, numbers and stops continue bit for bit.
#[test]
fn a_keyframe_continues_with_the_same_readings() {
    let text = STRUCTURES.replacen("margin_mm = 3.0", "margin_mm = 3.0\non_breach = \"stop\"", 1);
    let mut one = simulation(&text);
    feed(&mut one, 3500);
    let mut buffer = vec![0; 1 << 20];
    let length = one.write_keyframe(&mut buffer).unwrap();
    let mut other = simulation(&text);
    other.restore_keyframe(&buffer[..length]).unwrap();
    assert_eq!(one.readings(), other.readings());
    for _ in 0..2500 {
        assert_eq!(feed(&mut one, 1), feed(&mut other, 1));
        assert_eq!(one.readings(), other.readings());
    }
    assert_eq!(one.state().hash, other.state().hash);
    assert_eq!(one.state().arm_protective_stop(), Ok(ArmProtectiveStop::Stopped));
    // Regression: a keyframe during a stop lost the arm's fault, and with it `arm_status`.
    let length = one.write_keyframe(&mut buffer).unwrap();
    other = simulation(&text);
    other.restore_keyframe(&buffer[..length]).unwrap();
    feed(&mut one, 10);
    feed(&mut other, 10);
    assert_eq!((one.state().arm_status, one.state().hash), (other.state().arm_status, other.state().hash));
}

/// Commands a tick, by a single controller.
fn step(simulation: &mut Simulation<'_>, command: Command) {
    let tick = simulation.state().tick;
    let mut latched = Latched { tick, ..feed::latched(0, 18e-3) };
    latched.commands[0].command = Command { sequence: tick + 1, ..command };
    simulation.step(&latched).unwrap();
}

/// A controller that commands goals beyond the margin of the ball, straight and from the side, at up to 30
/// mm/s, in every tick or only now and then: the tool never comes closer than the margin, gets to it, and can
/// leave.
#[test]
fn a_fixture_keeps_the_arm_out_of_the_margin_and_lets_it_leave() {
    let text = STRUCTURES.replacen("margin_mm = 3.0", "margin_mm = 3.0\non_margin = \"fixture\"", 1);
    for (speed_m_per_s, side, period) in [(3e-3, 0.0, 1), (30e-3, 0.0, 1), (30e-3, 0.0, 37), (10e-3, 0.6, 1)]
    {
        let mut simulation = simulation(&text);
        let axis = Vector3::new(side, 0.0, 1.0).normalize();
        let mut least_m = f64::INFINITY;
        let mut refusals = 0;
        for tick in 0..8000 {
            // The depth changes in every tick, so that each command is a new one.
            let insert = Command {
                arm_mode: ArmMode::Insert.code(),
                arm_axis: axis.into(),
                arm_depth_m: 25e-3 + 1e-6 * f64::from(tick % 7),
                arm_speed_m_per_s: speed_m_per_s,
                ..Command::zeroed()
            };
            match tick % period {
                0 => step(&mut simulation, insert),
                _ => step(&mut simulation, Command::zeroed()),
            }
            refusals += simulation.refusals().len();
            least_m = least_m.min(clearances_m(&simulation)[0]);
        }
        println!("{speed_m_per_s} m/s, {side}: {least_m} m, {refusals} refusals");
        assert!(least_m > 3e-3 - 1e-6, "{speed_m_per_s}: {least_m}");
        if side == 0.0 {
            assert!(least_m < 3.05e-3, "{speed_m_per_s}: {least_m}");
            assert!((1..50).contains(&refusals), "{refusals}");
        }
        for _ in 0..3000 {
            let back = Command {
                arm_mode: ArmMode::Insert.code(),
                arm_axis: axis.into(),
                arm_depth_m: 1e-3,
                arm_speed_m_per_s: 10e-3,
                ..Command::zeroed()
            };
            step(&mut simulation, back);
        }
        assert!(clearances_m(&simulation)[0] > least_m + 2e-3);
    }
}

/// A tension step that would swing the tool into a vessel at its side ends at the margin.
#[test]
fn a_fixture_slows_the_tendons_down_before_the_margin() {
    let beside = STRUCTURES.replace("[0.0, 12.0, ", "[10.0, 0.0, ");
    let fixed = beside.replacen("margin_mm = 1.0", "margin_mm = 1.0\non_margin = \"fixture\"", 1);
    let pull = |text: &str| {
        let mut simulation = simulation(text);
        let (mut least_m, mut refusals) = (f64::INFINITY, Vec::new());
        for _ in 0..4000 {
            let mut command = Command { tendon_mode: TendonMode::ServoJf.code(), ..Command::zeroed() };
            command.tendon_force_n[0] = 20.0;
            step(&mut simulation, command);
            refusals.extend(simulation.refusals().iter().map(|refusal| refusal.reason.clone()));
            least_m = least_m.min(clearances_m(&simulation)[1]);
        }
        (least_m, refusals, simulation)
    };
    let (free_m, ..) = pull(&beside);
    assert!(free_m < 0.0, "without a fixture, the tool reaches the vessel: {free_m}");
    let (least_m, refusals, mut simulation) = pull(&fixed);
    println!("free {free_m} m, fixed {least_m} m, {refusals:?}");
    assert!(least_m > 1e-3 - 50e-6 && least_m < 1.3e-3, "{least_m}");
    assert!(refusals.len() == 1 && refusals[0].contains("structure[1]"), "{refusals:?}");
    for _ in 0..1000 {
        step(&mut simulation, Command { tendon_mode: TendonMode::ServoJf.code(), ..Command::zeroed() });
    }
    assert!(clearances_m(&simulation)[1] > 3e-3, "the tool can leave");
}

/// From a keyframe in front of the margin, a fixture continues bit for bit.
#[test]
fn a_fixture_continues_from_a_keyframe() {
    let text = STRUCTURES.replacen("margin_mm = 3.0", "margin_mm = 3.0\non_margin = \"fixture\"", 1);
    let mut one = simulation(&text);
    for ticks in [2600, 300, 300] {
        feed(&mut one, ticks);
        let mut buffer = vec![0; 1 << 20];
        let length = one.write_keyframe(&mut buffer).unwrap();
        let mut other = simulation(&text);
        other.restore_keyframe(&buffer[..length]).unwrap();
        for _ in 0..300 {
            feed(&mut one, 1);
            feed(&mut other, 1);
        }
        assert_eq!(one.state().hash, other.state().hash);
    }
    assert!(clearances_m(&one)[0] > 3e-3 - 1e-9 && clearances_m(&one)[0] < 3.02e-3);
}

/// While the tool drills past three structures, what is remembered of their distances changes no bit of the
/// clearances: a simulation that starts from a keyframe remembers nothing.
#[test]
fn remembered_distances_change_no_bit_while_drilling() {
    let mut scene = feed::scene("planar");
    let structures = scene_of(
        "[[structure]]\nname = \"outside\"\nmargin_mm = 1.0\nbuilt_in = \"outside_of_bone\"\n\
         [[structure]]\nname = \"nerve\"\n\
         tube = { points_mm = [[0.0, 8.0, -30.0], [0.0, 8.0, 10.0], [2.0, 12.0, 20.0]], radius_mm = 1.0 }\n\
         [[structure]]\nname = \"vessel\"\n\
         tube = { points_mm = [[-10.0, 0.0, 19.0], [10.0, 0.0, 19.0]], radius_mm = 1.5 }\n",
    );
    scene.structure = structures;
    let block = feed::Block::new(0.6e-3);
    let simulation = || Simulation::new(&scene, Some(block.ct())).unwrap();
    let mut one = simulation();
    let mut buffer = vec![0; 8 << 20];
    for tick in 0..4000 {
        one.step(&feed::latched(tick, 18e-3)).unwrap();
        if tick % 97 == 0 {
            let length = one.write_keyframe(&mut buffer).unwrap();
            let mut other = simulation();
            other.restore_keyframe(&buffer[..length]).unwrap();
            assert_eq!(one.readings(), other.readings(), "tick {tick}");
        }
    }
    assert!(one.state().removed_total > 1000);
}

/// Returns the structures of a scene's text.
fn scene_of(structures: &str) -> Vec<scene::Structure> {
    let volume =
        "name = \"near\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n";
    scene(&format!("{volume}{structures}")).structure
}
