//! Faulty clients: each is rejected with a specific message, and the run is unaffected.

use std::fs;

use ipc_types::messages::Tick;
use ipc_types::messages::services;
use ipc_types::messages::{
    ARM_HOLD, ARM_INSERT, BURR_SPEED, Command, EVENT_COMMAND_REFUSED, State, TENDON_SERVO_JF,
};
use ipc_types::session::SessionError;

use crate::common::client::{Client, Pilot};
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, assert_nothing_left, trabecula, wait_for};
use crate::common::scenes;

const TICKS: u64 = 300;

/// A tension that follows the state, so that a disturbed state would show in every later tick.
fn steered(state: &State) -> Command {
    let mut command = Command { tendon_mode: TENDON_SERVO_JF, arm_mode: ARM_HOLD, ..Command::zeroed() };
    command.tendon_force_n[0] = 4.0 + 2.0 * state.bend_rad.clamp(-1.0, 1.0) + 0.01 * state.tick as f64;
    command
}

/// Runs the shared scene with `steered`; `disturb` is called once, with the state of tick 150, and returns
/// the state to answer next.
fn flown(place: &Place, disturb: impl FnOnce(&mut Pilot, State) -> State) -> Ended {
    let run = place.start(&scenes::shared("lockstep", TICKS as f64 * 1e-3));
    let mut pilot = Pilot::join(&run.session(), "pilot");
    let state = pilot.drive_to(150, steered);
    let state = disturb(&mut pilot, state);
    pilot.answer(&state, steered(&state));
    pilot.drive_to(TICKS, steered);
    drop(pilot);
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    assert_replays(&ended.folder);
    ended
}

/// Asserts that both runs computed the same ticks from the same commands.
fn assert_same_run(disturbed: &Ended, undisturbed: &Ended) {
    let [a, b] = [disturbed, undisturbed].map(|ended| read(&ended.folder).marker.unwrap());
    assert_eq!((a.hash, a.last_tick), (b.hash, Some(Tick(TICKS))));
}

/// Commands that must be rejected, with the text of the event.
fn bad_commands(sequence: u64, tick: u64) -> Vec<(Command, &'static str)> {
    let good = Command { sequence, state_tick: tick, ..steered(&State::zeroed()) };
    let forces = |force_n: f64| [force_n, 0.0, 0.0, 0.0];
    vec![
        (
            Command { tendon_force_n: forces(f64::NAN), ..good },
            "`tendon_force_n[0]` is NaN; allowed: 0 to 60",
        ),
        (Command { tendon_force_n: forces(61.0), ..good }, "`tendon_force_n[0]` is 61; allowed: 0 to 60"),
        (Command { tendon_force_n: forces(-0.5), ..good }, "`tendon_force_n[0]` is -0.5; allowed: 0 to 60"),
        (Command { arm_speed_m_per_s: f64::INFINITY, ..good }, "`arm_speed_m_per_s` is inf; allowed: 0 to 1"),
        // Regression: the lower bound was the smallest positive number, printed with all its 300 digits.
        (
            Command { arm_mode: ARM_INSERT, arm_axis: [1.0, 0.0, 0.0], arm_speed_m_per_s: 0.0, ..good },
            "`arm_speed_m_per_s` is 0; allowed: above 0 and at most 1",
        ),
        (Command { arm_mode: 9, ..good }, "`arm_mode` is 9, expected 0 none"),
        (Command { tube_mode: 3, ..good }, "`tube_mode` is 3, expected 0 none"),
        (Command { tube_mode: 2, ..good }, "`tube_mode` drives the tube, which the scene does not assign"),
        (Command { sequence: sequence - 1, ..good }, "`sequence` is 150, expected more than 150"),
        (Command { sequence: 1, ..good }, "`sequence` is 1, expected more than 150"),
        (
            Command { state_tick: tick - 2, ..good },
            "`state_tick` is 148, but an earlier command of this connection answered 149",
        ),
        (Command { state_tick: tick + 1, ..good }, "`state_tick` is 151, but the newest state is 150"),
        (
            Command { burr_mode: BURR_SPEED, ..good },
            "`burr_mode` drives the burr, which the scene does not assign",
        ),
    ]
}

#[test]
fn bad_commands_are_refused_by_field_and_change_nothing() {
    let (place, other) = (Place::new(), Place::new());
    let mut events = Vec::new();
    let mut expected = Vec::new();
    let disturbed = flown(&place, |pilot, state| {
        let bad = bad_commands(pilot.sequence + 1, state.tick);
        pilot.client.events();
        for (command, words) in &bad {
            pilot.send(command);
            expected.push(*words);
        }
        wait_for("an event of each refused command", || {
            events.extend(pilot.client.events());
            (events.len() >= bad.len()).then_some(())
        });
        assert!(pilot.client.states.receive().unwrap().is_none(), "no tick was made from a refused command");
        state
    });
    for ((code, text), words) in events.iter().zip(&expected) {
        assert_eq!(*code, EVENT_COMMAND_REFUSED);
        assert!(text.contains("controller `pilot`: command 1") && text.contains(words), "{words} in: {text}");
    }
    assert_same_run(&disturbed, &flown(&other, |_, state| state));
}

/// That no arm reaches a goal is only found in the step: the goal is rejected there, and the run continues
/// and replays.
#[test]
fn an_unreachable_goal_is_refused_with_an_event() {
    let place = Place::new();
    let ended = flown(&place, |pilot, state| {
        pilot.client.events();
        let mut command = Command { arm_mode: ipc_types::messages::ARM_MOVE_CP, ..steered(&state) };
        command.t_world_base = state.t_world_base;
        command.t_world_base.position_m[0] += 5.0;
        pilot.answer(&state, command);
        let next = pilot.next_state();
        let heard = || Some(pilot.client.events()).filter(|events| !events.is_empty());
        let events = wait_for("an event of the refused goal", heard);
        assert!(events[0].1.contains("controller `pilot`: command 151: arm"), "{events:?}");
        next
    });
    let log = read(&ended.folder);
    let at = |tick: usize| log.ticks[tick].state.t_world_base.position_m;
    assert!((0..3).all(|axis| (at(160)[axis] - at(149)[axis]).abs() < 1e-3), "{:?} {:?}", at(149), at(160));
}

#[test]
fn a_second_controller_of_the_same_name_is_refused_by_name() {
    let (place, other) = (Place::new(), Place::new());
    let disturbed = flown(&place, |pilot, state| {
        let folder = pilot.client.session.folder().to_owned();
        let second = Client::join(&folder);
        let refusal = second.session.command_publisher("pilot").unwrap_err();
        assert!(matches!(&refusal, SessionError::ControllerTaken { name } if name == "pilot"), "{refusal}");
        let process = trabecula(&[&"proc", &"controller", &"--name", &"holder", &"--session", &folder]);
        assert_ne!(process.code, Some(0));
        assert!(process.err.contains("a controller named `holder` is already connected"), "{}", process.err);
        let unknown = trabecula(&[&"proc", &"controller", &"--name", &"nobody", &"--session", &folder]);
        assert_ne!(unknown.code, Some(0));
        assert!(unknown.err.contains("nobody"), "{}", unknown.err);
        state
    });
    assert_same_run(&disturbed, &flown(&other, |_, state| state));
}

#[test]
fn a_client_of_another_layout_is_refused_with_both_layouts() {
    let (place, other) = (Place::new(), Place::new());
    let disturbed = flown(&place, |pilot, state| {
        let folder = pilot.client.session.folder().to_owned();
        let path = folder.join("session.json");
        let announced = fs::read_to_string(&path).unwrap();
        let mut announcement = pilot.client.session.announcement().clone();
        let ours = announcement.layouts.insert("state".to_owned(), "0123456789abcdef".to_owned()).unwrap();
        fs::write(&path, serde_json::to_string(&announcement).unwrap()).unwrap();
        let process = trabecula(&[&"proc", &"controller", &"--name", &"holder", &"--session", &folder]);
        fs::write(&path, announced).unwrap();
        assert_ne!(process.code, Some(0));
        let words = ["service `state`", "trabecula_msgs/msg/State", "0123456789abcdef", &ours];
        assert!(words.iter().all(|word| process.err.contains(word)), "{}", process.err);
        // A program that expects another message on the service.
        let refusal = pilot.client.session.subscriber::<Command>(&services::STATE).unwrap_err();
        assert!(matches!(refusal, SessionError::Layout { .. }), "{refusal}");
        state
    });
    assert_same_run(&disturbed, &flown(&other, |_, state| state));
}
