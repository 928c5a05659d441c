//! A client without the library, written from docs/messages.md.

use std::path::Path;
use std::process::Command;

use ipc_types::messages::SOURCE_FRESH;
use ipc_types::session::{CONTROLLER_VARIABLE, ICEORYX2_VERSION, SESSION_VARIABLE};

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left};
use crate::common::scenes;
use crate::languages::{clients, output_within_limit};
use test_support::python::or_skip;

/// The page did not say how to reach the session, how to wake anybody and how the end is known.
#[test]
fn a_controller_written_from_the_page_alone_drives_a_run_to_its_end() {
    const TICKS: usize = 500;
    let package = format!("iceoryx2=={ICEORYX2_VERSION}");
    let Some(python) = or_skip(&package.replace("==", "-"), &[&package], "iceoryx2") else { return };
    let place = Place::new();
    let scene = scenes::shared("lockstep", TICKS as f64 * 1e-3);
    let mut parts = scene.split("[[controller]]");
    let [run, pilot, holder] = [(); 3].map(|()| parts.next().unwrap());
    // As the second controller, so that its index counts.
    let run = place.start(&[run, holder, pilot].join("[[controller]]"));
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/messages.md");
    let mut controller = Command::new(python);
    controller.arg(clients().join("python/tests/bare_iceoryx2.py")).arg(page);
    controller.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "pilot");
    let said = output_within_limit(&mut controller);
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert_eq!(log.ticks.len(), TICKS);
    for tick in &log.ticks {
        let latched = &tick.latched.commands[1];
        assert_eq!((latched.source, latched.age_ticks), (SOURCE_FRESH, 0), "tick {}", tick.latched.tick);
        assert_eq!(latched.command.tendon_force_n[0], 7.25);
    }
    assert!(said.starts_with("answered 50"), "{said}");
    assert_replays(&ended.folder);
}
