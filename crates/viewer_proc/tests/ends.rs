//! Ends of sessions that the viewer did not see: a short run may be over before the viewer receives anything,
//! and another program may clean up after a killed host. Only the log then has the reason.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;

use ipc_types::messages::{Part, State, Tick, TickTiming};
use ipc_types::process::EndRequest;
use ipc_types::scene::{Policy, Scene, Wait};
use ipc_types::session::{SessionHost, SessionPlan};
use recorder_proc::log_file::{create_run, create_timing};
use recorder_proc::process::OUTPUT_FILE;
use run_log::{BuildInfo, EndReason, LogHeader, RunMode, Topic};
use viewer_proc::server::ListeningPort;
use viewer_proc::{ArmMeshes, ServerOptions, ToolShape, live};
use zerocopy::IntoBytes;

const SCENE: &str = r#"
name = "short"
[run]
mode = "lockstep"
duration_s = 0.01
[tool]
burr_start_mm = [0.0, 0.0, -14.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
"#;
const LIMIT: Duration = Duration::from_secs(60);

fn plan() -> SessionPlan {
    SessionPlan {
        controllers: Vec::new(),
        volume_bytes: 0,
        frame_bytes: 0,
        sensors: false,
        tip_jacobian: false,
        recorder: true,
        wait: Wait::Hybrid,
        policy: Policy::Other,
    }
}

fn shapes(scene: &Scene) -> (ToolShape, ArmMeshes) {
    let radii = scene.manipulator.radii();
    let tool = ToolShape {
        joint_positions_m: Vec::new(),
        tip_offset_m: 0.0,
        outer_radius_m: radii.tube_outer_m,
        outer_tube: None,
        cutter: radii.cutter,
        holder: scene.arm.holder(),
        arm_parts: None,
    };
    (tool, ArmMeshes::default())
}

/// Writes the log of a run that ended for this reason.
fn log(folder: &Path, reason: &EndReason) {
    let header = LogHeader {
        scene_toml: SCENE.to_owned(),
        calibration_json: None,
        scene_name: "short".to_owned(),
        volume_sha256: None,
        volume_dimensions: [0; 3],
        dt_ns: 1_000_000,
        mode: RunMode::Lockstep,
        controllers: Vec::new(),
        build: BuildInfo { version: "0.1.0".to_owned(), target: "test".to_owned(), rustc: None },
        first_tick: Tick::START,
    };
    let mut run = create_run(&folder.join("run.mcap"), &header).unwrap();
    run.state(&State::zeroed()).unwrap();
    run.finish(reason.clone(), &BTreeMap::new()).unwrap();
    let mut timing = create_timing(&folder.join("timing.mcap"), &header).unwrap();
    timing.message(Topic::TickTiming, Tick(0), TickTiming::zeroed().as_bytes()).unwrap();
    timing.finish(reason.clone(), &BTreeMap::new()).unwrap();
}

/// Returns what the viewer shows after a session was removed without reporting how its run ended.
fn after_silence(recorded: Option<&Path>) -> Option<PathBuf> {
    let host = SessionHost::create(&plan()).unwrap();
    let session = host.session.folder().to_owned();
    fs::write(session.join("scene.toml"), SCENE).unwrap();
    if let Some(folder) = recorded {
        fs::write(session.join(OUTPUT_FILE), folder.as_os_str().as_encoded_bytes()).unwrap();
    }
    host.announce().unwrap();
    let options = ServerOptions {
        bind: "127.0.0.1".parse().unwrap(),
        port: 0,
        allow_origin: Vec::new(),
        allow_host: Vec::new(),
        watch_by_anyone: false,
        page_folder: None,
    };
    let door = ListeningPort::open(&options).unwrap();
    let (ready, is_ready) = mpsc::channel();
    let (shown, is_shown) = mpsc::channel();
    std::thread::spawn(move || {
        let tell = || ready.send(()).unwrap();
        let _ = shown.send(live::view(&session, &door, shapes, tell, &EndRequest::default()));
    });
    if is_ready.recv_timeout(LIMIT).is_err() {
        panic!("nothing is shown: {:?}", is_shown.recv_timeout(LIMIT));
    }
    drop(host);
    is_shown.recv_timeout(LIMIT).unwrap().unwrap()
}

#[test]
fn a_run_that_was_over_before_the_viewer_listened_becomes_its_log() {
    let folder = tempfile::tempdir().unwrap();
    log(folder.path(), &EndReason::Completed);
    assert_eq!(after_silence(Some(folder.path())).as_deref(), Some(folder.path()));
}

#[test]
fn a_killed_host_whose_session_was_cleared_away_is_no_regular_end() {
    let folder = tempfile::tempdir().unwrap();
    log(folder.path(), &EndReason::PartDied(Part::Host.name().to_owned()));
    assert_eq!(after_silence(Some(folder.path())), None);
    assert_eq!(after_silence(None), None, "nothing was recorded");
}
