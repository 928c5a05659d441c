//! Where sessions are stored, what is removed there and what never is, and a session whose folder is removed.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;

use ipc_types::messages::{CONTROL_RESUME, CONTROL_STOP};
use tempfile::TempDir;
use trabecula_client::{Client, ClientError, Connection};

use test_support::limited::Limited;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{LIMIT, Place, Run, assert_nothing_left, segments_of, session_below, trabecula};
use crate::common::scenes;
use crate::strays::joined;

const VARIABLE: &str = "XDG_RUNTIME_DIR";

/// A folder with a path as short as a run-time folder's, because sockets are created below it.
fn short_folder() -> TempDir {
    folder_with(6)
}

/// A folder with this number of random letters in its name, private like a run-time folder.
fn folder_with(letters: usize) -> TempDir {
    let folder = tempfile::Builder::new().prefix("t").rand_bytes(letters).tempdir_in("/tmp").unwrap();
    fs::set_permissions(folder.path(), Permissions::from_mode(0o700)).unwrap();
    folder
}

/// Returns the command of a short run with this run-time folder, started in a folder.
fn launcher(place: &Place, scene: &str, runtime: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(place.scene(scene)).arg("--output").arg(place.path("out")).arg("--quiet");
    command.env(VARIABLE, runtime).current_dir(place.path(""));
    command
}

/// A user's files: sources in a clone named `trabecula`, in one named like the folder of sessions, and in
/// folders with names like sessions; a link to a home; and a session of a dead host, the only thing that may
/// be removed.
struct Content {
    files: Vec<PathBuf>,
    dead: PathBuf,
}

impl Content {
    fn lay(runtime: &Path, sessions: &Path) -> Content {
        let home = runtime.join("home");
        let named = ["0123456789a", "ABCDEFGHIJK", "src"].map(|name| sessions.join(name));
        let clone = runtime.join("trabecula");
        let mut files = Vec::new();
        for folder in
            [&home, &clone, &clone.join("0123456789a"), &clone.join("src")].into_iter().chain(&named)
        {
            fs::create_dir_all(folder).unwrap();
            fs::set_permissions(folder, Permissions::from_mode(0o700)).unwrap();
            fs::write(folder.join("main.rs"), "fn main() {}").unwrap();
            files.push(folder.join("main.rs"));
        }
        fs::write(home.join("session.id"), "zzzzzzzzzzz").unwrap();
        symlink(&home, sessions.join("zzzzzzzzzzz")).unwrap();
        let dead = sessions.join("deadDEAD012");
        fs::create_dir(&dead).unwrap();
        fs::set_permissions(&dead, Permissions::from_mode(0o700)).unwrap();
        fs::write(dead.join("session.id"), "deadDEAD012").unwrap();
        Content { files, dead }
    }

    fn assert_whole(&self, what: &str) {
        for file in &self.files {
            assert_eq!(fs::read(file).unwrap(), b"fn main() {}", "{what}: {}", file.display());
        }
    }
}

/// Regression: every folder below that of the sessions was emptied before its owner was checked: a clone of
/// the sources, and through a link a home.
#[test]
fn nothing_is_wiped_before_everything_is_checked() {
    let place = Place::new();
    for what in ["everybody may enter it", "it is a link", "it is not a folder", "it is another user's"] {
        let runtime = short_folder();
        let sessions = runtime.path().join("trabecula-hubs");
        fs::create_dir(&sessions).unwrap();
        fs::set_permissions(&sessions, Permissions::from_mode(0o700)).unwrap();
        let content = Content::lay(runtime.path(), &sessions);
        let elsewhere = runtime.path().join("elsewhere");
        let seen = match what {
            "everybody may enter it" => {
                fs::set_permissions(&sessions, Permissions::from_mode(0o777)).unwrap();
                &sessions
            }
            "it is another user's" if rustix::process::geteuid().is_root() => {
                std::os::unix::fs::chown(&sessions, Some(65_534), None).unwrap();
                &sessions
            }
            "it is another user's" => {
                println!("\n*** SKIPPED in part: only root can make another user's folder ***\n");
                continue;
            }
            _ => {
                fs::rename(&sessions, &elsewhere).unwrap();
                if what == "it is a link" {
                    symlink(&elsewhere, &sessions).unwrap();
                } else {
                    fs::write(&sessions, "").unwrap();
                }
                &elsewhere
            }
        };
        let output =
            launcher(&place, &scenes::hold("lockstep", 0.05), runtime.path()).limited_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{what}: {said}");
        let words = ["trabecula-hubs", "belongs to this user and is closed to others", VARIABLE];
        assert!(words.iter().all(|word| said.contains(word)), "{what}: {said}");
        assert_eq!(fs::read_dir(seen).unwrap().count(), 5, "{what}: {said}");
        if *seen == sessions {
            content.assert_whole(what);
            assert!(content.dead.join("session.id").exists(), "{what}: not even a dead session is wiped");
        }
    }
}

/// A run-time folder that cannot hold sessions is skipped and left unchanged; in one that can, only a dead
/// host's session is removed.
#[test]
fn a_folder_of_the_users_is_never_wiped_by_a_run() {
    let place = Place::new();
    let relative = place.path("relative");
    for what in ["good", "empty", "relative", "everybody's", "missing", "a link"] {
        let runtime = match what {
            "relative" | "empty" => {
                fs::create_dir_all(&relative).unwrap();
                None
            }
            _ => Some(short_folder()),
        };
        let folder = runtime.as_ref().map_or(relative.as_path(), TempDir::path);
        // An empty variable made the path relative to the current folder.
        let above = if what == "empty" { place.path("") } else { folder.to_owned() };
        let sessions = above.join("trabecula-hubs");
        fs::create_dir(&sessions).unwrap();
        fs::set_permissions(&sessions, Permissions::from_mode(0o700)).unwrap();
        let content = Content::lay(&above, &sessions);
        let link = place.path("link");
        let named = match what {
            "good" => folder.to_owned(),
            "empty" => PathBuf::new(),
            "relative" => PathBuf::from("relative"),
            "everybody's" => {
                fs::set_permissions(folder, Permissions::from_mode(0o1777)).unwrap();
                folder.to_owned()
            }
            "missing" => folder.join("n"),
            _ => {
                symlink(folder, &link).unwrap();
                link
            }
        };
        let output = launcher(&place, &scenes::hold("lockstep", 0.05), &named).limited_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{what}: {said}");
        content.assert_whole(what);
        let is_good = what == "good";
        assert_eq!(content.dead.exists(), !is_good, "{what}: {said}");
        assert_eq!(said.contains("is not used"), !is_good, "{what}: {said}");
        assert!(!folder.join("n").exists(), "{what}: nothing is made");
        assert_eq!(fs::read_dir(&sessions).unwrap().count(), if is_good { 4 } else { 5 }, "{what}");
        for left in ["home", "trabecula", "trabecula-hubs"] {
            fs::remove_dir_all(above.join(left)).unwrap();
        }
    }
}

/// The names of a session's sockets fit into the system's limit of 108 bytes in the longest run-time folder
/// that is accepted; a longer one is skipped.
#[test]
fn a_run_works_in_the_longest_run_time_folder() {
    let place = Place::new();
    for (random, is_taken) in [(10, true), (11, false)] {
        let runtime = folder_with(random);
        let output = launcher(
            &place,
            &scenes::shared("lockstep", 0.05).replace("external = true", "hold = { tension_n = 1.0 }"),
            runtime.path(),
        )
        .limited_output()
        .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert_eq!(runtime.path().join("trabecula-hubs").exists(), is_taken, "{said}");
        assert_eq!(said.contains("socket paths inside it are too long"), !is_taken, "{said}");
    }
}

/// Regression: two hubs in two containers can have the same process ID. With one `/dev/shm` they used the
/// same names there, and the one that ended first removed the other's memory.
#[test]
fn two_hubs_in_two_pid_namespaces_do_not_meet() {
    let unshare = ["--user", "--map-root-user", "--pid", "--fork", "--kill-child"];
    let own = if rustix::process::geteuid().is_root() { &unshare[2..] } else { &unshare[..] };
    if !Command::new("unshare").args(own).arg("true").status().is_ok_and(|status| status.success()) {
        return println!("\n*** SKIPPED: the system permits no process namespaces ***\n");
    }
    let places = [Place::new(), Place::new()];
    let runtimes = [short_folder(), short_folder()];
    let start = |index: usize, seconds: f64| {
        let inner = launcher(&places[index], &scenes::hold("realtime", seconds), runtimes[index].path());
        let mut command = Command::new("unshare");
        command
            .args(own)
            .arg(inner.get_program())
            .args(inner.get_args())
            .env(VARIABLE, runtimes[index].path());
        Run::of(command, places[index].path("out"))
    };
    let session = |index: usize| session_below(runtimes[index].path());
    let memory = |session: &Path| segments_of(session).len();
    let long = start(0, 30.0);
    let long_session = session(0);
    let short = start(1, 0.5);
    let short_session = session(1);
    let announced = |session: &Path| fs::read_to_string(session.join("session.json")).unwrap();
    for session in [&long_session, &short_session] {
        assert!(announced(session).contains("\"pid\": 1,"), "each is the first process of its namespace");
    }
    assert_ne!(long_session.file_name(), short_session.file_name());
    short.end_well();
    assert!(memory(&long_session) > 10 && memory(&short_session) == 0);
    // A third one starts, whose search for dead sessions finds the first one alive.
    let third = start(1, 0.2).end();
    assert_eq!(third.code, Some(0), "{}", third.err);
    assert!(memory(&long_session) > 10);
    let ended = long.end_well();
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_eq!(memory(&long_session), 0);
    assert_replays(&ended.folder);
}

/// The end of a login, or a cleaner of `/tmp`, removes the session's folder. Regression: clients reported
/// that the hub was gone, and left a run that continued.
#[test]
fn a_run_whose_session_folder_is_removed_goes_on_with_its_clients() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let mut client = joined(&run, "");
    client.run_control(CONTROL_RESUME, 0, LIMIT).unwrap();
    let first = client.wait_state(LIMIT).unwrap().tick;
    let session = run.session();
    fs::remove_dir_all(&session).unwrap();
    // Long enough for several checks whether the hub lives, which a waiting client makes ten times per
    // second.
    while client.wait_state(LIMIT).unwrap().tick < first + 1500 {
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let late = Connection {
        session: Some(session.to_str().unwrap().to_owned()),
        controller: Some(String::new()),
        limit: std::time::Duration::from_millis(200),
    };
    let refusal = Client::connect(&late).unwrap_err();
    assert!(matches!(refusal, ClientError::NoSession { .. }), "{refusal}");
    let refusal = refusal.to_string();
    let words = [session.to_str().unwrap(), "whose folder was removed, cannot be joined"];
    assert!(words.iter().all(|word| refusal.contains(word)), "{refusal}");
    client.run_control(CONTROL_STOP, 0, LIMIT).unwrap();
    drop(client);
    let ended = run.end_well();
    assert_eq!(
        ended.err.matches("the session's folder was removed; the run continues").count(),
        1,
        "{}",
        ended.err
    );
    assert_nothing_left(ended.pid);
    assert_eq!(segments_of(&session), Vec::<String>::new());
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
}

/// Regression: a run from cron, without the variable, and a viewer on the desktop, with it, did not find each
/// other.
#[test]
fn programs_with_and_without_a_run_time_folder_find_each_other() {
    let place = Place::new();
    let mut command = launcher(&place, &scenes::hold("realtime", 600.0), Path::new(""));
    command.env_remove(VARIABLE);
    let run = Run::of(command, place.path("out"));
    let (session, runtime) = (run.session(), short_folder());
    let mut list = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let list = list.args(["session", "list"]).env(VARIABLE, runtime.path()).limited_output().unwrap();
    let listed = String::from_utf8(list.stdout).unwrap();
    assert!(listed.contains(session.to_str().unwrap()), "{listed}");
    let client = joined(&run, "");
    crate::strays::stopped(run, client, ());
}

/// Regression: a client waited ten seconds, or its limit, for `/etc` to become a session.
#[test]
fn a_name_that_can_never_be_a_session_is_refused_at_once() {
    for given in ["/etc", "/nowhere/at-all", "/tmp/", "..", "mine", "AAAAAAAAAA-"] {
        let connection = Connection {
            session: Some(given.to_owned()),
            controller: Some(String::new()),
            // Far too long to wait for.
            limit: std::time::Duration::from_secs(100_000),
        };
        let (sender, receiver) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            sender.send(Client::connect(&connection).map(|_| ()).unwrap_err().to_string())
        });
        let refusal = receiver.recv_timeout(LIMIT).unwrap_or_else(|_| panic!("{given} is still waited for"));
        assert!(
            refusal.contains("cannot be a session") && refusal.contains("11 letters and digits"),
            "{refusal}"
        );
    }
    let done = trabecula(&[&"view", &"--session", &"/etc", &"--no-open", &"--port", &"0"]);
    assert!(done.code == Some(2) && done.err.contains("cannot be a session"), "{}", done.err);
}
