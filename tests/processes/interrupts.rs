//! Ctrl-C, SIGTERM and SIGHUP at any moment of a run: acknowledged at once, obeyed soon, and nothing is left.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use fastrand::Rng;
use ipc_types::messages::PHASE_ENDED;
use ipc_types::process::is_alive;
use run_log::EndReason;
use rustix::process::Signal;
use test_support::limited::{COMMAND_LIMIT, Watchdog};

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{
    Ended, Guarded, LIMIT, Place, Run, assert_nothing_left, only_entry, parts_of, signal, wait_for,
};
use crate::common::scenes;
use crate::common::terminal::{Act, Terminal};

/// Interval between two checks of a run that should end.
const LOOK: Duration = Duration::from_millis(5);
/// Twice three seconds of checks: here the machine is shared with other tests.
const LOOKS: usize = 1200;
/// Two signals within 0.3 s count as one.
const ANOTHER: Duration = Duration::from_millis(500);

/// Waits for the end of a run that has received a signal.
fn obeyed(mut run: Run, after: &str) -> Ended {
    let looks = (0..LOOKS).take_while(|_| {
        std::thread::sleep(LOOK);
        !run.is_over()
    });
    let count = looks.count();
    assert!(count < LOOKS, "{after}: not over after {LOOKS} looks; it said: {}", run.said());
    run.end()
}

fn name(signal: Signal) -> &'static str {
    match signal {
        Signal::INT => "SIGINT",
        Signal::TERM => "SIGTERM",
        _ => "SIGHUP",
    }
}

/// Returns whether SIGHUP is ignored here, as under `nohup`, and prints that. Every program that a test
/// starts inherits this, and must keep it.
fn hangup_is_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap().trim();
    let is_ignored = u64::from_str_radix(mask, 16).unwrap() & 1 != 0;
    if is_ignored {
        eprintln!("*** SIGHUP is ignored here (nohup?): what it does is NOT tested ***");
    }
    is_ignored
}

/// Asserts that a run was ended by a signal: it said so, nothing is left, and the recording is complete.
fn assert_interrupted(place: &Place, ended: &Ended, sent: Signal, after: &str) {
    assert_nothing_left(ended.pid);
    if ended.code.is_none() {
        // Before the program printed anything.
        assert_eq!(ended.err, "", "{after}");
    } else {
        assert_eq!(ended.code, Some(130), "{after}: {}", ended.err);
        let answer = format!("trabecula: {}: ", name(sent));
        assert_eq!(ended.err.matches(&answer).count(), 1, "{after}: {}", ended.err);
        assert!(!ended.err.contains("died"), "{after}: {}", ended.err);
    }
    if !ended.folder.join("run.mcap").exists() {
        assert!(!place.path("out").exists(), "{after}: a folder without a log is left");
        return;
    }
    assert_eq!(read(&ended.folder).marker.unwrap().reason, EndReason::Interrupted, "{after}");
    assert!(ended.folder.join("summary.json").exists(), "{after}");
    assert_replays(&ended.folder);
}

/// Regression: the launcher signalled a physics that did not listen yet, and then waited two minutes for its
/// end; without a volume all ticks were completed first, and while a controller was awaited nothing happened
/// for 45 s.
#[test]
fn a_signal_at_any_moment_of_the_start_is_answered_and_obeyed() {
    let default_scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/femur_curved_drilling.toml");
    let default_scene = std::fs::read_to_string(default_scene).unwrap();
    let scenes = [
        scenes::drill("realtime", 600.0),
        scenes::drill("lockstep", 600.0),
        scenes::hold("lockstep", 600.0),
        scenes::piloted("lockstep", 600.0, ""),
        default_scene,
    ];
    let signals: &[Signal] = if hangup_is_ignored() {
        &[Signal::INT, Signal::TERM]
    } else {
        &[Signal::INT, Signal::TERM, Signal::HUP]
    };
    let mut random = Rng::with_seed(16);
    for (index, scene) in scenes.iter().cycle().take(10).enumerate() {
        let longest_ms = if index % scenes.len() == 4 { 4500 } else { 1200 };
        let (wait_ms, sent) = (random.u64(..longest_ms), signals[random.usize(..signals.len())]);
        let after = format!("scene {}, {} after {wait_ms} ms", index % scenes.len(), name(sent));
        let place = Place::new();
        let run = place.start(scene);
        std::thread::sleep(Duration::from_millis(wait_ms));
        signal(run.pid(), sent);
        let ended = obeyed(run, &after);
        assert_interrupted(&place, &ended, sent, &after);
    }
}

/// Waits until a run has completed some ticks.
fn under_way(run: &Run) {
    Client::at(run, 100);
}

#[test]
fn a_second_signal_ends_everything_at_once() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    under_way(&run);
    // The log cannot be finished; the launcher would wait for more than two minutes.
    signal(run.part("recorder"), Signal::STOP);
    signal(run.pid(), Signal::INT);
    wait_for("the answer", || run.said().contains("SIGINT: stopping the run").then_some(()));
    std::thread::sleep(ANOTHER);
    signal(run.pid(), Signal::INT);
    let ended = obeyed(run, "the second signal");
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert!(ended.err.contains("SIGINT: killing everything"), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert!(log.marker.is_none(), "the recorder was stopped");
    assert_replays(&ended.folder);
}

/// `timeout -s INT` signals the program and then its group, so the program receives two signals.
#[test]
fn two_signals_at_the_same_moment_are_one() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    under_way(&run);
    for _ in 0..3 {
        signal(run.pid(), Signal::INT);
        std::thread::sleep(Duration::from_millis(20));
    }
    let ended = obeyed(run, "three signals");
    assert_interrupted(&place, &ended, Signal::INT, "three signals");
}

/// Regression: a controller program that watches neither run nor signals was waited for, regardless of
/// signals.
#[test]
fn a_signal_while_the_end_is_under_way_is_obeyed() {
    let place = Place::new();
    let deaf = "[[controller]]\nname = \"deaf\"\ndrives = []\noptional = true\n\
                command = [\"sh\", \"-c\", \"trap '' TERM; while :; do sleep 1; done\"]\n";
    let run = place.start(&(scenes::hold("realtime", 1.0) + deaf));
    let client = Client::join(&run.session());
    wait_for("the run's last tick", || {
        client.status.receive().unwrap().filter(|status| status.message().phase == PHASE_ENDED).map(|_| ())
    });
    drop(client);
    signal(run.pid(), Signal::TERM);
    let ended = obeyed(run, "SIGTERM behind the last tick");
    assert!(ended.err.contains("deaf did not end in time and was killed"), "{}", ended.err);
    assert_interrupted(&place, &ended, Signal::TERM, "SIGTERM behind the last tick");
    assert_eq!(read(&ended.folder).ticks.len(), 1000);
}

/// Regression: pictures and summary of a long log take a while, during which signals were ignored.
#[test]
fn a_signal_while_the_report_is_made_is_obeyed_and_the_logs_are_whole() {
    let place = Place::new();
    let run = place.start(&scenes::hold("lockstep", 15.0));
    let session = run.session();
    wait_for("the recorder", || parts_of(&session).iter().any(|(part, _)| part == "recorder").then_some(()));
    wait_for("the recorder's end", || parts_of(&session).is_empty().then_some(()));
    wait_for("the session's end", || (!session.exists()).then_some(()));
    signal(run.pid(), Signal::INT);
    let ended = obeyed(run, "SIGINT during the report");
    assert_nothing_left(ended.pid);
    match ended.code {
        Some(130) => assert!(ended.err.contains("SIGINT: the logs are complete"), "{}", ended.err),
        code => assert!(code == Some(0) && ended.folder.join("summary.json").exists(), "{}", ended.err),
    }
    let log = read(&ended.folder);
    assert_eq!((log.ticks.len(), log.marker.unwrap().reason), (15_000, EndReason::Completed));
}

/// Regression: SIGHUP was not handled: no summary, and session and memory stayed.
#[test]
fn a_closed_terminal_ends_the_run_as_sigterm_does() {
    if hangup_is_ignored() {
        return;
    }
    let place = Place::new();
    let (scene, output) = (place.scene(&scenes::drill("realtime", 600.0)), place.path("out"));
    let mut terminal = Terminal::new(Act::Close, &scene, &output);
    let (launcher, session) = (terminal.launcher, terminal.session.clone());
    Client::join(&session).wait_for_state(|state| state.tick >= 100);
    terminal.tell("close");
    wait_for("the launcher's end", || (!is_alive(launcher)).then_some(()));
    assert_eq!(terminal.next_line(), "130");
    assert_nothing_left(launcher);
    let folder = only_entry(&output);
    assert_eq!(read(&folder).marker.unwrap().reason, EndReason::Interrupted);
    assert!(folder.join("summary.json").exists());
    assert_replays(&folder);
}

#[test]
fn an_ignored_sighup_stays_ignored() {
    let place = Place::new();
    let (scene, output) = (place.scene(&scenes::hold("realtime", 600.0)), place.path("out"));
    // As `nohup` starts a program.
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' HUP; exec \"$0\" run \"$1\" --output \"$2\" --quiet"]);
    command.arg(env!("CARGO_BIN_EXE_trabecula")).arg(&scene).arg(&output);
    let run = Run::of(command, output);
    let client = Client::join(&run.session());
    let tick = client.wait_for_state(|_| true).tick;
    signal(run.pid(), Signal::HUP);
    client.wait_for_state(|state| state.tick >= tick + 500);
    drop(client);
    signal(run.pid(), Signal::TERM);
    let ended = obeyed(run, "SIGTERM behind an ignored SIGHUP");
    assert!(!ended.err.contains("SIGHUP"), "{}", ended.err);
    assert_interrupted(&place, &ended, Signal::TERM, "SIGTERM behind an ignored SIGHUP");
}

/// A separate viewer ends with its terminal, too.
#[test]
fn a_viewer_ends_with_its_terminal() {
    if hangup_is_ignored() {
        return;
    }
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let session = run.session();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.args(["view", "--port", "0", "--no-open", "--session"]).arg(&session);
    let mut viewer = Guarded(command.stdout(Stdio::piped()).spawn().unwrap());
    let _watchdog = Watchdog::over(&viewer.0, COMMAND_LIMIT);
    let mut said = BufReader::new(viewer.0.stdout.take().unwrap());
    said.read_line(&mut String::new()).unwrap();
    signal(viewer.0.id(), Signal::HUP);
    let status = wait_for("the viewer's end", || viewer.0.try_wait().unwrap());
    assert_eq!(status.code(), Some(0), "{LIMIT:?}");
    drop(run);
}
