//! Controllers that arrive late, are killed, and return.

use std::process::{Child, Command as Program, Stdio};
use std::time::Duration;
use test_support::limited::{Limited, end_within};

use ipc_types::messages::{
    CONTROL_PAUSE, CONTROL_RESUME, CONTROL_STEP, EVENT_SAFE_COMMAND, SOURCE_FRESH, SOURCE_SAFE,
    TENDON_SERVO_JF,
};
use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use rustix::process::Signal;
use trabecula_client::{Client, ClientError};

use crate::common::logs::{assert_replays, read};
use crate::common::program::{LIMIT, Place, Run, signal, wait_for};
use crate::common::scenes;
use crate::languages::built;
use crate::strays::{answer, await_event, joined, stopped};

/// Starts a user's own program as the `pilot`.
fn pilot(run: &Run) -> Child {
    let mut program = Program::new(built().join("examples/01_hold_tension"));
    program.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "pilot").stdout(Stdio::null());
    program.spawn().unwrap()
}

fn kill(mut program: Child) {
    program.kill().unwrap();
    end_within(&mut program, LIMIT, "the pilot");
}

/// Waits until the pilot's command is fresh for the newest state.
fn await_fresh(observer: &mut Client) -> u64 {
    loop {
        let state = observer.wait_state(LIMIT).unwrap();
        if state.applied[0].source == SOURCE_FRESH {
            return state.tick;
        }
    }
}

/// Regression: only an optional controller that had never commanded could stay away; one that left ended the
/// run.
#[test]
fn an_optional_controller_that_is_killed_ends_no_lockstep_run() {
    let place = Place::new();
    let scene = scenes::shared("lockstep", 600.0)
        .replace("external = true", "external = true\noptional = true")
        .replace("seed = 7", "seed = 7\ncontroller_limit_ms = 400.0");
    let run = place.start(&scene);
    let mut observer = joined(&run, "");
    observer.next_event().unwrap();
    observer.run_control(CONTROL_PAUSE, 0, LIMIT).unwrap();
    let pilot = pilot(&run);
    // Tick by tick until it has joined.
    wait_for("the pilot's command", || {
        observer.run_control(CONTROL_STEP, 1, LIMIT).unwrap();
        let state = observer.wait_state(LIMIT).unwrap();
        (state.applied[0].source == SOURCE_FRESH).then_some(())
    });
    kill(pilot);
    observer.run_control(CONTROL_RESUME, 0, LIMIT).unwrap();
    await_event(&mut observer, EVENT_SAFE_COMMAND, "controller `pilot`: no answer to tick");
    let alone = observer.wait_state(LIMIT).unwrap().tick;
    while observer.wait_state(LIMIT).unwrap().tick < alone + 100 {}
    let ended = stopped(run, observer, ());
    let log = read(&ended.folder);
    assert_eq!(log.ticks.last().unwrap().latched.commands[0].source, SOURCE_SAFE);
    assert_replays(&ended.folder);
}

/// An external controller that is killed and started again within its limit is waited for.
#[test]
fn a_killed_controller_returns_to_a_lockstep_run() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 60000.0");
    let run = place.start(&scene);
    let mut observer = joined(&run, "");
    let mut ticks = Vec::new();
    for _ in 0..2 {
        let pilot = pilot(&run);
        let begun = await_fresh(&mut observer);
        while observer.wait_state(LIMIT).unwrap().tick < begun + 20 {}
        kill(pilot);
        // No controller answers, so the run stands still.
        while observer.wait_state(Duration::from_millis(100)).is_ok() {}
        ticks.push(observer.state().unwrap().tick);
    }
    assert!(ticks[1] > ticks[0] + 20, "{ticks:?}");
    let ended = stopped(run, observer, ());
    assert_replays(&ended.folder);
}

/// If a controller dies holding a command in shared memory, its name and the memory become free.
#[test]
fn a_controller_that_dies_with_a_loaned_command_can_be_replaced() {
    const VICTIM: &str = "TRABECULA_TEST_DIES_WITH_A_LOAN";
    if std::env::var_os(VICTIM).is_some() {
        let mut client = Client::connect(&trabecula_client::Connection::default()).unwrap();
        client.wait_state(LIMIT).unwrap();
        client.command().unwrap().tendon_mode = TENDON_SERVO_JF;
        signal(std::process::id(), Signal::KILL);
    }
    let place = Place::new();
    let run = place.start(&scenes::shared("lockstep", 600.0));
    let name = "returning::a_controller_that_dies_with_a_loaned_command_can_be_replaced";
    let mut victim = Program::new(std::env::current_exe().unwrap());
    victim.args([name, "--exact"]).env(VICTIM, "1").stdout(Stdio::null());
    victim.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "pilot");
    let status = victim.limited_output().unwrap().status;
    assert_eq!(std::os::unix::process::ExitStatusExt::signal(&status), Some(9), "{status}");
    let mut client = joined(&run, "pilot");
    for _ in 0..20 {
        answer(&mut client, 3.0);
    }
    assert!(client.wait_state(LIMIT).unwrap().tick >= 20);
    let ended = stopped(run, client, ());
    assert_replays(&ended.folder);
}

/// Regression: a killed hub leaves its folder, and its clients considered it alive.
#[test]
fn a_killed_hub_is_noticed_though_its_folder_is_left() {
    let place = Place::new();
    let run = place.start(&scenes::shared("lockstep", 600.0));
    let folder = run.session();
    let mut client = joined(&run, "pilot");
    client.wait_state(LIMIT).unwrap();
    let physics = run.part("physics");
    // It must not announce the end of the run.
    signal(physics, Signal::STOP);
    signal(run.pid(), Signal::KILL);
    // From here on the hub of another test may remove its folder.
    let outcome = client.wait_state(LIMIT).map(|state| state.tick);
    signal(physics, Signal::KILL);
    assert!(matches!(outcome, Err(ClientError::HubGone { .. })), "{outcome:?}");
    let limit = Duration::from_millis(50);
    let session = Some(folder.to_str().unwrap().to_owned());
    let again = Client::connect(&trabecula_client::Connection { session, controller: None, limit });
    assert!(matches!(again, Err(ClientError::NoSession { .. })), "{again:?}");
    drop(client);
    run.end();
    ipc_types::session::wipe_dead_sessions();
}
