//! Controllers that stop answering.

use ipc_types::messages::{
    EVENT_COMMAND_HELD, EVENT_SAFE_COMMAND, SOURCE_FRESH, SOURCE_HELD, SOURCE_SAFE, State,
};
use run_log::EndReason;
use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal};
use crate::common::scenes;

#[test]
fn a_silent_controller_in_lockstep_ends_the_run_and_is_named() {
    let place = Place::new();
    let scene =
        scenes::drill("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 2000.0");
    let run = place.start(&scene);
    let client = Client::join(&run.session());
    client.wait_for_state(|state| state.tick >= 100);
    drop(client);
    signal(run.part("controller"), Signal::STOP);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("controller `reference` did not answer tick"), "{}", ended.err);
    assert!(ended.err.contains("within 2000 ms (`run.controller_limit_ms`)"), "{}", ended.err);
    assert!(
        ended.err.contains("waiting for controller `reference`: its answer, at most 2 s"),
        "{}",
        ended.err
    );
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    // The physics was blamed, which had done what it should.
    assert!(!ended.err.contains("died"), "{}", ended.err);
    assert!(ended.out.contains("drill (lockstep), controller_late: controller `reference`"), "{}", ended.out);
    assert_eq!(log.marker.unwrap().reason, EndReason::ControllerLate("reference".to_owned()));
    assert!(log.ticks.len() >= 100);
    assert_replays(&ended.folder);
}

#[test]
fn a_stopped_controller_in_realtime_is_held_then_safe_and_drives_again() {
    let place = Place::new();
    let scene = scenes::drill("realtime", 60.0).replace("seed = 7", "seed = 7\nhold_ticks = 40");
    let run = place.start(&scene);
    let client = Client::join(&run.session());
    let drives = |state: &State| state.burr_speed_rad_per_s > 0.0 && state.applied[0].source == SOURCE_FRESH;
    client.wait_for_state(|state| state.tick > 200 && drives(state));
    // Whoever has been late in the second before is not said to be so again.
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

    // In the log: fresh, then held for no more than `hold_ticks`, then safe at an age above it, in every tick.
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
