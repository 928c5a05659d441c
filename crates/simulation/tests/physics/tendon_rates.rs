//! Tendons driven at rates (`servo_jv`): integration, range, taking over from and handing over to the other
//! modes, fixtures, keyframes.
#![allow(clippy::unwrap_used, reason = "a helper that fails is a failed test")]

use messages::{
    Command, Latched, LatchedCommand, MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_RATE_M_PER_S, MAX_TENDONS,
    SOURCE_FRESH, SOURCE_HELD, SOURCE_SAFE, State, TendonMode,
};
use simulation::Simulation;
use zerocopy::IntoBytes;

use crate::common::{latched, scene};

const SCENE: &str = "name = \"rates\"\nrun = { mode = \"lockstep\", duration_s = 10.0 }\n";
const DT_S: f64 = 1e-3;

fn simulation(text: &str) -> Simulation<'static> {
    Simulation::new(&scene(text), None).unwrap()
}

/// A command of one tendon mode; the values of the other modes are zero.
fn command(mode: TendonMode, values: [f64; 2]) -> Command {
    let mut command = Command { sequence: 1, tendon_mode: mode.code(), ..Command::zeroed() };
    let field = match mode {
        TendonMode::ServoJv => &mut command.tendon_velocity_m_per_s,
        TendonMode::ServoJf => &mut command.tendon_force_n,
        _ => &mut command.tendon_displacement_m,
    };
    field[..2].copy_from_slice(&values);
    command
}

/// Sends a command once and holds it for `ticks`; returns the last state.
fn hold(simulation: &mut Simulation<'_>, command: Command, ticks: u64) -> State {
    for age in 0..ticks {
        let source = if age == 0 { SOURCE_FRESH } else { SOURCE_HELD };
        let tick = simulation.state().tick;
        simulation.step(&latched(tick, source, age, command)).unwrap();
    }
    *simulation.state()
}

fn rates(values: [f64; 2]) -> Command {
    command(TendonMode::ServoJv, values)
}

/// Adds a rate tick by tick, as the drive does.
fn integrated(from: [f64; MAX_TENDONS], rate: [f64; 2], ticks: u64) -> [f64; 2] {
    let mut now = [from[0], from[1]];
    for _ in 0..ticks {
        now = [now[0] + rate[0] * DT_S, now[1] + rate[1] * DT_S];
    }
    now
}

fn pulled_m(state: &State) -> [f64; 2] {
    [state.tendon_displacement_m[0], state.tendon_displacement_m[1]]
}

#[test]
fn rates_are_integrated_exactly_and_a_repeated_command_changes_nothing() {
    let rate = [0.7e-3, -1.3e-3];
    let mut one = simulation(SCENE);
    let start = *one.state();
    let mut other = simulation(SCENE);
    for ticks in 1..=200 {
        hold(&mut one, rates(rate), 1);
        assert_eq!(pulled_m(one.state()), integrated(start.tendon_displacement_m, rate, ticks), "{ticks}");
    }
    hold(&mut other, rates(rate), 200);
    // Not the hash, which covers the commands too.
    let shape = |simulation: &Simulation<'_>| {
        let state = simulation.state();
        (state.joint_position_rad, state.joint_velocity_rad_per_s, state.tendon_tension_n)
    };
    assert_eq!(shape(&one), shape(&other));
    let stopped = hold(&mut one, rates([0.0; 2]), 300);
    assert_eq!(pulled_m(&stopped), pulled_m(other.state()), "a rate of 0 holds the displacements");
    assert!(stopped.tendon_tension_n[0] > 0.3 && stopped.bend_rad > 0.01, "{} rad", stopped.bend_rad);
}

#[test]
fn tendons_stop_at_either_end_of_their_range_and_come_back() {
    let mut simulation = simulation(SCENE);
    let fast = MAX_DISPLACEMENT_RATE_M_PER_S;
    // The slack end first: it needs no force.
    let ended = hold(&mut simulation, rates([-fast, -fast]), 4200);
    assert_eq!(pulled_m(&ended), [-MAX_DISPLACEMENT_M; 2]);
    let back = hold(&mut simulation, rates([fast, 0.0]), 1);
    assert_eq!(pulled_m(&back), [-MAX_DISPLACEMENT_M + fast * DT_S, -MAX_DISPLACEMENT_M]);
    let ended = hold(&mut simulation, rates([fast, 0.0]), 8200);
    assert_eq!(pulled_m(&ended), [MAX_DISPLACEMENT_M, -MAX_DISPLACEMENT_M]);
}

/// From a tension, rates start at the pulled length of that moment; from displacements, at the setpoints.
#[test]
fn rates_take_over_from_every_other_mode_without_a_jump() {
    let rate = [-0.4e-3, 0.2e-3];
    for (before, ticks) in [
        (command(TendonMode::ServoJf, [4.0, 0.5]), 300),
        (command(TendonMode::ServoJp, [1.1e-3, -0.2e-3]), 50),
        // 2.5 mm with at most 5 mm/s take more than half a second: it is under way.
        (command(TendonMode::MoveJp, [2.5e-3, -2.5e-3]), 250),
        (rates([1e-3, -1e-3]), 100),
    ] {
        let mode = before.tendon_mode();
        let mut simulation = simulation(SCENE);
        let held = hold(&mut simulation, before, ticks);
        assert!(held.tendon_displacement_m[0].abs() > 1e-5, "{mode:?}");
        let after = hold(&mut simulation, rates(rate), 1);
        assert_eq!(pulled_m(&after), integrated(held.tendon_displacement_m, rate, 1), "{mode:?}");
    }
}

#[test]
fn every_other_mode_takes_over_from_rates() {
    let rate = [2e-3, -2e-3];
    let moving = || {
        let mut simulation = simulation(SCENE);
        hold(&mut simulation, rates(rate), 400);
        simulation
    };
    let mut simulation = moving();
    let held = *simulation.state();
    let pulled = hold(&mut simulation, command(TendonMode::ServoJp, [0.3e-3, 0.0]), 1);
    assert_eq!(pulled_m(&pulled), [0.3e-3, 0.0]);
    let pulled = hold(&mut moving(), command(TendonMode::ServoJf, [3.0, 0.0]), 1);
    assert_eq!(pulled.tendon_tension_n[..2], [3.0, 0.0]);
    // A jerk-limited motion continues at the rate: with 0.5 m/s³, it differs after a tick by 0.1 nm.
    let mut simulation = moving();
    let goal = command(TendonMode::MoveJp, [2.5e-3, 0.0]);
    let begun = hold(&mut simulation, goal, 1);
    for (tendon, rate) in rate.into_iter().enumerate() {
        let moved_m = begun.tendon_displacement_m[tendon] - held.tendon_displacement_m[tendon];
        assert!((moved_m - rate * DT_S).abs() < 1e-9, "tendon {tendon}: {moved_m}");
    }
    let [first, second] = pulled_m(&hold(&mut simulation, goal, 3000));
    assert!((first - 2.5e-3).abs() < 1e-12 && second.abs() < 1e-12, "{first} {second}");
}

/// Beside the tool, 6.75 mm from the burr: a vessel that bending reaches.
const VESSEL: &str = r#"
[[structure]]
name = "vessel"
margin_mm = 1.0
tube = { points_mm = [[10.0, 0.0, -50.0], [10.0, 0.0, 0.0], [10.0, 0.0, 50.0]], radius_mm = 2.0 }
"#;

fn clearance_m(simulation: &Simulation<'_>) -> f64 {
    simulation.readings().first().unwrap().value[0]
}

#[test]
fn a_fixture_slows_rates_down_before_the_margin_and_lets_the_tool_leave() {
    let free = format!("{SCENE}{VESSEL}");
    let fixed = free.replace("margin_mm = 1.0", "margin_mm = 1.0\non_margin = \"fixture\"");
    let pull = |text: &str| {
        let mut simulation = simulation(text);
        let (mut least_m, mut reasons) = (f64::INFINITY, Vec::new());
        for _ in 0..2500 {
            hold(&mut simulation, rates([1.5e-3, -1.5e-3]), 1);
            reasons.extend(simulation.refusals().iter().map(|refusal| refusal.reason.clone()));
            least_m = least_m.min(clearance_m(&simulation));
        }
        (least_m, reasons, simulation)
    };
    let (free_m, reasons, _) = pull(&free);
    assert!(free_m < 0.0 && reasons.is_empty(), "without a fixture: {free_m} m, {reasons:?}");
    let (least_m, reasons, mut simulation) = pull(&fixed);
    println!("free {free_m} m, fixed {least_m} m, {reasons:?}");
    assert!(least_m > 1e-3 - 50e-6 && least_m < 1.5e-3, "{least_m}");
    assert!(reasons.len() == 1 && reasons[0].contains("structure[0]"), "{reasons:?}");
    // Rates are not made up for: at once, the tool leaves at the full rate.
    let near = *simulation.state();
    let left = hold(&mut simulation, rates([-1.5e-3, 1.5e-3]), 1);
    let back_m = near.tendon_displacement_m[0] - left.tendon_displacement_m[0];
    assert!((back_m - 1.5e-6).abs() < 1e-15, "{back_m}");
    hold(&mut simulation, rates([-1.5e-3, 1.5e-3]), 1000);
    assert!(clearance_m(&simulation) > 3e-3, "the tool cannot leave: {} m", clearance_m(&simulation));
}

#[test]
fn a_keyframe_and_a_snapshot_continue_rates_bit_for_bit() {
    let fixed =
        format!("{SCENE}{VESSEL}").replace("margin_mm = 1.0", "margin_mm = 1.0\non_margin = \"fixture\"");
    for text in [SCENE, &fixed] {
        let mut one = simulation(text);
        hold(&mut one, rates([1.5e-3, -0.7e-3]), 1400);
        let mut buffer = vec![0; 1 << 20];
        let length = one.write_keyframe(&mut buffer).unwrap();
        let (mut from_keyframe, mut from_snapshot) = (simulation(text), simulation(text));
        from_keyframe.restore_keyframe(&buffer[..length]).unwrap();
        from_snapshot.restore(&one.snapshot()).unwrap();
        // Nothing new is commanded: the drive itself has to continue.
        for tick in 1400..1700 {
            let held = latched(tick, SOURCE_HELD, tick, rates([0.0; 2]));
            for simulation in [&mut one, &mut from_keyframe, &mut from_snapshot] {
                simulation.step(&held).unwrap();
            }
            assert_eq!(one.state().as_bytes(), from_keyframe.state().as_bytes(), "keyframe, tick {tick}");
            assert_eq!(one.state().as_bytes(), from_snapshot.state().as_bytes(), "snapshot, tick {tick}");
        }
        // The fixture has slowed the second one down.
        let [pulled_m, _] = pulled_m(one.state());
        assert_eq!(pulled_m > 2.5e-3, text == SCENE, "{pulled_m}");
        assert!(pulled_m > 0.5e-3, "{pulled_m}");
    }
}

/// Regression: tendons went on to wind after the controller's end, up to 20 mm.
#[test]
fn the_safe_command_ends_rates() {
    let mut simulation = simulation(SCENE);
    hold(&mut simulation, rates([1e-3, -1e-3]), 50);
    // The last command of the controller drives no tendon; the rates continue.
    hold(&mut simulation, Command { sequence: 2, ..Command::zeroed() }, 50);
    let before = pulled_m(simulation.state());
    assert!((before[0] - 1e-4).abs() < 1e-9, "{before:?}");
    for age in 0..50 {
        let tick = simulation.state().tick;
        simulation.step(&latched(tick, SOURCE_SAFE, age, Command::zeroed())).unwrap();
    }
    assert_eq!(pulled_m(simulation.state()), before);
}

/// Regression: who had driven the tendons last was forgotten by a keyframe, after which the safe command
/// ended no rates.
#[test]
fn the_safe_command_ends_rates_after_a_keyframe() {
    // Before the controller of the tendons.
    let other = "[[controller]]\nname = \"other\"\ndrives = [\"c_arm\"]\nexternal = true\n";
    let text = format!("{SCENE}{other}");
    let latched = |tick, source, command| {
        let mut latched = Latched { tick, controller_count: 2, ..Latched::zeroed() };
        latched.commands[1] = LatchedCommand { source, controller_index: 1, age_ticks: 0, command };
        latched
    };
    let (mut whole, mut other) = (simulation(&text), simulation(&text));
    whole.step(&latched(0, SOURCE_FRESH, rates([1e-3, 0.0]))).unwrap();
    let mut bytes = vec![0; 1 << 20];
    let length = whole.write_keyframe(&mut bytes).unwrap();
    other.restore_keyframe(&bytes[..length]).unwrap();
    for tick in 1..20 {
        for simulation in [&mut whole, &mut other] {
            simulation.step(&latched(tick, SOURCE_SAFE, Command::zeroed())).unwrap();
        }
        assert_eq!(other.state().hash, whole.state().hash, "tick {tick}");
    }
    assert_eq!(pulled_m(whole.state())[0], 1e-6);
}
