//! Processes that are killed between making a segment of shared memory and giving it its size.

use std::process::Command;

use crate::common::preload::library;
use crate::common::program::{Place, Run, assert_nothing_left};
use crate::common::scenes;

/// Kills a part at one of its first segments, and sees that the run ends for it.
fn assert_ends(library: &std::path::Path, part: &str, killed_at: usize) {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 0.2));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(&scene).arg("--output").arg(place.path("out")).arg("--quiet");
    command.env("LD_PRELOAD", library).env("KILLED_PART", part).env("KILLED_AT", killed_at.to_string());
    let ended = Run::of(command, place.path("out")).end();
    let name = if part == "controller" { "holder" } else { part };
    assert_eq!(ended.code, Some(1), "{part} at {killed_at}: {}", ended.err);
    assert!(
        ended.err.contains(&format!("part `{name}` died (signal: 9")),
        "{part} at {killed_at}: {}",
        ended.err
    );
    assert_nothing_left(ended.pid);
}

/// The launcher, which opened the segment of the dead part to clean up after it, waited for its size for ever.
#[test]
fn a_part_that_is_killed_while_it_makes_a_segment_hangs_no_run() {
    let library = match library("processes/half_made.c") {
        Ok(library) => library,
        Err(cause) => {
            eprintln!("SKIPPED: {cause}");
            return;
        }
    };
    // With those that hung: 2, 4, 16 of the physics, 1, 2 of the recorder, 4 of the controller.
    for (part, places) in
        [("physics", &[1, 2, 4, 8, 16, 24][..]), ("recorder", &[1, 2, 4]), ("controller", &[1, 2, 4])]
    {
        places.iter().for_each(|killed_at| assert_ends(&library, part, *killed_at));
    }
    std::fs::remove_file(library).unwrap();
}
