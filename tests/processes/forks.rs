//! Programs in C that fork, and that call a client from a signal handler. In Python:
//! `clients/python/tests/test_forks.py` and `test_lifetimes.py`.

use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, Place, assert_nothing_left};
use crate::languages::{clients, compiled_test, output_within_limit};

/// Completes a run with a program of `clients/c/tests` as its controller.
fn completed_by(program: &str, place: &Place) -> Ended {
    let scene = std::fs::read_to_string(clients().join("scenes/free_space.toml")).unwrap();
    let run = place.start(&scene);
    let mut controller = Command::new(compiled_test(program, place));
    controller.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_within_limit(&mut controller), "ended\n");
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    ended
}

/// Regression: a call in the middle of another panicked inside the handler.
#[test]
fn a_call_from_a_signal_handler_in_the_middle_of_another_is_refused_in_c() {
    completed_by("signals", &Place::new());
}

/// A client belongs to the process that created it. Regression: the normal exit of a child ran the clean-up
/// of its parent's client, and so ended the run.
#[test]
fn a_forked_child_that_exits_does_not_disconnect_its_parent_in_c() {
    let place = Place::new();
    let ended = completed_by("forked", &place);
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
}
