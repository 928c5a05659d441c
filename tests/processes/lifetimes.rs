//! Client calls from signal handlers. Lifetimes of what the client returns to Python:
//! `clients/python/tests/test_lifetimes.py`.

use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};

use crate::common::program::{Place, assert_nothing_left};
use crate::languages::{clients, compiled_test, output_within_limit};

/// Regression: a call in the middle of another panicked inside the handler.
#[test]
fn a_call_from_a_signal_handler_in_the_middle_of_another_is_refused_in_c() {
    let place = Place::new();
    let scene = std::fs::read_to_string(clients().join("scenes/free_space.toml")).unwrap();
    let run = place.start(&scene);
    let mut program = Command::new(compiled_test("signals", &place));
    program.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_within_limit(&mut program), "ended\n");
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
}
