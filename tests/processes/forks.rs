//! Programs that fork: a client belongs to the process that created it, and the end of a child disconnects
//! nothing.

use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left};
use crate::languages::{clients, compiled_test, output_within_limit};

/// Regression: the normal exit of a child ran the clean-up of its parent's client, and so ended the run.
#[test]
fn a_forked_child_that_exits_does_not_disconnect_its_parent_in_c() {
    let place = Place::new();
    let scene = std::fs::read_to_string(clients().join("scenes/free_space.toml")).unwrap();
    let run = place.start(&scene);
    let mut controller = Command::new(compiled_test("forked", &place));
    controller.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_within_limit(&mut controller), "ended\n");
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
    assert!(read(&ended.folder).marker.unwrap().lost.is_empty());
    assert_replays(&ended.folder);
}
