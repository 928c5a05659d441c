//! Faults found by a tester who had read only the documentation.

use std::ffi::OsStr;
use std::fs;

use ipc_types::messages::CONTROL_STOP;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::{EndReason, LogError, LogReader};
use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read, recorded};
use crate::common::program::{Place, assert_nothing_left, signal, succeed, trabecula, wait_for};
use crate::common::scenes;

/// Regression: the comparison stopped at the first difference, and reported the unread rest as "not ended".
#[test]
fn a_whole_log_is_not_called_unfinished_beside_a_cut_one() {
    let place = Place::new();
    let log = recorded(&place, &scenes::hold("lockstep", 0.3)).join("run.mcap");
    let (cut, bytes) = (place.path("cut.mcap"), fs::read(&log).unwrap());
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    for (words, whole, short) in [([&log, &cut], "first", "second"), ([&cut, &log], "second", "first")] {
        let done = trabecula(&[&"log", &"diff", words[0], words[1]]);
        assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
        assert!(!done.out.contains(&format!("the {whole} log:")), "{}", done.out);
        assert!(done.out.contains(&format!("the {short} log: truncated")), "{}", done.out);
    }
}

/// Regression: the log's end blamed the launcher, which had not failed.
#[test]
fn a_signal_of_somebody_else_to_the_recorder_blames_nobody() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 1.5));
    Client::at(&run, 100);
    signal(run.part("recorder"), Signal::TERM);
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert_eq!((log.marker.unwrap().reason, log.ticks.len()), (EndReason::Completed, 1500));
    assert_replays(&ended.folder);
}

/// Regression: every other command with a LOG accepts a folder; this one reported that a folder is not a
/// regular file.
#[test]
fn a_folder_in_place_of_a_file_of_several_runs_is_split() {
    let place = Place::new();
    let run = recorded(&place, &scenes::hold("lockstep", 0.1));
    let (both, parts) = (place.path("both"), place.path("parts"));
    fs::create_dir(&both).unwrap();
    succeed(&[&"log", &"cat-files", &run, &run, &"-o", &both.join("run.mcap")]);
    succeed(&[&"log", &"split", &both, &"-o", &parts]);
    assert_replays(&parts.join("run2.mcap"));
}

/// Regression: exit code 1, "the logs differ", together with "no message is missing".
#[test]
fn a_log_that_lacks_only_its_end_does_not_differ() {
    let place = Place::new();
    let log = recorded(&place, &scenes::hold("lockstep", 0.3)).join("run.mcap");
    let bytes = fs::read(&log).unwrap();
    let cut = place.path("cut.mcap");
    // Cut after the data: in the closing magic, in the index, and before the end marker.
    let marker = bytes.windows(9).rposition(|bytes| bytes == b"completed").unwrap();
    for length in [bytes.len() - 8, bytes.len() - 60, marker] {
        fs::write(&cut, &bytes[..length]).unwrap();
        for words in [[&log, &cut], [&cut, &log]] {
            let done = trabecula(&[&"log", &"diff", words[0], words[1]]);
            assert_eq!(done.code, Some(3), "{length} of {} bytes: {}{}", bytes.len(), done.out, done.err);
            assert!(
                done.out.contains("300 identical ticks") && done.out.contains("identical\n"),
                "{}",
                done.out
            );
            assert!(done.out.contains("log: truncated after byte"), "{}", done.out);
        }
    }
}

/// Regression: exit code 2, as if another argument could help; the documentation says that damage is 1.
#[test]
fn a_log_without_any_state_is_damage_to_every_command() {
    let place = Place::new();
    let log = recorded(&place, &scenes::hold("lockstep", 0.1)).join("run.mcap");
    let bytes = fs::read(&log).unwrap();
    let cut = place.path("cut.mcap");
    let has_no_state = |length: &usize| {
        fs::write(&cut, &bytes[..*length]).unwrap();
        matches!(LogReader::open(&LogFile::at(&cut)), Err(LogError::NoInitialState { .. }))
    };
    let length = (100..bytes.len()).step_by(100).find(has_no_state).unwrap();
    fs::write(&cut, &bytes[..length]).unwrap();
    let (made, folder) = (place.path("made.nrrd"), place.path("again"));
    let all: [&[&dyn AsRef<OsStr>]; 8] = [
        &[&"replay", &cut],
        &[&"replay", &cut, &"--verify"],
        &[&"replay", &cut, &"--from", &"3"],
        &[&"replay", &cut, &"--output", &folder],
        &[&"log", &"diff", &cut, &log],
        &[&"log", &"diff", &log, &cut],
        &[&"plan", &"--check", &cut],
        &[&"volume", &"drilled", &cut, &"-o", &made],
    ];
    for words in all {
        let done = trabecula(words);
        assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
        assert!(done.err.contains("no initial state"), "{}", done.err);
        assert!(!made.exists() && !folder.exists());
    }
}

/// Regression: "part died: launcher", although the launcher had not failed and had printed the actual cause.
#[test]
fn a_run_folder_that_is_moved_during_the_run_blames_no_part() {
    for whole_folder in [true, false] {
        let place = Place::new();
        let run = place.start(&scenes::hold("realtime", 3600.0));
        Client::at(&run, 200);
        let log = wait_for("the log", || run.log());
        let (from, to) = match whole_folder {
            true => (log.parent().unwrap(), place.path("moved")),
            false => (log.as_path(), place.path("moved.mcap")),
        };
        fs::rename(from, &to).unwrap();
        let ended = run.end();
        assert_eq!(ended.code, Some(1), "{}", ended.err);
        assert!(ended.err.contains("run.mcap was moved to"), "{}", ended.err);
        assert_nothing_left(ended.pid);
        let mut log = LogReader::open(&LogFile::at(log_path(&to))).unwrap();
        while log.next().is_some() {}
        assert_eq!(log.ending().marker.as_ref().unwrap().reason, EndReason::LogMoved);
        assert_replays(&to);
    }
}

/// Regression: the pictures, figures and summary of a run replaced existing files of the same names, and one
/// picture that could not be written cost the summary and the table.
#[test]
fn what_others_put_into_a_runs_folder_stays_and_costs_nothing_else() {
    const MINE: &str = "a user's own work";
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let client = Client::at(&run, 200);
    let folder = wait_for("the log", || run.log()).parent().unwrap().to_owned();
    // A file, a folder, a link to another file, and names that the run uses while it ends.
    let elsewhere = place.path("elsewhere");
    fs::write(&elsewhere, MINE).unwrap();
    fs::write(folder.join("drr_after.png"), MINE).unwrap();
    fs::write(folder.join(".end_reason"), MINE).unwrap();
    fs::create_dir(folder.join("tip_path.png")).unwrap();
    std::os::unix::fs::symlink(&elsewhere, folder.join("timing.svg")).unwrap();
    client.ask(CONTROL_STOP, 0);
    drop(client);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}{}", ended.out, ended.err);
    assert_nothing_left(ended.pid);
    assert_eq!(fs::read_to_string(folder.join("drr_after.png")).unwrap(), MINE);
    assert_eq!(fs::read_to_string(folder.join(".end_reason")).unwrap(), MINE);
    assert_eq!(fs::read_to_string(&elsewhere).unwrap(), MINE);
    assert!(folder.join("tip_path.png").is_dir() && folder.join("timing.svg").is_symlink());
    let found =
        [("drr_after.png", "a file of 17 bytes"), ("tip_path.png", "a folder"), ("timing.svg", "a link")];
    for (name, what) in found {
        let said = format!(
            "{}: not written: {what} that does not belong to this run is in the way",
            folder.join(name).display()
        );
        assert!(ended.err.contains(&said), "{}", ended.err);
    }
    assert!(ended.err.contains("3 files of the report could not be written"), "{}", ended.err);
    for name in ["summary.json", "drr_before.png", "tip_path.svg", "timing.png"] {
        assert!(fs::metadata(folder.join(name)).unwrap().len() > 0, "{name}");
    }
    assert!(ended.out.contains("stopped") && ended.out.contains("\nreplay "), "{}", ended.out);
    assert_eq!(read(&folder).marker.unwrap().reason, EndReason::Stopped);
    assert_replays(&folder);
}

/// The same for `summary.json` itself: the table is still shown.
#[test]
fn a_summary_that_cannot_be_written_costs_no_picture_and_no_table() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let client = Client::at(&run, 200);
    let folder = wait_for("the log", || run.log()).parent().unwrap().to_owned();
    fs::write(folder.join("summary.json"), "mine").unwrap();
    client.ask(CONTROL_STOP, 0);
    drop(client);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}{}", ended.out, ended.err);
    assert_eq!(fs::read_to_string(folder.join("summary.json")).unwrap(), "mine");
    assert!(ended.err.contains("one file of the report could not be written"), "{}", ended.err);
    assert!(ended.out.contains("stopped"), "{}", ended.out);
    for name in ["drr_after.png", "tip_path.png", "tip_path.svg", "timing.png", "timing.svg"] {
        assert!(fs::metadata(folder.join(name)).unwrap().len() > 0, "{name}");
    }
}
