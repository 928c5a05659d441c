//! Commands without a scene, in an empty folder: the default scene is embedded in the program.

use std::fs;
use std::path::Path;
use std::process::Command;

use test_support::limited::Limited;

use crate::common::program::{Done, Place};

/// Runs the program in a folder.
fn trabecula_in(folder: &Path, words: &[&str]) -> Done {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let output = command.current_dir(folder).args(words).limited_output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Done { code: output.status.code(), out: text(&output.stdout), err: text(&output.stderr) }
}

fn succeed_in(folder: &Path, words: &[&str]) -> Done {
    let done = trabecula_in(folder, words);
    assert_eq!(done.code, Some(0), "{words:?}: {}{}", done.out, done.err);
    done
}

/// Returns the only run below `out`, and the hash of its last state.
fn only_run(folder: &Path) -> (String, String) {
    let mut runs = fs::read_dir(folder.join("out")).unwrap();
    let run = runs.next().unwrap().unwrap().path();
    assert!(runs.next().is_none(), "one run");
    let summary: serde_json::Value =
        serde_json::from_slice(&fs::read(run.join("summary.json")).unwrap()).unwrap();
    let hash = summary["final_hash"].as_str().unwrap().to_owned();
    (run.to_str().unwrap().to_owned(), hash)
}

/// Returns the scene in the header of a run's log.
fn scene_in(run: &str) -> String {
    let log = Path::new(run).join("run.mcap");
    run_log::LogReader::open(&recorder_proc::log_file::LogFile::at(&log)).unwrap().header().scene_toml.clone()
}

/// Regression: `run` looked for `configs/femur_curved_drilling.toml` in the current folder, and ended with
/// exit code 2. `scene init` writes the same scene: the same text in the log, and the same hash of the last
/// state from another folder.
#[test]
fn the_default_scene_runs_and_replays_in_any_folder_and_is_the_one_that_init_writes() {
    let (empty, other) = (Place::new(), Place::new());
    let few = ["--mode", "lockstep", "--duration-s", "0.02", "--quiet"];
    succeed_in(&empty.path(""), &[&["run"][..], &few].concat());
    assert_eq!(empty.entries(), ["out"]);
    let (run, hash) = only_run(&empty.path(""));
    // From a folder other than that of the run.
    let done = succeed_in(&other.path(""), &["replay", &run, "--verify"]);
    assert!(done.out.contains("replayed 20 ticks, all identical"), "{}", done.out);

    succeed_in(&other.path(""), &["scene", "init"]);
    assert_eq!(other.entries(), ["femur_curved_drilling.toml"]);
    succeed_in(&other.path(""), &[&["run", "femur_curved_drilling.toml"][..], &few].concat());
    let (copy, hash_of_copy) = only_run(&other.path(""));
    assert_eq!((hash_of_copy, scene_in(&copy)), (hash, scene_in(&run)));
}

/// Regression: each of them looked for its scene below `configs/`.
#[test]
fn commands_without_a_scene_work_in_an_empty_folder() {
    let place = Place::new();
    let folder = place.path("");
    for words in [
        &["stress", "--seconds", "0.1", "--cores", "1", "--load", "none", "--output", "stress"][..],
        &["calibrate", "--output", "calibration"],
    ] {
        succeed_in(&folder, words);
    }
    assert!(place.path("calibration/calibration.csv").is_file());
}
