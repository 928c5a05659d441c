//! Runs that end before their time: Ctrl-C, parts that are killed, a launcher that is killed.

use std::fs;

use ipc_types::messages::Tick;
use run_log::EndReason;
use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Ended, Place, assert_nothing_left, parts_of, session_folder, shared_memory_of, signal, wait_for,
};
use crate::common::scenes;

/// Begins a run that would take a minute, and does something to it once it has made 300 ticks.
fn disturbed(place: &Place, disturb: impl FnOnce(&crate::common::program::Run)) -> Ended {
    let run = place.start(&scenes::drill("realtime", 60.0));
    let client = Client::join(&run.session());
    client.wait_for_state(|state| state.tick >= 300);
    drop(client);
    disturb(&run);
    run.end()
}

#[test]
fn ctrl_c_ends_all_cleanly_with_a_valid_log() {
    let place = Place::new();
    let ended = disturbed(&place, |run| signal(run.pid(), Signal::INT));
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
}

/// The physics was asked before it listened, and the launcher waited two minutes for its end.
#[test]
fn ctrl_c_while_the_parts_start_ends_all() {
    for wait_ms in [0, 40, 160] {
        let place = Place::new();
        let run = place.start(&scenes::drill("realtime", 600.0));
        run.session();
        std::thread::sleep(std::time::Duration::from_millis(wait_ms));
        signal(run.pid(), Signal::INT);
        let ended = run.end();
        assert_eq!(ended.code, Some(130), "{}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

/// How many there are beside the logs: `.end_reason` is how the launcher tells the recorder why the run ends.
fn hidden_files(ended: &Ended) -> usize {
    let files = fs::read_dir(&ended.folder).unwrap().flatten();
    files.filter(|file| file.file_name().to_string_lossy().starts_with('.')).count()
}

/// Kills a part; the launcher must name it, and the log must replay to its end.
fn assert_death_is_told(part: &str, name: &str) {
    let place = Place::new();
    let ended = disturbed(&place, |run| signal(run.part(part), Signal::KILL));
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(
        ended.err.contains(&format!("part `{name}` died")) && ended.err.contains("SIGKILL"),
        "{}",
        ended.err
    );
    assert!(ended.err.contains("its last output:\n  nothing"), "{}", ended.err);
    assert_nothing_left(ended.pid);
    assert_eq!(hidden_files(&ended), 0, "the reason of the end is left, for nobody has read it");
    let log = read(&ended.folder);
    assert!(log.ticks.len() >= 200, "only {} ticks", log.ticks.len());
    let said = assert_replays(&ended.folder);
    if part == "recorder" {
        assert!(log.marker.is_none() && said.contains("no end marker"), "{said}");
    } else {
        assert_eq!(log.marker.unwrap().reason, EndReason::PartDied(name.to_owned()));
    }
}

#[test]
fn a_killed_physics_process_is_named_and_the_log_is_complete() {
    assert_death_is_told("physics", "physics");
}

#[test]
fn a_killed_drr_process_is_named_and_the_log_is_complete() {
    assert_death_is_told("drr", "drr");
}

#[test]
fn a_killed_controller_is_named_and_the_log_is_complete() {
    assert_death_is_told("controller", "reference");
}

#[test]
fn a_killed_recorder_is_named_and_leaves_a_cut_log_that_replays() {
    assert_death_is_told("recorder", "recorder");
}

/// In lockstep the physics waits for the DRR process; it must not go on waiting for a dead one.
#[test]
fn a_drr_process_killed_in_lockstep_does_not_hang_the_run() {
    let place = Place::new();
    let run = place.start(&scenes::drill("lockstep", 600.0));
    let client = Client::join(&run.session());
    client.wait_for_state(|state| state.tick >= 300);
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

/// A program that ends early is a part that died, and what it said is shown.
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

#[test]
fn a_controller_program_that_does_not_exist_is_refused_before_the_start() {
    let place = Place::new();
    let scene = scenes::hold("lockstep", 1.0)
        .replace("hold = { tension_n = 2.0 }", "command = [\"/no/such/program\"]");
    let ended = place.start(&scene).end();
    assert_eq!(ended.code, Some(2), "{}", ended.err);
    assert!(ended.err.contains("`controller.command` of `holder` is `/no/such/program`"), "{}", ended.err);
    assert_eq!(place.entries(), ["scene.toml"], "nothing is written");
    assert_nothing_left(ended.pid);
}

/// All parts end by themselves when their launcher is killed, and the next run wipes what could not be wiped then.
fn assert_parts_end_with_their_launcher(scene: &str) {
    let place = Place::new();
    let run = place.start(scene);
    let client = Client::join(&run.session());
    client.wait_for_state(|state| state.tick >= 300);
    drop(client);
    let session = session_folder(run.pid());
    assert_eq!(parts_of(&session).len(), 4, "recorder, DRR, physics, controller");
    signal(run.pid(), Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, None);
    wait_for("the end of all parts", || parts_of(&session).is_empty().then_some(()));
    let log = read(&ended.folder);
    assert!(log.ticks.len() >= 200, "only {} ticks", log.ticks.len());
    assert_eq!(log.marker.unwrap().reason, EndReason::PartDied("launcher".to_owned()));
    assert_replays(&ended.folder);
    // Another test's run may have wiped it by now; this one surely does.
    place.complete(&scenes::hold("lockstep", 0.05));
    assert!(!session.exists());
    assert_eq!(shared_memory_of(ended.pid), Vec::<String>::new());
}

#[test]
fn parts_end_with_a_killed_launcher_in_realtime() {
    assert_parts_end_with_their_launcher(&scenes::drill("realtime", 60.0));
}

#[test]
fn parts_end_with_a_killed_launcher_in_lockstep() {
    assert_parts_end_with_their_launcher(&scenes::drill("lockstep", 600.0));
}

#[test]
fn a_stopped_run_leaves_no_reason_file_behind() {
    let place = Place::new();
    let ended = disturbed(&place, |run| signal(run.pid(), Signal::TERM));
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert_eq!(hidden_files(&ended), 0);
}
