//! Runs that end early: Ctrl-C, parts and programs that die. Killing every part in turn: `tests/faults`.

use ipc_types::messages::Tick;
use run_log::EndReason;
use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal};
use crate::common::scenes;

#[test]
fn ctrl_c_ends_all_cleanly_with_a_valid_log() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    Client::at(&run, 300);
    signal(run.pid(), Signal::INT);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    let marker = log.marker.expect("an end marker");
    assert_eq!(marker.reason, EndReason::Interrupted);
    assert!(log.ticks.len() >= 300 && log.ticks.len() < 60_000);
    assert_eq!(marker.last_tick, Some(Tick(log.ticks.len() as u64)));
    let said = assert_replays(&ended.folder);
    assert!(said.contains("end marker: interrupted"), "{said}");
    assert!(ended.out.contains("interrupted") && ended.folder.join("summary.json").exists(), "{}", ended.out);
    // Through `.end_reason` the launcher passes the end reason to the recorder.
    assert!(!ended.folder.join(".end_reason").exists());
}

/// In lockstep the physics waits for the DRR process; it must not keep waiting for a dead one.
#[test]
fn a_drr_process_killed_in_lockstep_does_not_hang_the_run() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 600.0));
    let client = Client::at(&run, 300);
    drop(client);
    signal(run.part("drr"), Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("part `drr` died"), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert_eq!(log.marker.unwrap().reason, EndReason::PartDied("drr".to_owned()));
    assert_replays(&ended.folder);
}

/// A program that ends early is reported as a dead part, and its last output is shown.
#[test]
fn the_last_words_of_a_controller_program_are_shown() {
    let place = Place::new();
    let program = r#"command = ["sh", "-c", "echo the motor is too hot >&2; exit 7"]"#;
    let scene = scenes::hold("lockstep", 1.0).replace("hold = { tension_n = 2.0 }", program);
    let ended = place.start(&scene).end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("part `holder` died (exit status: 7)"), "{}", ended.err);
    assert!(ended.err.contains("the motor is too hot"), "{}", ended.err);
    assert_nothing_left(ended.pid);
}
