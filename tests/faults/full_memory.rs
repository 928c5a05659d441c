//! Shared memory that is full, read-only, without room for more files, or another container's.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use test_support::name_space::NameSpace;

use crate::common::program::{Ended, Place, Run, kill_all, parts_of, segments_of, session_below, wait_for};
use crate::common::scenes;
use crate::scarce::{MEMORY, memory_left, start_in};

/// Regression: the transport wrote to a segment before it was reserved, which was a SIGBUS. With less than a
/// session needs, the run is refused with the place and the size, and no signal ends the program.
#[test]
fn a_full_shared_memory_is_an_error_and_no_sigbus() {
    let space = match NameSpace::with_tmpfs(Path::new(MEMORY), 64 << 10) {
        Ok(space) => space,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let place = Place::new();
    let ended = start_in(&space, &place, &place.path("out"), &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(ended.code, Some(2), "a signal has no exit code: {}", ended.err);
    let words = ["/dev/shm: ", "MiB of shared memory", "0 MiB are free", "enlarge /dev/shm"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
    assert_eq!(memory_left(&space), Vec::<String>::new());
}

/// Regression: the requirement was computed with as many copies of the CT as it can have readers: 35 times
/// its size, although there is only one copy.
#[test]
fn the_default_scene_runs_with_one_gibibyte_of_shared_memory() {
    let space = match NameSpace::with_tmpfs(Path::new(MEMORY), 1 << 30) {
        Ok(space) => space,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let place = Place::new();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/femur_curved_drilling.toml");
    let scene = std::fs::read_to_string(scene).unwrap();
    let short =
        scene.replace("duration_s = 24.0", "duration_s = 0.05").replace("\"realtime\"", "\"lockstep\"");
    assert_ne!(scene, short);
    let ended = start_in(&space, &place, &place.path("out"), &short).end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_eq!(memory_left(&space), Vec::<String>::new());
}

/// Completes a run with such a shared memory.
fn run_with_memory(options: &str) -> Option<Ended> {
    let space = own_memory(options)?;
    let place = private_place();
    let ended = start(space.command(), &place, &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(memory_left(&space), Vec::<String>::new(), "{options}");
    let sessions = std::fs::read_dir(place.path("trabecula-hubs"));
    let sessions = sessions.unwrap_or_else(|cause| panic!("{options}: {cause}: {}", ended.err)).count();
    assert_eq!(sessions, 0, "{options}: a session is left");
    Some(ended)
}

/// Creates a namespace of this user's own with such a shared memory; `None`, with a message, if that is not
/// permitted.
fn own_memory(options: &str) -> Option<NameSpace> {
    let space = NameSpace::of_own_user(Path::new(MEMORY), options);
    space.inspect_err(|reason| println!("\n*** SKIPPED: {reason} ***\n")).ok()
}

/// A place that may be the user's run-time folder.
fn private_place() -> Place {
    let place = Place::new();
    std::fs::set_permissions(place.path(""), Permissions::from_mode(0o700)).unwrap();
    place
}

/// Starts a run by a command that takes a program as its arguments, with its sessions in the test's folder.
fn start(mut command: Command, place: &Place, scene: &str) -> Run {
    let (scene, output) = (place.scene(scene), place.path("out"));
    command.arg(env!("CARGO_BIN_EXE_trabecula")).arg("run").arg(scene).arg("--output").arg(&output);
    command.arg("--quiet").env("XDG_RUNTIME_DIR", place.path(""));
    Run::of(command, output)
}

/// Regression: "creating a node failed (UnableToGenerateUniqueNodeId)" named neither place nor cause nor
/// remedy.
#[test]
fn a_read_only_shared_memory_is_named() {
    let Some(ended) = run_with_memory("ro") else { return };
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    let words = ["/dev/shm: ", "creating a node", "Read-only file system", "remount,rw"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
}

/// Regression: "publishing failed (UnableToCreateDataSegment)", although there were enough bytes.
#[test]
fn a_shared_memory_with_no_room_for_more_files_is_named() {
    let mut codes = Vec::new();
    for files in [2, 5, 10, 15, 20, 25, 30, 40, 50, 200] {
        let Some(ended) = run_with_memory(&format!("size=1g,nr_inodes={files}")) else { return };
        codes.push(ended.code);
        if ended.code == Some(0) {
            continue;
        }
        assert_eq!(ended.code, Some(1), "{files}: {}", ended.err);
        let words = ["/dev/shm: ", "more files", "nr_inodes"];
        assert!(words.iter().all(|word| ended.err.contains(word)), "{files}: {}", ended.err);
    }
    assert_eq!((codes[0], codes.last()), (Some(1), Some(&Some(0))), "{codes:?}");
}

/// Regression: two containers with one `/tmp`, each with its own `/dev/shm`: the hub of one removed the
/// folder of a killed session of the other, whose memory could then no longer be found.
#[test]
fn a_killed_session_in_another_shared_memory_is_left_to_a_hub_that_sees_it() {
    let Some(space) = own_memory("size=1g") else { return };
    let place = private_place();
    let killed = start(Command::new("env"), &place, &scenes::hold("realtime", 600.0));
    let session = session_below(&place.path(""));
    wait_for("its parts", || (parts_of(&session).len() >= 3).then_some(()));
    kill_all(killed.pid(), &session);
    assert_eq!(killed.end().code, None);
    wait_for("the end of its parts", || parts_of(&session).is_empty().then_some(()));
    let left = segments_of(&session);
    assert!(left.len() > 10, "{left:?}");
    let short = scenes::hold("lockstep", 0.02);
    assert_eq!(start(space.command(), &place, &short).end().code, Some(0));
    assert_eq!(
        (session.exists(), segments_of(&session)),
        (true, left),
        "of a hub that does not see its memory"
    );
    assert_eq!(start(Command::new("env"), &place, &short).end().code, Some(0));
    assert_eq!((session.exists(), segments_of(&session)), (false, vec![]), "of a hub that sees its memory");
}
