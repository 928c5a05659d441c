//! Controllers that are third-party programs: what they print, what they start, how they end.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};

use ipc_types::messages::PHASE_ENDED;
use recorder_proc::log_file::LogFile;
use run_log::{EndReason, MessageStream, ReadOptions, Topic};
use rustix::process::Signal;
use test_support::limited::SetAtEnd;

use crate::common::client::{Client, Pilot};
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal, wait_for};
use crate::common::scenes;
use crate::strays::{joined, stopped};

/// A run in free space with a program beside its controller.
fn with_program(duration_s: f64, script: &str) -> String {
    let program = format!(
        "[[controller]]\nname = \"guest\"\ndrives = []\noptional = true\ncommand = [\"sh\", \"-c\", {script:?}]\n"
    );
    scenes::hold("realtime", duration_s) + &program
}

/// Regression: the listener gave up at the first byte that is not text, and the program's next output ended
/// it.
#[test]
fn a_program_may_print_bytes_that_are_no_text() {
    let place = Place::new();
    let run = place.start(&with_program(600.0, r"while :; do printf '\260C\n'; sleep 0.01; done"));
    wait_for("the program's words", || run.said().contains("[guest] \u{fffd}C").then_some(()));
    let client = joined(&run, "");
    assert_nothing_left(stopped(run, client, ()).pid);
}

#[test]
fn a_line_without_an_end_is_taken_in_pieces() {
    let place = Place::new();
    let run = place.start(&with_program(600.0, "head -c 1000000 /dev/zero | base64 -w 0; sleep 600"));
    let longest = || run.said().lines().map(str::len).max().unwrap_or_default();
    wait_for("a piece of the line", || (longest() >= 4000).then_some(()));
    assert!(longest() < 5000, "{}", longest());
    let client = joined(&run, "");
    stopped(run, client, ());
}

/// Regression: when standard error was no longer read (`2>&1 | head -1`), the launcher lost the log's end.
#[test]
fn a_closed_standard_error_ends_no_run() {
    let place = Place::new();
    let scene = place.scene(&with_program(1.0, "while :; do echo word; sleep 0.01; done"));
    let output = place.path("out");
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(&scene).arg("--output").arg(&output);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap());
    said.read_line(&mut String::new()).unwrap();
    drop(said);
    let status = wait_for("the end of the run", || child.try_wait().unwrap());
    assert_eq!(status.code(), Some(0));
    let folder = std::fs::read_dir(&output).unwrap().next().unwrap().unwrap().path();
    assert_eq!(read(&folder).marker.unwrap().reason, EndReason::Completed);
}

/// The last frames are missing then, so the run has not succeeded. `until` decides when after the last tick
/// the process dies.
fn drr_process_dies_behind_the_last_tick(until: impl Fn(u32)) {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 2.0));
    let client = Client::join(&run.session());
    let (drr, controller) = (run.part("drr"), run.part("controller"));
    client.wait_for_state(|state| state.tick >= 100);
    signal(drr, Signal::STOP);
    wait_for("the run's last tick", || {
        client.status.receive().unwrap().filter(|status| status.message().phase == PHASE_ENDED).map(|_| ())
    });
    until(controller);
    signal(drr, Signal::KILL);
    drop(client);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(ended.err.contains("part `drr` died"), "{}", ended.err);
    let log = read(&ended.folder);
    assert_eq!(log.marker.unwrap().reason, EndReason::PartDied("drr".to_owned()));
    assert_eq!(log.ticks.len(), 2000);
    assert_replays(&ended.folder);
}

#[test]
fn a_drr_process_that_dies_behind_the_last_tick_is_named() {
    drr_process_dies_behind_the_last_tick(|_| {});
}

/// Regression: the launcher considered the run completed as soon as a controller had left, and then monitored
/// only the physics, which waited for the dead process for two minutes.
#[test]
fn a_drr_process_that_dies_when_the_controllers_have_left_is_named() {
    drr_process_dies_behind_the_last_tick(|controller| {
        let place = format!("/proc/{controller}");
        wait_for("the controller's end", || (!Path::new(&place).exists()).then_some(()));
    });
}

/// Returns the number of replies to run control in a file that may still grow.
fn replies_in(folder: &Path) -> Option<usize> {
    let mut stream =
        MessageStream::open(&LogFile::at(folder.join("timing.mcap")), ReadOptions::default()).ok()?;
    let mut count = 0;
    while let Ok(Some(message)) = stream.next_message() {
        count += usize::from(message.known == Some(Topic::RunControlReply));
    }
    (count > 0).then_some(count)
}

/// Regression: no tick closes a chunk in a pause; a recorder killed in a pause lost all user actions.
#[test]
fn what_is_done_in_a_pause_is_in_the_file() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let client = Client::at(&run, 50);
    client.ask(ipc_types::messages::CONTROL_PAUSE, 0);
    let folder = std::fs::read_dir(place.path("out")).unwrap().next().unwrap().unwrap().path();
    wait_for("the reply in timing.mcap", || replies_in(&folder));
    drop(client);
    signal(run.part("recorder"), Signal::KILL);
    let ended = run.end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    assert!(replies_in(&ended.folder).is_some());
}

/// A client that never stops writing, not even at the end, does not impede the recorder.
#[test]
fn a_flood_up_to_the_end_costs_the_log_nothing() {
    let place = Place::new();
    let run = place.start(&scenes::piloted("realtime", 2.0, ""));
    let session = run.session();
    let over = AtomicBool::new(false);
    let ended = std::thread::scope(|scope| {
        let _over = SetAtEnd(&over);
        scope.spawn(|| {
            let pilot = Pilot::join(&session, "pilot");
            let mut sequence = 0;
            while !over.load(Ordering::Relaxed) {
                sequence += 1;
                pilot.send(&ipc_types::messages::Command {
                    sequence,
                    ..ipc_types::messages::Command::zeroed()
                });
            }
        });
        run.end()
    });
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let log = read(&ended.folder);
    let marker = log.marker.unwrap();
    assert_eq!((marker.reason, log.ticks.len()), (EndReason::Completed, 2000));
    assert!(!marker.lost.contains_key("/state"), "{:?}", marker.lost);
    assert_replays(&ended.folder);
}
