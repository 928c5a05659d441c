//! Shared memory that is full: the transport writes into a segment before it is reserved, which was a SIGBUS.

use std::path::Path;

use crate::common::program::Place;
use crate::common::scenes;
use crate::name_space::NameSpace;
use crate::trial::{MEMORY, memory_left, start_in};

/// Less than a session's first port needs: the error names the place and the bytes, and no signal ends the program.
#[test]
fn a_full_shared_memory_is_an_error_and_no_sigbus() {
    let space = match NameSpace::with_tmpfs(Path::new(MEMORY), 64 << 10) {
        Ok(space) => space,
        Err(reason) => return println!("\n*** SKIPPED: {reason} ***\n"),
    };
    let place = Place::new();
    let ended = start_in(&space, &place, &place.path("out"), &scenes::hold("lockstep", 0.02)).end();
    assert_eq!(ended.code, Some(1), "a signal has no exit code: {}", ended.err);
    let words = ["/dev/shm: ", "bytes of shared memory for service", "cannot be reserved", "enlarge it"];
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
