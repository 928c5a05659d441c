//! Shared memory that is full, read-only, or has no room for more files.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use crate::common::program::{Ended, Place, Run};
use crate::common::scenes;
use crate::name_space::NameSpace;
use crate::scarce::{MEMORY, memory_left, start_in};

/// The transport writes into a segment before it is reserved, which was a SIGBUS. Less than a session's first port needs: the error names the place and the bytes, and no signal ends the program.
#[test]
fn a_full_shared_memory_is_an_error_and_no_sigbus() {
    let space = match NameSpace::with_tmpfs(Path::new(MEMORY), 64 << 10) {
        Ok(space) => space,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let place = Place::new();
    let ended = start_in(&space, &place, &place.path("out"), &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(ended.code, Some(1), "a signal has no exit code: {}", ended.err);
    let words =
        ["/dev/shm: ", "bytes of shared memory for service", "cannot be reserved", "enlarge /dev/shm"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
    assert_eq!(memory_left(&space), Vec::<String>::new());
}

/// The need was reckoned with as many copies of the CT as it may have readers: 35 times its bytes, where there is one.
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

/// A run in a namespace of this user's own, with its sessions in the test's folder; none, aloud, where that is not permitted.
fn run_with_memory(options: &str) -> Option<Ended> {
    let space = match NameSpace::of_own_user(Path::new(MEMORY), options) {
        Ok(space) => space,
        Err(reason) => {
            println!("\n*** SKIPPED: {reason} ***\n");
            return None;
        }
    };
    let place = Place::new();
    std::fs::set_permissions(place.path(""), Permissions::from_mode(0o700)).unwrap();
    let (scene, output) = (place.scene(&scenes::hold("lockstep", 0.02)), place.path("out"));
    let mut command = space.command();
    command.arg(env!("CARGO_BIN_EXE_trabecula")).arg("run").arg(scene).arg("--output").arg(&output);
    command.arg("--quiet").env("XDG_RUNTIME_DIR", place.path(""));
    let ended = Run::of(command, output).end();
    assert_eq!(memory_left(&space), Vec::<String>::new(), "{options}");
    let sessions = std::fs::read_dir(place.path("trabecula-hubs"));
    let sessions = sessions.unwrap_or_else(|cause| panic!("{options}: {cause}: {}", ended.err)).count();
    assert_eq!(sessions, 0, "{options}: a session is left");
    Some(ended)
}

/// "creating a node failed (UnableToGenerateUniqueNodeId)": not where, nor why, nor what to do.
#[test]
fn a_read_only_shared_memory_is_named() {
    let Some(ended) = run_with_memory("ro") else { return };
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    let words = ["/dev/shm: ", "creating a node", "Read-only file system", "remount,rw"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
}

/// "publishing failed (UnableToCreateDataSegment)": there were bytes enough.
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
