//! Controllers that stop answering.

use ipc_types::messages::{
    Command, EVENT_COMMAND_HELD, EVENT_SAFE_COMMAND, SOURCE_FRESH, SOURCE_HELD, SOURCE_SAFE, State,
    TENDON_SERVO_JF,
};
use run_log::EndReason;
use rustix::process::Signal;

use crate::common::client::{Client, Pilot};
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal};
use crate::common::scenes;

#[test]
fn a_silent_controller_in_lockstep_ends_the_run_and_is_named() {
    let place = Place::new();
    let scene =
        scenes::drill("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 2000.0");
    let run = place.start(&scene);
    let client = Client::at(&run, 100);
    drop(client);
    signal(run.part("controller"), Signal::STOP);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("controller `reference` did not answer tick"), "{}", ended.err);
    assert!(ended.err.contains("within 2000 ms (`run.controller_limit_ms`)"), "{}", ended.err);
    assert!(
        ended.err.contains("waiting for controller `reference`: no answer yet (limit 2 s)"),
        "{}",
        ended.err
    );
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    // Regression: the physics was blamed, which had worked correctly.
    assert!(!ended.err.contains("died"), "{}", ended.err);
    assert!(ended.out.contains("drill (lockstep), controller_late: controller `reference`"), "{}", ended.out);
    assert_eq!(log.marker.unwrap().reason, EndReason::ControllerLate("reference".to_owned()));
    assert!(log.ticks.len() >= 100);
    assert_replays(&ended.folder);
}

/// Regression: it was reported that it "did not connect", although its command had arrived and was rejected.
#[test]
fn a_controller_whose_first_command_is_refused_is_told_why_when_its_time_is_up() {
    for (connect_limit_s, tick) in [(2.0, 0), (60.0, 1)] {
        let place = Place::new();
        let scene = scenes::piloted("lockstep", 1.0, "controller_limit_ms = 2000.0");
        let run = place.start(&format!("{scene}connect_limit_s = {connect_limit_s:?}\n"));
        let mut pilot = Pilot::join(&run.session(), "pilot");
        let state = pilot.drive_to(tick, |_| Command::zeroed());
        let mut command = Command::zeroed();
        (command.tendon_mode, command.tendon_force_n[0]) = (TENDON_SERVO_JF, 61.0);
        pilot.answer(&state, command);
        let ended = run.end();
        assert_eq!(ended.code, Some(1), "{}", ended.err);
        let (missed, number) = match tick {
            0 => ("sent no valid command within 2 s", 1),
            _ => ("did not answer tick 1 within 2000 ms", 2),
        };
        let why = format!("refused: command {number}: `tendon_force_n[0]` is 61; allowed: 0 to 60");
        assert!(ended.err.contains(missed) && ended.err.contains(&why), "{}", ended.err);
        // Regression: nothing was said until then.
        let caution = format!("caution: controller `pilot`: command {number}: `tendon_force_n[0]` is 61");
        let (at_once, end) = (ended.err.find(&caution), ended.err.find(missed));
        assert!(at_once.is_some() && at_once < end, "{}", ended.err);
        assert!(ended.out.contains("controller_late: controller `pilot`"), "{}", ended.out);
        assert!(!ended.err.contains("it is external"), "{}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

#[test]
fn a_stopped_controller_in_realtime_is_held_then_safe_and_drives_again() {
    let place = Place::new();
    let scene = scenes::drill("realtime", 600.0).replace("seed = 7", "seed = 7\nhold_ticks = 40");
    let run = place.start(&scene);
    let client = Client::join(&run.session());
    let drives = |state: &State| state.burr_speed_rad_per_s > 0.0 && state.applied[0].source == SOURCE_FRESH;
    client.wait_for_state(|state| state.tick > 200 && drives(state));
    // A controller that was late in the preceding second is not reported again.
    let mut events = client.events();
    let controller = run.part("controller");
    signal(controller, Signal::STOP);
    let safe = client.wait_for_state(|state| state.applied[0].source == SOURCE_SAFE);
    assert_eq!(safe.burr_speed_rad_per_s, 0.0, "the safe command turns the burr off");
    let later = client.wait_for_state(|state| state.tick >= safe.tick + 200);
    assert_eq!((later.burr_speed_rad_per_s, later.applied[0].source), (0.0, SOURCE_SAFE));
    signal(controller, Signal::CONT);
    client.wait_for_state(|state| state.tick > later.tick && drives(state));
    events.extend(client.events());
    drop(client);
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    let has = |code, words: &str| events.iter().any(|(c, text)| *c == code && text.contains(words));
    assert!(has(EVENT_COMMAND_HELD, "controller `reference` is late"), "{events:?}");
    assert!(has(EVENT_SAFE_COMMAND, "burr off"), "{events:?}");

    // In the log, at every tick: fresh, then held for at most `hold_ticks`, then safe at a larger age.
    let log = read(&ended.folder);
    assert!(log.ticks.iter().any(|tick| tick.latched.commands[0].source == SOURCE_HELD));
    for tick in &log.ticks {
        let command = &tick.latched.commands[0];
        let is_safe = command.source == SOURCE_SAFE;
        assert_eq!(is_safe, command.age_ticks > 40, "tick {}: {} old", tick.latched.tick, command.age_ticks);
    }
    let tension = |tick: u64| log.ticks[tick as usize].state.tendon_tension_n[0];
    assert!((tension(later.tick) - tension(safe.tick)).abs() < 0.5, "the tension is held");
    assert_replays(&ended.folder);
}
