//! What a client hands out to Python stays mapped for as long as Python holds it.

use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};

use crate::common::program::{Place, assert_nothing_left};
use crate::languages::{clients, compiled_test, output_within_limit, python, skip};

/// The block in front of the burr, seen by a C-arm, driven by an external `mine`; another one may join.
pub fn imaged() -> String {
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    let text = text.replace("burr_start_mm = [0.0, 0.0, -45.0]", "burr_start_mm = [0.0, 0.0, -34.0]");
    let text = text.replace("mode = \"lockstep\"", "mode = \"lockstep\"\ncontroller_limit_ms = 60000");
    let other = "\n[[controller]]\nname = \"other\"\ndrives = []\nexternal = true\noptional = true\n";
    text + other
}

/// Runs a case of `lifetimes.py`, which ends by a signal if it touches memory that is gone.
fn assert_whole(case: &str) {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => return skip(&reason),
    };
    let place = Place::new();
    let run = place.start(&imaged());
    let mut program = Command::new(python);
    program.args(["-X", "faulthandler"]).arg(clients().join("python/tests/lifetimes.py")).arg(case);
    program.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_within_limit(&mut program), "whole\n");
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
}

/// SIGSEGV: a wait for a frame gave the one before back at once, and its memory went with the DRR process.
#[test]
fn the_last_frame_is_there_after_wait_frame_has_said_that_the_run_is_over() {
    assert_whole("the_last_frame_after_the_end");
}

/// The same of removed voxels.
#[test]
fn the_last_removal_is_there_after_a_look_for_the_next_one() {
    assert_whole("the_last_removal_after_a_look_in_vain");
}

/// SIGSEGV: a thread's clients end with it, and with them went the memory of arrays that others hold.
#[test]
fn a_volume_is_there_after_the_thread_that_made_its_client() {
    assert_whole("the_volume_after_its_thread");
}

#[test]
fn what_is_held_is_there_after_close_and_whatever_is_collected_first() {
    assert_whole("everything_after_close_and_in_any_order");
}

/// An array kept its client connected, and so its name taken.
#[test]
fn a_client_that_is_collected_is_disconnected_though_an_array_is_held() {
    assert_whole("a_client_that_nobody_keeps");
}

#[test]
fn what_is_held_is_there_while_the_interpreter_ends() {
    assert_whole("everything_at_exit");
}

#[test]
fn a_signal_handler_that_calls_the_client_does_not_change_what_a_wait_returns() {
    assert_whole("a_signal_during_a_wait");
}

/// A call in the middle of another panicked inside the handler.
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
