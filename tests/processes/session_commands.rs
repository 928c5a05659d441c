//! `trabecula session`, and the information that a script gets about a run.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use trabecula_client::{Client, ClientError, Connection};

use crate::common::logs::read;
use rustix::process::Signal;
use test_support::limited::Limited;

use crate::common::program::{
    Ended, LIMIT, Place, Run, assert_nothing_left, call, session_below, signal, trabecula, wait_for,
};
use crate::common::scenes;
use crate::strays::joined;

fn name_of(session: &Path) -> String {
    session.file_name().unwrap().to_str().unwrap().to_owned()
}

/// Runs a `session` command, which must succeed; returns its output.
fn told(words: &[&str], session: &str) -> String {
    let session: &[&str] = if words == ["list"] { &[] } else { &[session] };
    let done = call(&[&["session"][..], words, session].concat());
    assert_eq!(done.code, Some(0), "{words:?}: {}", done.err);
    done.out
}

/// Regression: the path was printed as it is, and `eval` ran what its name contained.
#[test]
fn the_variables_of_a_session_are_quoted_for_the_shell() {
    let place = Place::new();
    // The path of a run-time folder has at most 16 bytes.
    let runtime = tempfile::Builder::new().prefix(";eval x;").rand_bytes(3).tempdir_in("/tmp").unwrap();
    let runtime = runtime.path();
    fs::set_permissions(runtime, Permissions::from_mode(0o700)).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let (scene, output) = (place.scene(&scenes::hold("realtime", 600.0)), place.path("out"));
    command.arg("run").arg(scene).arg("--quiet").arg("--output").arg(&output);
    command.env("XDG_RUNTIME_DIR", runtime);
    let run = Run::of(command, output);
    let session = session_below(runtime);
    let variables = told(&["env"], session.to_str().unwrap());
    let script = format!("{variables}\nprintf %s \"$TRABECULA_SESSION\"");
    let read = Command::new("sh").args(["-c", &script]).current_dir(place.path("")).limited_output().unwrap();
    assert_eq!(String::from_utf8_lossy(&read.stdout), session.to_str().unwrap(), "{variables}");
    signal(run.pid(), Signal::INT);
    assert_eq!(run.end().code, Some(130));
}

#[test]
fn a_run_is_listed_paused_resumed_and_stopped_from_the_command_line() {
    let place = Place::new();
    let scene =
        scenes::shared("realtime", 600.0).replace("external = true", "external = true\noptional = true");
    let run = place.start(&scene);
    let (folder, name) = (run.session(), name_of(&run.session()));
    let mut watcher = joined(&run, "");
    watcher.wait_state(LIMIT).unwrap();
    let list = told(&["list"], &name);
    let line = list.lines().find(|line| line.starts_with(&name)).unwrap();
    assert!(
        line.contains("shared  controllers: pilot, holder") && line.contains(folder.to_str().unwrap()),
        "{line}"
    );
    let variables = told(&["env"], &name);
    let expected =
        format!("export TRABECULA_SESSION={}\nexport TRABECULA_CONTROLLER=pilot\n", folder.display());
    assert_eq!(variables, expected);
    assert!(told(&["pause"], &name).starts_with(&format!("session {name}: pause at tick ")));
    let paused = |client: &mut Client| client.status().unwrap().is_some_and(|status| status.phase == 2);
    wait_for("the pause", || paused(&mut watcher).then_some(()));
    told(&["resume"], folder.to_str().unwrap());
    wait_for("the end of the pause", || (!paused(&mut watcher)).then_some(()));
    assert!(told(&["stop"], &name).contains(": stop at tick "));
    drop(watcher);
    let ended = run.end_well();
    assert!(ended.out.contains("stopped"), "{}", ended.out);
    assert_nothing_left(ended.pid);
    let gone = trabecula(&[&"session", &"stop", &name]);
    assert_eq!(gone.code, Some(2), "{}", gone.err);
    assert!(gone.err.contains(&format!("no running session `{name}`")), "{}", gone.err);
}

/// Regression: a program that named no session joined the one announced last, possibly another user's or a
/// forgotten one.
#[test]
fn of_several_sessions_none_is_taken_unnamed() {
    let places = [Place::new(), Place::new()];
    let runs = places.each_ref().map(|place| place.start(&scenes::shared("realtime", 600.0)));
    let folders = runs.each_ref().map(Run::session);
    let refusal = Client::connect(&Connection::observer()).unwrap_err();
    let text = refusal.to_string();
    assert!(matches!(refusal, ClientError::Session(_)), "{text}");
    assert!(folders.iter().all(|folder| text.contains(folder.to_str().unwrap())), "{text}");
    assert!(text.contains("select one") && text.contains("TRABECULA_SESSION"), "{text}");
    for words in [["session", "stop"], ["view", "--no-open"]] {
        let done = trabecula(&[&words[0], &words[1]]);
        assert!(done.code == Some(2) && done.err.contains("select one"), "{words:?}: {}", done.err);
    }
    for run in runs {
        told(&["stop"], &name_of(&run.session()));
        assert_eq!(run.end().code, Some(0));
    }
}

/// Every rejection by a session names it.
#[test]
fn a_refusal_names_the_session() {
    let place = Place::new();
    let run = place.start(&scenes::shared("realtime", 600.0));
    let session = run.session().to_str().unwrap().to_owned();
    let nobody = Connection {
        session: Some(session.clone()),
        controller: Some("nobody".to_owned()),
        ..Connection::default()
    };
    let text = Client::connect(&nobody).unwrap_err().to_string();
    assert_eq!(
        text,
        format!("session {session}: the scene has no controller `nobody`; it has: pilot, holder")
    );
    told(&["stop"], &name_of(Path::new(&session)));
    assert_eq!(run.end().code, Some(0));
}

fn lines(ended: &Ended) -> Vec<Value> {
    ended.out.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Regression: a script had only the folder and the outcome, and had to search for everything else.
#[test]
fn a_script_learns_session_outcome_and_figures() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 0.3));
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let output = place.path("out");
    command.arg("run").arg(&scene).arg("--output").arg(&output).arg("--json");
    let ended = Run::of(command, output).end_well();
    let lines = lines(&ended);
    let (first, last) = (&lines[0], lines.last().unwrap());
    assert_eq!((&first["phase"], &last["phase"]), (&"announced".into(), &"ended".into()));
    assert!(first["session"].as_str().is_some_and(|session| session.starts_with('/')), "{first}");
    assert_eq!((&last["session"], &last["outcome"]), (&first["session"], &"completed".into()));
    assert_eq!(last["summary"]["ticks"], 300);
    assert_eq!(last["summary"], ended.summary());
    assert_eq!(read(&ended.folder).ticks.len(), 300);
    // And as text.
    let quiet = place.start(&scenes::hold("lockstep", 0.3)).end();
    assert!(quiet.out.starts_with("session      /") && quiet.out.contains(", completed\n"), "{}", quiet.out);
    let unrecorded = trabecula(&[&"run", &scene, &"--quiet", &"--no-record"]);
    assert!(unrecorded.out.ends_with("outcome      completed\n"), "{}", unrecorded.out);
}
