//! Controller programs that end before the run: restarted, dispensed with, or ending the run.

use std::time::Duration;

use ipc_types::messages::EVENT_RUN;
use ipc_types::session::CONTROLLER_VARIABLE;
use rustix::process::Signal;
use trabecula_client::{Client as Controller, ClientError, Connection};

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{LIMIT, Place, assert_nothing_left, signal, wait_for};
use crate::common::scenes;

const NAME: &str = "short_lived";

/// Not a test by itself: a controller that answers a hundred states and then dies. The launcher starts it
/// from this test's own file.
#[test]
fn short_lived_program() {
    if std::env::var(CONTROLLER_VARIABLE).as_deref() != Ok(NAME) {
        return;
    }
    let mut client = Controller::connect(&Connection { limit: LIMIT, ..Connection::default() }).unwrap();
    for _ in 0..100 {
        match client.answer(Duration::from_secs(5), |_, _| {}) {
            Ok(()) => {}
            Err(ClientError::Ended) => return,
            Err(other) => panic!("{other}"),
        }
    }
    eprintln!("the gripper is empty");
    std::process::exit(7);
}

/// The hold scene with one more controller.
fn scene(duration_s: f64, command: &str, more: &str) -> String {
    let hold = scenes::hold("realtime", duration_s);
    format!("{hold}\n[[controller]]\nname = \"{NAME}\"\ndrives = []\ncommand = {command}\n{more}\n")
}

fn short_lived() -> String {
    let program = std::env::current_exe().unwrap();
    format!("[{program:?}, \"--exact\", \"restarts::short_lived_program\", \"--nocapture\"]")
}

#[test]
fn a_controller_program_that_dies_is_started_again_and_the_run_goes_on() {
    let place = Place::new();
    let run = place.start(&scene(600.0, &short_lived(), "restarts = 1000"));
    let client = Client::join(&run.session());
    let mut said = Vec::new();
    wait_for("two new starts", || {
        said.extend(client.events().into_iter().filter(|(code, _)| *code == EVENT_RUN).map(|(_, text)| text));
        said.iter().any(|text| text.contains("restarting (2 of 1000)")).then_some(())
    });
    assert!(said.iter().any(|text| text.contains("`short_lived` ended (exit status: 7)")), "{said:?}");
    let ended = client.stop(run);
    assert_nothing_left(ended.pid);
    assert_replays(&ended.folder);
}

#[test]
fn a_controller_program_that_dies_too_often_ends_the_run_and_is_named() {
    let place = Place::new();
    let ended = place.start(&scene(60.0, &short_lived(), "restarts = 1")).end();
    assert_eq!(ended.code, Some(1), "{}", ended.err);
    let words = ["part `short_lived` died (exit status: 7)", "the gripper is empty"];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
    assert_nothing_left(ended.pid);
    assert_replays(&ended.folder);
}

#[test]
fn an_optional_controller_program_may_end_and_the_run_goes_on() {
    let place = Place::new();
    let run = place.start(&scene(600.0, "[\"sh\", \"-c\", \"sleep 0.3; exit 3\"]", "optional = true"));
    let client = Client::join(&run.session());
    let text = wait_for("the event", || {
        client.events().into_iter().map(|(_, text)| text).find(|text| text.contains(NAME))
    });
    assert!(text.contains("ended (exit status: 3); the run continues without it"), "{text}");
    let tick = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= tick + 100);
    client.stop(run);
}

/// Regression: how such a program ends after all ticks are done must not matter; one that failed at that
/// moment made the whole run fail.
#[test]
fn a_dispensable_controller_program_that_fails_after_the_last_tick_fails_no_run() {
    let place = Place::new();
    let (over, number) = (place.path("over"), place.path("number"));
    let script = format!(
        "echo $$ > {0}.new; mv {0}.new {0}; while [ ! -e {1} ]; do sleep 0.02; done; exit 7",
        number.display(),
        over.display()
    );
    let run = place.start(&scene(1.0, &format!("[\"sh\", \"-c\", {script:?}]"), "optional = true"));
    let client = Client::at(&run, 100);
    let program = wait_for("the program's start", || std::fs::read_to_string(&number).ok())
        .trim()
        .parse::<u32>()
        .unwrap();
    // The physics stays until the recorder has received everything.
    let recorder = run.part("recorder");
    signal(recorder, Signal::STOP);
    client.wait_for_state(|state| state.tick == 1000);
    std::fs::write(&over, "").unwrap();
    wait_for("the program's end", || {
        (!std::path::Path::new(&format!("/proc/{program}")).exists()).then_some(())
    });
    signal(recorder, Signal::CONT);
    drop(client);
    let ended = run.end_well();
    assert_eq!(read(&ended.folder).ticks.len(), 1000);
}
