//! Complete, successful runs.

use std::path::{Path, PathBuf};
use test_support::limited::Limited;

use crate::common::logs::{assert_replays, counts, read};
use crate::common::program::{BusyLoops, Place, Run, assert_nothing_left, succeed, trabecula};
use crate::common::scenes;

fn configs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs")
}

#[test]
fn every_scene_in_configs_passes_the_scene_check() {
    let scenes: Vec<PathBuf> =
        std::fs::read_dir(configs()).unwrap().flatten().map(|entry| entry.path()).collect();
    let scenes: Vec<PathBuf> =
        scenes.into_iter().filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
    assert!(scenes.iter().any(|path| path.ends_with("femur_curved_drilling.toml")), "{scenes:?}");
    for scene in scenes {
        let done = trabecula(&[&"scene", &"check", &scene]);
        // A scene on the user's own CT is valid except for the file, which only the user has.
        let only_the_volume_is_missing = done.code == Some(2) && done.err.contains("`volume.path` is");
        let valid = done.code == Some(0) && done.out.contains("is valid");
        assert!(valid || only_the_volume_is_missing, "{}: {}{}", scene.display(), done.out, done.err);
    }
}

#[test]
fn the_default_scene_in_lockstep_records_and_replays_identically() {
    let place = Place::new();
    let scene = configs().join("femur_curved_drilling.toml");
    let run = Run::start(&scene, place.path("out"), &["--mode", "lockstep", "--duration-s", "2"]);
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    let said = assert_replays(&ended.folder);
    assert!(said.contains("replayed 2000 ticks") && said.contains("end marker: completed"), "{said}");
    for file in [
        "run.mcap",
        "timing.mcap",
        "summary.json",
        "drr_before.png",
        "drr_half.png",
        "drr_after.png",
        "tip_path.png",
    ] {
        assert!(ended.folder.join(file).metadata().unwrap().len() > 0, "{file}");
    }
    let log = read(&ended.folder);
    let last = &log.ticks.last().unwrap().state;
    assert!(last.removed_total > 0, "the burr has drilled");
    assert!(last.t_world_tip.position_m != log.initial.t_world_tip.position_m);
}

#[test]
fn two_lockstep_runs_of_a_scene_are_identical() {
    let (first, second) = (Place::new(), Place::new());
    let runs = [&first, &second].map(|place| place.complete(&scenes::drill("lockstep", 1.0)));
    let hashes = runs.each_ref().map(|run| read(&run.folder).marker.unwrap().hash.unwrap());
    assert_eq!(hashes[0], hashes[1]);
    let diff = trabecula(&[&"log", &"diff", &runs[0].folder, &runs[1].folder]);
    assert_eq!(diff.code, Some(0), "{}{}", diff.out, diff.err);
    assert!(diff.out.contains("identical"), "{}", diff.out);
    // The files themselves, too: the deterministic lane contains no wall-clock information.
    let bytes = runs.each_ref().map(|run| std::fs::read(run.folder.join("run.mcap")).unwrap());
    assert!(bytes[0] == bytes[1], "run.mcap differs though its content does not");
}

#[test]
fn a_run_of_another_scene_differs_and_the_diff_says_where() {
    let (first, second) = (Place::new(), Place::new());
    let one = first.complete(&scenes::hold("lockstep", 0.1));
    let other = second.complete(&scenes::hold("lockstep", 0.1).replace("tension_n = 2.0", "tension_n = 2.5"));
    let diff = trabecula(&[&"log", &"diff", &one.folder, &other.folder]);
    assert_eq!(diff.code, Some(1));
    assert!(diff.out.contains("tendon_force_n[0]") && diff.out.contains("tick 0"), "{}", diff.out);
}

#[test]
fn a_realtime_run_beside_two_busy_loops_replays_identically() {
    let place = Place::new();
    let busy = BusyLoops::start(2);
    let ended = place.complete(&scenes::drill("realtime", 2.5));
    drop(busy);
    assert_nothing_left(ended.pid);
    let said = assert_replays(&ended.folder);
    assert!(said.contains("replayed 2500 ticks"), "{said}");
}

/// Regression: the recorder read states as long as there were any; in lockstep there always were, and its
/// other queues overflowed: commands and timings were lost, and once a frame.
#[test]
fn a_lockstep_log_misses_no_message_of_any_queue() {
    let place = Place::new();
    let busy = BusyLoops::start(2);
    let folder = place.complete(&scenes::drill("lockstep", 3.0)).folder;
    drop(busy);
    let [run, timing] = ["run.mcap", "timing.mcap"].map(|name| counts(&folder.join(name)));
    assert_eq!((run["/latched"], run["/state"], run["/drr/frame"], run["/drr/reply"]), (3000, 3001, 31, 31));
    assert_eq!((timing["/timing/tick"], timing["/timing/frame"]), (3000, 31));
    // A last answer may arrive when the run is over.
    assert!((3000..=3001).contains(&timing["/command/reference"]), "{timing:?}");
}

#[test]
fn two_hubs_at_once_do_not_meet() {
    let (first, second, alone) = (Place::new(), Place::new(), Place::new());
    let runs = [&first, &second].map(|place| place.start(&scenes::drill("lockstep", 1.5)));
    let sessions = runs.each_ref().map(Run::session);
    assert_ne!(sessions[0], sessions[1]);
    let hashes = runs.map(|run| {
        let ended = run.end_well();
        assert_nothing_left(ended.pid);
        assert_replays(&ended.folder);
        read(&ended.folder).marker.unwrap()
    });
    let undisturbed = read(&alone.complete(&scenes::drill("lockstep", 1.5)).folder).marker.unwrap();
    assert_eq!(hashes, [undisturbed.clone(), undisturbed]);
}

/// Regression: the scene in the log named the volume relative to the scene file, and replay searched for it
/// next to the log.
#[test]
fn a_scene_with_its_volume_beside_it_replays_from_anywhere() {
    let place = Place::new();
    succeed(&[&"phantom", &"block", &"-o", &place.path("block.nrrd"), &"--spacing-mm", &"1"]);
    let scene = scenes::drill_in_file("lockstep", 0.3, "block.nrrd");
    place.scene(&scene);
    // As a user does: from the folder, with a relative path.
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let command = command.args(["run", "scene.toml", "--quiet"]).current_dir(place.path(""));
    let output = command.limited_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let runs: Vec<PathBuf> =
        std::fs::read_dir(place.path("out")).unwrap().flatten().map(|e| e.path()).collect();
    assert_replays(&runs[0]);
}
