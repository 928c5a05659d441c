//! Clients that flood, stop reading, die or arrive late, through the client library: the run continues.

use std::process::Command;
use std::time::Duration;

use ipc_types::messages::services;
use ipc_types::messages::{
    CONTROL_STOP, DRR_REFUSED, DrrReply, DrrRequest, EVENT_REQUEST_REFUSED, Pose, SOURCE_FRESH,
    TENDON_SERVO_JF,
};
use ipc_types::session::{SESSION_VARIABLE, Session};
use run_log::EndReason;
use trabecula_client::{Client, ClientError, Connection};

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Ended, LIMIT, Place, Run, assert_nothing_left, wait_for};
use crate::common::scenes;
use crate::languages::{clients, output_of};
use crate::python::python;

/// Joins a run under a name.
pub fn joined(run: &Run, controller: &str) -> Client {
    let session = run.session().to_str().unwrap().to_owned();
    Client::connect(&Connection {
        session: Some(session),
        controller: Some(controller.to_owned()),
        limit: LIMIT,
    })
    .unwrap()
}

/// Stops a run, releases it, and waits for its end.
pub fn stopped<T>(run: Run, mut client: Client, others: T) -> Ended {
    client.run_control(CONTROL_STOP, 0, LIMIT).unwrap();
    drop((client, others));
    run.end_well()
}

/// Answers the newest state with a tension.
pub fn answer(client: &mut Client, tension_n: f64) {
    let step = |_: &_, command: &mut trabecula_client::Command| {
        command.tendon_mode = TENDON_SERVO_JF;
        command.tendon_force_n[0] = tension_n;
    };
    client.answer(LIMIT, step).unwrap();
}

/// Reads events until one contains this text.
pub fn await_event(client: &mut Client, code: u32, words: &str) {
    let end = std::time::Instant::now() + LIMIT;
    loop {
        match client.next_event().unwrap() {
            Some((event, text)) if event.code == code && text.contains(words) => return,
            Some(_) => {}
            None => std::thread::sleep(Duration::from_millis(2)),
        }
        assert!(std::time::Instant::now() < end, "no event with `{words}`");
    }
}

/// An optional controller joins a lockstep run that began without it.
#[test]
fn an_optional_controller_may_join_late() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("external = true", "external = true\noptional = true");
    let run = place.start(&scene);
    let mut observer = joined(&run, "");
    while observer.wait_state(LIMIT).unwrap().tick < 100 {}
    let mut client = joined(&run, "pilot");
    let first = client.wait_state(LIMIT).unwrap().tick;
    assert!(first >= 100);
    // It answers; from then on every tick waits for it.
    for _ in 0..20 {
        answer(&mut client, 2.0);
    }
    let before = client.wait_state(LIMIT).unwrap().tick;
    for tick in before..before + 20 {
        assert_eq!(client.state().unwrap().tick, tick);
        answer_here(&mut client);
        client.wait_state(LIMIT).unwrap();
    }
    let ended = stopped(run, observer, client);
    let log = read(&ended.folder);
    assert!(log.ticks.iter().any(|tick| tick.latched.commands[0].source == SOURCE_FRESH));
    assert_eq!(log.ticks[50].latched.commands[0].source, 0, "it was not there at the start");
    assert_replays(&ended.folder);
}

/// Answers the state received last.
pub fn answer_here(client: &mut Client) {
    let command = client.command().unwrap();
    command.tendon_mode = TENDON_SERVO_JF;
    command.tendon_force_n[0] = 2.0;
    client.send().unwrap();
}

/// An external controller that never joins ends the run with a message that explains how to connect it.
#[test]
fn a_run_that_waits_in_vain_says_for_whom_and_how_to_connect() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 1.0).replace("external = true", "external = true\nconnect_limit_s = 3.0");
    let ended = place.start(&scene).end();
    assert_eq!(ended.code, Some(1));
    let words = [
        "controller `pilot` did not connect within 3 s",
        "TRABECULA_SESSION=/",
        "TRABECULA_CONTROLLER=pilot",
    ];
    assert!(words.iter().all(|word| ended.err.contains(word)), "{}", ended.err);
    assert!(
        ended.err.contains("waiting for controller `pilot`: no first command yet (limit 3 s)"),
        "{}",
        ended.err
    );
    assert!(!ended.err.contains("died"), "the physics was blamed: {}", ended.err);
    // Regression: a table of zeros was printed.
    assert!(ended.out.contains("outcome      controller_missing: controller `pilot`"), "{}", ended.out);
    assert!(!ended.out.contains("ticks") && !ended.out.contains("replay"), "{}", ended.out);
    let marker = read(&ended.folder).marker.unwrap();
    assert_eq!(marker.reason, EndReason::ControllerMissing("pilot".to_owned()));
    assert_nothing_left(ended.pid);
}

/// Regression: a client saw only that the hub was gone.
#[test]
fn a_client_hears_why_the_run_has_ended() {
    let place = Place::new();
    let scene =
        scenes::shared("lockstep", 600.0).replace("seed = 7", "seed = 7\ncontroller_limit_ms = 300.0");
    let run = place.start(&scene);
    let mut client = joined(&run, "pilot");
    client.wait_state(LIMIT).unwrap();
    answer_here(&mut client);
    // It no longer answers.
    let outcome = loop {
        match client.wait_state(LIMIT) {
            Ok(_) => {}
            Err(outcome) => break outcome,
        }
    };
    assert!(matches!(outcome, ClientError::Ended), "{outcome}");
    let (reason, name) = (client.end_reason(), client.session_name());
    let expected = format!("session {name}: the run has ended: controller `pilot` did not answer tick");
    assert!(reason.starts_with(&expected), "{reason}");
    drop(client);
    assert_eq!(run.end().code, Some(1));
}

/// Only the controller that drives the C-arm in the scene may request frames from other poses.
#[test]
fn a_client_that_does_not_drive_the_c_arm_may_not_move_it() {
    let place = Place::new();
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    let other = "\n[[controller]]\nname = \"other\"\ndrives = []\nexternal = true\noptional = true\n";
    let run = place.start(&format!("{text}{other}"));
    let mut mine = joined(&run, "mine");
    let mut other = joined(&run, "other");
    mine.next_event().unwrap();
    let tick = mine.wait_state(LIMIT).unwrap().tick;
    let half = core::f64::consts::FRAC_1_SQRT_2;
    let pose = Pose { position_m: [0.0, 0.0, -0.045], orientation_xyzw: [-half, 0.0, 0.0, half] };
    let stray = other.request_frame(Some(&pose), tick).unwrap();
    let refusal = other.wait_frame(stray, LIMIT).unwrap_err();
    assert!(matches!(refusal, ClientError::FrameRefused { .. }), "{refusal}");
    await_event(&mut mine, EVENT_REQUEST_REFUSED, "assigns the C-arm to another controller");
    // Any client may request the current pose; the pose that the scene has anyway gives the same picture.
    let request = other.request_frame(None, tick).unwrap();
    let standing = other.wait_frame(request, LIMIT).unwrap();
    let request = mine.request_frame(Some(&pose), tick).unwrap();
    let moved = mine.wait_frame(request, LIMIT).unwrap();
    let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(near(standing.frame.geometry.source_m, moved.frame.geometry.source_m));
    assert!(near(standing.frame.geometry.row_axis, moved.frame.geometry.row_axis));
    assert!(near(standing.frame.geometry.column_axis, moved.frame.geometry.column_axis));
    assert_eq!(standing.pixels.len(), 128 * 128);
    answer_here(&mut mine);
    let ended = stopped(run, mine, other);
    assert_replays(&ended.folder);
}

/// The transport identifies the requester, not the request: an observer that claims to be the C-arm's driver,
/// and another controller that does, are rejected.
#[test]
fn a_request_that_names_another_controller_is_refused() {
    let place = Place::new();
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    let other = "\n[[controller]]\nname = \"other\"\ndrives = []\nexternal = true\noptional = true\n";
    let run = place.start(&format!("{text}{other}"));
    let mut mine = joined(&run, "mine");
    mine.next_event().unwrap();
    let tick = mine.wait_state(LIMIT).unwrap().tick;
    for liar in ["", "other"] {
        let session = Session::join(&run.session()).unwrap();
        let _port = (!liar.is_empty()).then(|| session.command_publisher(liar).unwrap());
        let replies = session.subscriber::<DrrReply>(&services::DRR_REPLY).unwrap();
        let requests = session.publisher::<DrrRequest>(&services::DRR_REQUEST).unwrap();
        // Index 0 is `mine`, which drives the C-arm.
        let request = DrrRequest { request_id: 5, tick, requester: 0, ..DrrRequest::zeroed() };
        requests.send(&request).unwrap();
        let reply = wait_for("the refusal", || {
            let reply = replies.receive().unwrap().map(|reply| *reply.message());
            reply.filter(|reply| reply.request_id == 5)
        });
        assert_eq!(reply.status, DRR_REFUSED, "`{liar}`");
        await_event(
            &mut mine,
            EVENT_REQUEST_REFUSED,
            "`requester` is controller 0, but another program sent the request",
        );
    }
    let request = mine.request_frame(None, tick).unwrap();
    mine.wait_frame(request, LIMIT).unwrap();
    answer_here(&mut mine);
    let ended = stopped(run, mine, ());
    assert_replays(&ended.folder);
}

/// The CT volume exists once in shared memory; Rust and Python see the same voxels there.
#[test]
fn the_volume_is_seen_in_place_by_rust_and_python() {
    let place = Place::new();
    let run = Run::start(&clients().join("scenes/image_guided.toml"), place.path("out"), &[]);
    let mut observer = joined(&run, "");
    let seen = observer.volume(LIMIT).unwrap();
    let [columns, rows, slices] = seen.volume.dimensions;
    assert_eq!((columns, rows, slices, seen.hu.len()), (40, 40, 60, 96_000), "the block of 40 x 40 x 60 mm");
    let sum: i64 = seen.hu.iter().enumerate().map(|(i, hu)| (i as i64 % 7 + 1) * i64::from(*hu)).sum();
    if let Some(python) = python() {
        let script = "import numpy as np, trabecula
with trabecula.Client(controller='') as client:
    hu = client.volume().hu
    assert not hu.flags.writeable and not hu.flags.owndata
    print(hu.shape, int((hu.reshape(-1).astype(np.int64) * (np.arange(hu.size) % 7 + 1)).sum()))
";
        let mut command = Command::new(python);
        command.args(["-c", script]).env(SESSION_VARIABLE, run.session());
        assert_eq!(output_of(&mut command), format!("(60, 40, 40) {sum}\n"));
    }
    let mut mine = joined(&run, "mine");
    mine.wait_state(LIMIT).unwrap();
    answer_here(&mut mine);
    stopped(run, observer, mine);
}
