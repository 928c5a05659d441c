//! State that a run inherits from its parent: signals, timers, umask, priority, cores, low limits,
//! non-blocking streams.

use std::fs::File;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::fs::OFlags;
use rustix::process::Signal;
use test_support::limited::Limited;
use test_support::name_space::NameSpace;

use crate::common::program::{
    Guarded, Place, Run, assert_nothing_left, only_entry, segments_of, signal, wait_for,
};
use crate::common::scenes;

const PROGRAM: &str = env!("CARGO_BIN_EXE_trabecula");

/// Starts a run by another program, whose words come first.
fn started_by(words: &[&str], place: &Place, scene: &str) -> Run {
    let output = place.path("out");
    let mut command = Command::new(words[0]);
    command.args(&words[1..]).args([PROGRAM, "run"]).arg(place.scene(scene));
    command.arg("--output").arg(&output).arg("--quiet");
    Run::of(command, output)
}

/// Regression: with SIGCHLD ignored the launcher waited forever for parts that had ended, and printed without
/// end; with SIGTERM blocked each part had to be killed.
#[test]
fn a_run_ends_and_obeys_whatever_signals_its_parent_ignored_or_blocked() {
    let parents = [
        &["env", "--ignore-signal=CHLD"][..],
        &["env", "--block-signal=TERM,INT,HUP,CHLD,CONT", "--ignore-signal=CHLD,TERM,CONT"],
    ];
    for parent in parents {
        let place = Place::new();
        let run = started_by(parent, &place, &scenes::hold("lockstep", 0.05));
        let ended = run.end();
        assert_eq!(ended.code, Some(0), "{parent:?}: {}", ended.err);
        assert!(!ended.err.contains("did not end in time"), "{parent:?}: {}", ended.err);
        assert_nothing_left(ended.pid);
        let run = started_by(parent, &place, &scenes::hold("realtime", 600.0));
        run.session();
        signal(run.pid(), Signal::TERM);
        let ended = run.end();
        assert_eq!(ended.code, Some(130), "{parent:?}: {}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

/// Regression: a stack of 512 KiB was exceeded, and the program aborted.
#[test]
fn a_run_needs_no_more_stack_than_its_parent_leaves_it() {
    // A hard limit, and one that the program can raise.
    for limit in ["--stack=524288:524288", "--stack=65536:"] {
        let place = Place::new();
        let ended = started_by(&["prlimit", limit], &place, &scenes::hold("lockstep", 0.05)).end();
        assert_eq!(ended.code, Some(0), "{limit}: {}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

/// Regression: only an event in the log said that `--policy fifo` had no effect, as a data structure.
#[test]
fn a_run_without_the_permission_for_fifo_says_so() {
    // Root may do so, unless the permission is taken away before.
    let is_root = rustix::process::geteuid().is_root();
    let without: &[&str] =
        if is_root { &["setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice"] } else { &[] };
    let words = [without, &["prlimit", "--rtprio=0:0"]].concat();
    let place = Place::new();
    let scene = scenes::hold("realtime", 0.2).replace("seed = 7", "seed = 7\npolicy = \"fifo\"");
    let ended = started_by(&words, &place, &scene).end_well();
    let caution = "SCHED_FIFO is not permitted; the physics runs with nice ";
    assert!(ended.err.contains(&format!("caution: {caution}")), "{}", ended.err);
    let summary = std::fs::read_to_string(ended.folder.join("summary.json")).unwrap();
    assert!(summary.contains(caution), "{summary}");
    assert!(ended.out.contains(caution), "{}", ended.out);
}

/// Regression: a full disk of the sessions was an "InternalError" of a service, without the disk's name.
#[test]
fn a_session_without_space_on_its_disk_names_the_disk() {
    let place = Place::new();
    let runtime = tempfile::Builder::new().prefix("r").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let runtime = runtime.path();
    let (scene, output) = (place.scene(&scenes::hold("lockstep", 0.02)), place.path("out"));
    let mut refused = 0;
    for pages in [4, 8, 12, 16, 24, 32] {
        let space = match NameSpace::with_tmpfs(runtime, pages * 4096) {
            Ok(space) => space,
            Err(cause) => return println!("skipped: {cause}"),
        };
        std::fs::set_permissions(space.path(runtime), PermissionsExt::from_mode(0o700)).unwrap();
        let mut command = space.command();
        command.arg("env").arg(format!("XDG_RUNTIME_DIR={}", runtime.display())).args([PROGRAM, "run"]);
        command.arg(&scene).arg("--output").arg(&output).arg("--quiet");
        let ended = command.limited_output().unwrap();
        let said = String::from_utf8_lossy(&ended.stderr);
        if ended.status.code() == Some(1) {
            refused += 1;
            let named = said.contains(runtime.to_str().unwrap()) && said.contains("No space left on device");
            assert!(named, "{pages} pages: {said}");
        } else {
            assert_eq!(ended.status.code(), Some(0), "{pages} pages: {said}");
        }
    }
    assert!(refused > 0, "no disk was too small");
}

/// A command with at most this many processes. The kernel limits those of every user but root, counted by
/// user; so root runs it as a user that has none. `None` without the right to do so.
fn with_processes(most: u32, place: &Place, words: &[&str]) -> Option<Command> {
    const NOBODY_ELSE: &str = "3405691";
    let as_user = |words: &[&str]| {
        let mut command = Command::new("setpriv");
        command.args(["--reuid", NOBODY_ELSE, "--regid", NOBODY_ELSE, "--clear-groups"]).args(words);
        command.env("HOME", place.path("")).env_remove("XDG_RUNTIME_DIR");
        command
    };
    if !as_user(&[PROGRAM, "--version"]).limited_output().is_ok_and(|output| output.status.success()) {
        println!("skipped: no right to run as another user, or that user cannot run {PROGRAM}");
        return None;
    }
    Some(as_user(&[&["prlimit", &format!("--nproc={most}:{most}"), PROGRAM], words].concat()))
}

fn open_to_all(path: &Path) {
    let mode = if path.is_dir() { 0o777 } else { 0o666 };
    std::fs::set_permissions(path, PermissionsExt::from_mode(mode)).unwrap();
}

/// Regression: the launcher panicked when it could start a part but no thread to read its output.
#[test]
fn a_run_with_too_few_processes_is_refused_without_a_panic() {
    let place = Place::new();
    open_to_all(&place.path(""));
    let scene = place.scene(&scenes::hold("lockstep", 0.02));
    open_to_all(&scene);
    for most in 5..=15 {
        let Some(mut command) = with_processes(most, &place, &["run"]) else { return };
        command.arg(&scene).arg("--output").arg(place.path("out"));
        let output = command.arg("--quiet").limited_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!said.contains("panicked"), "{most} processes: {said}");
        assert!(matches!(output.status.code(), Some(0 | 1)), "{most} processes: {:?} {said}", output.status);
    }
}

/// Regression: a replay panicked when none of its workers could be started.
#[test]
fn a_replay_with_too_few_processes_ends_with_a_message() {
    let place = Place::new();
    open_to_all(&place.path(""));
    assert_eq!(started_by(&["env"], &place, &scenes::hold("lockstep", 0.02)).end().code, Some(0));
    let run = std::fs::read_dir(place.path("out")).unwrap().next().unwrap().unwrap().path();
    let log = run.join("run.mcap");
    [place.path("out"), run, log.clone()].iter().for_each(|path| open_to_all(path));
    let mut refused = 0;
    for most in 1..=6 {
        let Some(mut command) = with_processes(most, &place, &["replay", "--verify"]) else { return };
        let output = command.arg(&log).limited_output().unwrap();
        let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        assert!(!said.contains("panicked"), "{most} processes: {said}");
        match output.status.code() {
            Some(0) => assert!(said.contains("all identical"), "{most} processes: {said}"),
            Some(1) => {
                assert!(said.contains("Resource temporarily unavailable"), "{most} processes: {said}");
                refused += 1;
            }
            other => panic!("{most} processes: {other:?} {said}"),
        }
    }
    assert!(refused > 0, "no limit was too low");
    // Regression: it tries what is permitted in a thread.
    let Some(mut command) = with_processes(1, &place, &["doctor", "--seconds", "0"]) else { return };
    let output = command.limited_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!said.contains("panicked") && output.status.code() != Some(101), "{:?} {said}", output.status);
}

/// Regression: the viewer panicked when one of its threads could not be started.
#[test]
fn a_viewer_with_too_few_processes_ends_with_a_message() {
    let place = Place::new();
    open_to_all(&place.path(""));
    let text = scenes::drill_unseen("lockstep", 0.02);
    assert_eq!(started_by(&["env"], &place, &text).end().code, Some(0));
    let (scene, run) = (place.scene(&text), only_entry(&place.path("out")));
    let log = run.join("run.mcap");
    [place.path("out"), run, log.clone(), scene.clone()].iter().for_each(|path| open_to_all(path));
    let words = place.path("words.txt");
    for shown in [log, scene] {
        let mut refused = 0;
        for most in 1..=8 {
            let more = ["view", "--no-open", "--port", "0"];
            let Some(mut command) = with_processes(most, &place, &more) else { return };
            let output = File::create(&words).unwrap();
            command.arg(&shown).stdin(Stdio::null()).stderr(output.try_clone().unwrap()).stdout(output);
            let mut viewer = Guarded(command.spawn().unwrap());
            let said = || std::fs::read_to_string(&words).unwrap();
            let ended = wait_for("the page's address or the viewer's end", || {
                let ended = viewer.0.try_wait().unwrap();
                (ended.is_some() || said().contains("#token=")).then_some(ended)
            });
            let said = said();
            assert!(!said.contains("panicked"), "{most} processes: {said}");
            if let Some(status) = ended {
                assert_eq!(status.code(), Some(1), "{most} processes: {said}");
                assert!(said.contains("Resource temporarily unavailable"), "{most} processes: {said}");
                refused += 1;
            }
        }
        assert!(refused > 1, "{refused} limits were too low for {}", shown.display());
    }
}

/// Regression: a timer that the parent had set killed the launcher, and so the run. Its signal is blocked, so
/// that it cannot end the parent before `exec`: the launcher finds a pending signal and a running timer.
#[test]
fn a_timer_of_the_parent_does_not_end_a_run() {
    for (timer, its_signal) in [("REAL", "SIGALRM"), ("VIRTUAL", "SIGVTALRM"), ("PROF", "SIGPROF")] {
        let script = format!(
            "import os, signal, sys; its = {{signal.{its_signal}}}; signal.pthread_sigmask(signal.SIG_BLOCK, its); \
             signal.setitimer(signal.ITIMER_{timer}, 0.05, 0.05)\n\
             while not signal.sigpending(): pass\n\
             os.execvp(sys.argv[1], sys.argv[1:])"
        );
        let place = Place::new();
        let ended = started_by(&["python3", "-c", &script], &place, &scenes::hold("realtime", 0.5)).end();
        assert_eq!(ended.code, Some(0), "{timer}: {}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

/// A umask of 0 opens no file of the session to others, and one of 777 takes none from the user.
#[test]
fn a_sessions_files_have_their_modes_whatever_the_umask() {
    for umask in ["0000", "0777", "0277"] {
        let place = Place::new();
        let script = format!("umask {umask}; exec \"$@\"");
        let run = started_by(&["sh", "-c", &script, "sh"], &place, &scenes::hold("realtime", 600.0));
        let session = run.session();
        let log = wait_for("a log", || run.log());
        let mode = |path: &Path| path.metadata().map_or(0, |found| found.permissions().mode() & 0o7777);
        assert_eq!(mode(&session), 0o700, "umask {umask}");
        let mut checked = 0;
        for name in segments_of(&session) {
            let mode = mode(&Path::new("/dev/shm").join(&name));
            // 0: a segment that has gone meanwhile.
            assert!(
                mode == 0 || (mode & 0o077 == 0 && mode & 0o600 == 0o600),
                "umask {umask}: {name}: {mode:o}"
            );
            checked += u32::from(mode != 0);
        }
        assert!(checked > 5, "umask {umask}: {checked} segments");
        assert_eq!(mode(&log) & 0o600, 0o600, "umask {umask}: the user cannot read {}", log.display());
        signal(run.pid(), Signal::TERM);
        let ended = run.end();
        assert_eq!(ended.code, Some(130), "umask {umask}: {}", ended.err);
        assert_nothing_left(ended.pid);
    }
}

/// Priority, cores and OOM score are the user's wish: a run keeps them and completes.
#[test]
fn a_run_keeps_the_cores_and_the_score_that_it_was_given() {
    let place = Place::new();
    let words = ["nice", "-n", "15", "taskset", "-c", "0", "choom", "-n", "300", "--"];
    let run = started_by(&words, &place, &scenes::hold("realtime", 600.0));
    for part in ["physics", "recorder"] {
        let of = |name: &str| std::fs::read_to_string(format!("/proc/{}/{name}", run.part(part))).unwrap();
        assert_eq!(of("oom_score_adj").trim(), "300", "{part}");
        assert!(of("status").contains("Cpus_allowed_list:\t0\n"), "{part}: {}", of("status"));
    }
    signal(run.pid(), Signal::TERM);
    let ended = run.end();
    assert_eq!(ended.code, Some(130), "{}", ended.err);
    assert_nothing_left(ended.pid);
}

/// Regression: a command whose standard output was non-blocking lost what did not fit the pipe.
#[test]
fn a_non_blocking_stream_gets_the_whole_output() {
    let output = |is_blocking: bool| {
        let (mut reader, writer) = std::io::pipe().unwrap();
        if !is_blocking {
            rustix::fs::fcntl_setfl(&writer, OFlags::NONBLOCK).unwrap();
        }
        let mut command = Command::new(PROGRAM);
        command.args(["scene", "schema"]).stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped());
        let child = command.spawn().unwrap();
        drop(command);
        // More than a pipe holds waits for this reader.
        std::thread::sleep(Duration::from_millis(200));
        let mut text = Vec::new();
        reader.read_to_end(&mut text).unwrap();
        let ended = child.wait_with_output().unwrap();
        assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
        text
    };
    let expected = output(true);
    assert!(expected.len() > 1 << 16, "{} bytes fit a pipe", expected.len());
    assert!(output(false) == expected, "the output is not whole");
}
