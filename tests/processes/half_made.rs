//! Processes that are killed between creating a shared-memory segment and setting its size.

use std::path::Path;
use std::process::Command;

use crate::common::preload::library;
use crate::common::program::{
    Place, Run, assert_nothing_left, parts_of, session_folder, shared_memory_of, wait_for,
};
use crate::common::scenes;

/// Kills a part at one of its first segments, and checks that the run ends. Returns whether it was killed:
/// the number of segments depends on the order of connections.
fn ends_when_killed(library: &Path, part: &str, killed_at: usize) -> bool {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 0.2));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(&scene).arg("--output").arg(place.path("out")).arg("--quiet");
    command.env("LD_PRELOAD", library).env("KILLED_PART", part).env("KILLED_AT", killed_at.to_string());
    let ended = Run::of(command, place.path("out")).end();
    assert_nothing_left(ended.pid);
    if ended.code == Some(0) {
        return false;
    }
    let name = if part == "controller" { "holder" } else { part };
    let is_named = ended.err.contains(&format!("part `{name}` died (signal: 9"));
    assert!(ended.code == Some(1) && is_named, "{part} at {killed_at}: {:?} {}", ended.code, ended.err);
    true
}

/// Regression: the launcher opened the dead part's segment to clean up, and waited for its size forever.
#[test]
fn a_part_that_is_killed_while_it_makes_a_segment_hangs_no_run() {
    let library = library("processes/half_made.c");
    // The cases that hung, and one more of the controller, whose first segments may come after the end.
    let places = [("physics", &[2, 4, 16][..]), ("recorder", &[1, 2]), ("controller", &[2, 4])];
    for (part, places) in places {
        let killed = places.iter().filter(|killed_at| ends_when_killed(&library, part, **killed_at)).count();
        assert!(killed >= 1, "{part} was never killed");
    }
    std::fs::remove_file(library).unwrap();
}

/// Kills the launcher of a run without a recorder at one of its segments, and checks that every part ends.
/// Returns whether it was killed.
fn parts_end_when_the_launcher_is_killed(library: &Path, killed_at: usize) -> bool {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 0.2));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(&scene).args(["--no-record", "--quiet"]);
    command.env("LD_PRELOAD", library).env("KILLED_PART", "launcher").env("KILLED_AT", killed_at.to_string());
    let ended = Run::of(command, place.path("out")).end();
    let session = session_folder(ended.pid);
    wait_for("the end of all parts", || parts_of(&session).is_empty().then_some(()));
    // The next host removes the session.
    place.complete(&scenes::hold("lockstep", 0.05));
    assert!(!session.exists() && shared_memory_of(ended.pid).is_empty());
    ended.code.is_none()
}

/// Regression: without a recorder no part removed the segment, and every part waited for its size forever.
#[test]
fn a_launcher_that_is_killed_while_it_makes_a_segment_hangs_no_part() {
    let library = library("processes/half_made.c");
    let places = [4, 12, 18];
    let killed = places
        .iter()
        .filter(|killed_at| parts_end_when_the_launcher_is_killed(&library, **killed_at))
        .count();
    assert!(killed >= 1, "the launcher was never killed");
    std::fs::remove_file(library).unwrap();
}
