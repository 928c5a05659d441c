//! Runs whose output is not read: a terminal that is stopped (Ctrl-S), a pipe that is full.

use std::fs::File;
use std::io::{PipeReader, Write, pipe};
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

use run_log::EndReason;
use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::process::Signal;
use test_support::limited::{end_within, read_all, text_within};

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Guarded, LIMIT, Place, assert_nothing_left, only_entry, parts_of, session_folder, signal, wait_for,
};
use crate::common::scenes;
use crate::common::terminal::{Act, Terminal};

/// Two signals within 0.3 s count as one.
const ANOTHER: Duration = Duration::from_millis(500);

/// A launcher, ended when the test ends, in any way.
struct Launched(Guarded);

impl Launched {
    fn new(scene: &Path, output: &Path, more: &[&str], out: Stdio, err: Stdio) -> Launched {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("run").arg(scene).arg("--output").arg(output).args(more);
        Launched(Guarded(command.stdin(Stdio::null()).stdout(out).stderr(err).spawn().unwrap()))
    }

    fn at_tick(&self, tick: u64) {
        let pid = self.0.0.id();
        let session = wait_for("the session", || Some(session_folder(pid)).filter(|folder| folder.exists()));
        Client::join(&session).wait_for_state(|state| state.tick >= tick);
    }

    fn end(&mut self) -> ExitStatus {
        let status = end_within(&mut self.0.0, LIMIT, "a run whose output nobody reads");
        assert_nothing_left(self.0.0.id());
        status
    }
}

/// A pipe that accepts nothing more until it is read.
fn full_pipe() -> (PipeReader, Stdio) {
    let (reader, mut writer) = pipe().unwrap();
    let flags = fcntl_getfl(&writer).unwrap();
    fcntl_setfl(&writer, flags | OFlags::NONBLOCK).unwrap();
    while writer.write(b"\n").is_ok() {}
    fcntl_setfl(&writer, flags).unwrap();
    (reader, Stdio::from(OwnedFd::from(writer)))
}

/// Regression: the launcher blocked in a write to the terminal and ignored signals until Ctrl-Q.
#[test]
fn a_signal_beside_a_stopped_terminal_is_obeyed() {
    let place = Place::new();
    let (scene, output) = (place.scene(&scenes::drill("realtime", 600.0)), place.path("out"));
    let mut terminal = Terminal::new(Act::Stop, &scene, &output);
    let (launcher, session) = (terminal.launcher, terminal.session.clone());
    let client = Client::join(&session);
    client.wait_for_state(|state| state.tick >= 100);
    terminal.tell("stop");
    assert_eq!(terminal.next_line(), "stopped");
    // Some tables later it blocks in the write. The run continues.
    let stopped_at = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= stopped_at + 1000);
    drop(client);
    signal(launcher, Signal::TERM);
    wait_for("the end beside a stopped terminal", || parts_of(&session).is_empty().then_some(()));
    assert_eq!(terminal.next_line(), "130");
    assert_nothing_left(launcher);
    let folder = only_entry(&output);
    assert_eq!(read(&folder).marker.unwrap().reason, EndReason::Interrupted);
    assert_replays(&folder);
}

#[test]
fn a_signal_beside_full_pipes_is_obeyed() {
    for json in [false, true] {
        let place = Place::new();
        let (scene, output) = (place.scene(&scenes::hold("realtime", 600.0)), place.path("out"));
        let ((_out, stdout), (_err, stderr)) = (full_pipe(), full_pipe());
        let more: &[&str] = if json { &["--json"] } else { &[] };
        let mut run = Launched::new(&scene, &output, more, stdout, stderr);
        // After the first lines of progress.
        run.at_tick(2500);
        signal(run.0.0.id(), Signal::TERM);
        assert_eq!(run.end().code(), Some(130));
        let folder = only_entry(&output);
        assert_eq!(read(&folder).marker.unwrap().reason, EndReason::Interrupted);
        assert_replays(&folder);
    }
}

#[test]
fn a_second_signal_ends_everything_at_once_where_nothing_can_be_written() {
    let place = Place::new();
    let (scene, output) = (place.scene(&scenes::drill("realtime", 600.0)), place.path("out"));
    let ((_out, stdout), (_err, stderr)) = (full_pipe(), full_pipe());
    let mut run = Launched::new(&scene, &output, &[], stdout, stderr);
    run.at_tick(100);
    let pid = run.0.0.id();
    let recorder = parts_of(&session_folder(pid)).into_iter().find(|(part, _)| part == "recorder").unwrap().1;
    // The log cannot be finished; the launcher would wait for more than two minutes.
    signal(recorder, Signal::STOP);
    signal(pid, Signal::INT);
    std::thread::sleep(ANOTHER);
    signal(pid, Signal::INT);
    assert_eq!(run.end().code(), Some(130));
    assert_replays(&only_entry(&output));
}

/// Regression: a program that wrote more than a pipe holds blocked, and with it every run that waited for its
/// commands.
#[test]
fn a_controllers_words_that_nobody_reads_hold_up_nobody_and_are_counted() {
    let place = Place::new();
    let done = place.path("done");
    let words = format!("yes | head -c 1000000 >&2; touch {}; exec sleep 1000", done.display());
    let talker = format!(
        "[[controller]]\nname = \"talker\"\ndrives = []\noptional = true\ncommand = [\"sh\", \"-c\", {words:?}]\n"
    );
    let scene = scenes::hold("realtime", 600.0) + &talker;
    let (scene, output) = (place.scene(&scene), place.path("out"));
    let ((_out, stdout), (err, stderr)) = (full_pipe(), full_pipe());
    let mut run = Launched::new(&scene, &output, &["--quiet"], stdout, stderr);
    run.at_tick(100);
    wait_for("the end of the program's words", || done.exists().then_some(()));
    let reading = read_all(err);
    signal(run.0.0.id(), Signal::TERM);
    assert_eq!(run.end().code(), Some(130));
    let text = text_within(&reading, LIMIT, "the pipe");
    // In one line or several: the program's last output may be read after the launcher's next line.
    let left_out: usize = text
        .lines()
        .filter_map(|line| line.strip_suffix(" lines dropped because nothing read standard error"))
        .map(|line| line.strip_prefix("trabecula: ").unwrap().parse::<usize>().unwrap())
        .sum();
    let shown = text.lines().filter(|line| *line == "[talker] y").count();
    assert_eq!(left_out + shown, 500_000, "{shown} shown");
    assert!(text.contains("trabecula: SIGTERM: stopping the run"));
}

/// Requested output waits until the script reads it.
#[test]
fn json_is_whole_however_late_it_is_read() {
    let place = Place::new();
    let (scene, output) = (place.scene(&scenes::hold("realtime", 2.5)), place.path("out"));
    let (out, stdout) = full_pipe();
    let err = File::create(place.path("err")).unwrap();
    let mut run = Launched::new(&scene, &output, &["--json"], stdout, err.into());
    wait_for("the report", || {
        let folder = std::fs::read_dir(&output).ok()?.next()?.unwrap().path();
        folder.join("summary.json").exists().then_some(())
    });
    let reading = read_all(out);
    assert_eq!(run.end().code(), Some(0));
    let text = text_within(&reading, LIMIT, "the pipe");
    let lines: Vec<serde_json::Value> = text
        .lines()
        .filter(|line| !line.is_empty())
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert!(lines.iter().any(|line| line["phase"] == "running"), "{text}");
    assert_eq!(lines.last().unwrap()["phase"], "ended", "{text}");
}
