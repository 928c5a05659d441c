//! What is refused of a scene names the scene's file, in every line.

#![allow(clippy::unwrap_used, reason = "tests fail")]

use std::collections::BTreeMap;
use std::path::Path;

use inputs::log::Overrides;
use inputs::scenes::SceneSource;
use inputs::{feasibility, plan};
use ipc_types::messages::{Keyframe, Latched, State, Tick};
use recorder_proc::build_info;
use recorder_proc::log_file::create_run;
use run_log::{EndReason, LogHeader, RunMode};
use zerocopy::IntoBytes;

const HOLD: &str = r#"
name = "hold"
[run]
mode = "lockstep"
duration_s = 0.1
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "a"
drives = ["tendon"]
hold = { tension_n = 1.0 }
"#;

/// Regression: those of a tolerance named only the scene, and what a calibration cannot do was found by the
/// started run.
#[test]
fn every_refusal_names_the_scenes_file() {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    let open_loop = std::fs::read_to_string(configs.join("curved_open_loop.toml")).unwrap();
    let sweep = configs.join("calibration/tension_sweep.csv");
    let open_loop = open_loop.replace("calibration/tension_sweep.csv", sweep.to_str().unwrap());
    let target = "target_mm = [5.0, 0.0, 8.0]";
    assert!(open_loop.contains(target) && open_loop.contains(sweep.to_str().unwrap()));
    let cases = [
        (format!("{HOLD}[tolerance]\npath_mm = 0.001\n"), "no measured settings meet this tolerance"),
        (
            format!("{HOLD}[tolerance]\ntip_mm = 1.0\n").replace("0.1\n[tool]", "0.1\ndt_ms = 0.3\n[tool]"),
            "no errors were measured",
        ),
        (open_loop.replace(target, "target_mm = [-5.0, 0.0, 8.0]"), "on the side away from"),
        (open_loop.replace(target, "target_mm = [30.0, 0.0, 2.0]"), "but the calibration ends at"),
        (open_loop.replace("tension_sweep.csv", "absent.csv"), "cannot be read"),
        (HOLD.replace("tension_n = 1.0", "tension_n = 1e6"), "`controller.hold.tension_n` is"),
        (HOLD.replace("hold =", "held ="), "unknown field"),
        (HOLD.replace("hold = { tension_n = 1.0 }", ""), "needs exactly one of"),
        (HOLD.replace("[1.0, 0.0, 0.0]", "[0.0, 0.0, 1.0]"), "bend_toward"),
    ];
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("named.toml");
    for (text, part) in cases {
        std::fs::write(&file, text).unwrap();
        let source = SceneSource::File(file.clone());
        let checked =
            plan::load_scene(&source).and_then(|(scene, _)| feasibility::check(&scene, &source, None));
        let refusal = checked.unwrap_err();
        assert!(refusal.code == 2 && refusal.message.contains(part), "{part}: {refusal}");
        let named = refusal.message.lines().all(|line| line.starts_with(file.to_str().unwrap()));
        assert!(named, "{refusal}");
    }
}

/// Regression: `plan --check` stepped the commands of a log that begins at tick 100 from the state of tick 0,
/// and reported the distance of the two runs as an error.
#[test]
fn a_log_that_begins_later_than_its_run_is_compared_with_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let header = LogHeader {
        scene_toml: HOLD.to_owned(),
        calibration_json: None,
        scene_name: "hold".to_owned(),
        volume_sha256: None,
        volume_dimensions: [0; 3],
        dt_ns: 1_000_000,
        mode: RunMode::Lockstep,
        controllers: vec!["a".to_owned()],
        build: build_info::current(),
        first_tick: Tick(100),
    };
    let mut log = create_run(&path, &header).unwrap();
    let state = |tick| State { tick, ..State::zeroed() };
    log.state(&state(100)).unwrap();
    let keyframe = Keyframe { tick: 100, sequence: 1, total_bytes: 1, data_length: 1, ..Keyframe::zeroed() };
    log.keyframe(&[keyframe.as_bytes(), &[0]].concat()).unwrap();
    for tick in 100..200 {
        log.latched(&Latched { tick, ..Latched::zeroed() }).unwrap();
        log.state(&state(tick + 1)).unwrap();
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    let refusal = plan::check::check(&path, &Overrides::default(), 10, u64::MAX).unwrap_err();
    let why = "begins at tick 100; only a log from the start of its run can be compared";
    assert!(refusal.code == 2 && refusal.message.contains(why), "{refusal}");
}
