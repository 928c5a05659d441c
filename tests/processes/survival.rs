//! Conditions that a log survives: killed processes, a full disk, a folder that cannot be written.

use std::path::{Path, PathBuf};

use ipc_types::messages::services;
use ipc_types::messages::{CONTROL_PAUSE, CONTROL_STOP, Progress, SENDER_RECORDER};
use rustix::process::{Pid, Resource, Rlimit, Signal, prlimit};

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, Run, assert_nothing_left, signal, trabecula, wait_for};
use crate::common::scenes;

/// Pauses a run after tick 700, so that the last published tick is known, waits until the recorder has
/// received it, and does something. Returns that tick.
fn paused(place: &Place, scene: &str, disturb: impl FnOnce(&Run)) -> (u64, Ended) {
    let run = place.start(scene);
    let client = Client::join(&run.session());
    let progress = client.session.subscriber::<Progress>(&services::PROGRESS).unwrap();
    client.wait_for_state(|state| state.tick >= 700);
    let published = client.ask(CONTROL_PAUSE, 0).tick;
    wait_for("the recorder's progress", || {
        let newest = progress.receive().unwrap().map(|message| *message.message());
        newest.filter(|newest| newest.consumer == SENDER_RECORDER && newest.tick >= published)
    });
    // What it has received is soon in the file, except for a chunk of 100 ticks.
    let folder = run.log().unwrap().parent().unwrap().to_owned();
    wait_for("what was published in the file", || {
        (read(&folder).ticks.len() as u64 + 100 >= published).then_some(())
    });
    drop(client);
    disturb(&run);
    (published, run.end())
}

/// Regression: it lost what arrived in the meantime: its queues were too short, and it drained one before the
/// next.
#[test]
fn a_recorder_that_is_stopped_for_a_second_loses_nothing() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let client = Client::at(&run, 100);
    let recorder = run.part("recorder");
    signal(recorder, Signal::STOP);
    // More ticks than the 1024 that it once considered a loss.
    let tick = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= tick + 1500);
    signal(recorder, Signal::CONT);
    let ended = client.stop(run);
    let log = read(&ended.folder);
    assert!(log.ticks.len() as u64 >= tick + 1500, "{} ticks", log.ticks.len());
    assert!(log.marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
}

/// Repairs a log; the result must be complete and replay to the same tick. Returns the command's output.
fn assert_repairs(place: &Place, folder: &Path) -> String {
    let before = read(folder).ticks.len();
    let whole = place.path("whole.mcap");
    let done = trabecula(&[&"log", &"repair", &folder, &"-o", &whole]);
    assert_eq!(done.code, Some(3), "{}", done.err);
    assert!(done.out.contains(&format!("ticks       complete up to {before}\n")), "{}", done.out);
    let said = assert_replays(&whole);
    assert!(
        said.contains(&format!("last tick {before},")) && said.contains("end marker: repaired"),
        "{said}"
    );
    let info = trabecula(&[&"log", &"info", &whole]);
    assert!(info.code == Some(0) && info.out.contains("end marker: repaired"), "{}", info.out);
    // It never overwrites.
    assert_eq!(trabecula(&[&"log", &"repair", &folder, &"-o", &whole]).code, Some(2));
    done.out
}

#[test]
fn a_killed_recorder_loses_at_most_100_ms_and_its_log_can_be_repaired() {
    let place = Place::new();
    let scene = scenes::hold("realtime", 600.0);
    let (published, ended) = paused(&place, &scene, |run| signal(run.part("recorder"), Signal::KILL));
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    let log = read(&ended.folder);
    assert!(log.marker.is_none());
    // A tick is a millisecond.
    let lost = published - log.ticks.len() as u64;
    assert!(lost <= 100, "{lost} of {published} ticks lost");
    let said = assert_repairs(&place, &ended.folder);
    assert!(said.contains("no end marker"), "{said}");
}

/// Regression: the header was written with the first ticks, so a recorder killed before them left an empty
/// file.
#[test]
fn a_recorder_that_is_killed_before_the_first_tick_leaves_a_log_that_says_of_what() {
    let place = Place::new();
    // Its controller never joins.
    let run = place.start(&scenes::piloted("lockstep", 4.0, ""));
    let is_begun = |log: PathBuf| std::fs::metadata(log).is_ok_and(|file| file.len() > 0);
    // The run waits for both headers before its first tick; each is written by its own thread.
    let are_begun = |run: PathBuf| is_begun(run.with_file_name("timing.mcap")) && is_begun(run);
    wait_for("the headers of both logs", || run.log().is_some_and(are_begun).then_some(()));
    signal(run.part("recorder"), Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    for file in ["run.mcap", "timing.mcap"] {
        let told = trabecula(&[&"log", &"info", &ended.folder.join(file)]);
        assert!(told.out.contains("piloted"), "{file}: exit {:?}\n{}\n{}", told.code, told.out, told.err);
    }
}

/// Regression: the last write of a log failed, but the run reported "completed" and ended with exit code 0.
#[test]
fn a_log_that_cannot_be_finished_is_told() {
    let place = Place::new();
    let (published, ended) = paused(&place, &scenes::hold("realtime", 600.0), |run| {
        let folder = std::fs::read_dir(place.path("out")).unwrap().flatten().next().unwrap().path();
        let bytes = std::fs::metadata(folder.join("run.mcap")).unwrap().len();
        let recorder = Pid::from_raw(run.part("recorder") as i32).unwrap();
        // Published messages are there; the index and the end marker are not.
        let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
        prlimit(Some(recorder), Resource::Fsize, limit).unwrap();
        Client::join(&run.session()).ask(CONTROL_STOP, 0);
    });
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    let words = ["part `recorder` died", "run.mcap: cannot write the log"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert!(log.marker.is_none() && log.ticks.len() as u64 >= published - 100, "{}", log.ticks.len());
    assert_replays(&ended.folder);
}

/// Regression: the run continued into a deleted file, and finally reported only that a picture could not be
/// written.
#[test]
fn a_log_removed_during_a_run_with_or_without_its_folder_ends_it_at_once_and_is_named() {
    for with_folder in [true, false] {
        let place = Place::new();
        let run = place.start(&scenes::hold("realtime", 3600.0));
        Client::at(&run, 200);
        let log = wait_for("the log", || run.log());
        let folder = log.parent().unwrap();
        if with_folder {
            std::fs::remove_dir_all(folder).unwrap()
        } else {
            std::fs::remove_file(&log).unwrap()
        }
        let ended = run.end();
        assert_eq!(ended.code, Some(1), "{}", ended.err);
        let said = format!("the log {} was removed during the run", log.display());
        assert!(ended.err.contains(&said), "{}", ended.err);
        assert!(!ended.err.contains("drr_") && !ended.err.contains("summary"), "{}", ended.err);
        assert_eq!(folder.exists(), !with_folder);
        assert_nothing_left(ended.pid);
    }
}
