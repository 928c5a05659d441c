//! The gallery `configs/examples`: one scene per feature.

use std::fs;
use std::path::Path;

use sim::{Drive, SharedScene, Sim};

use crate::common::logs::assert_replays;
use crate::common::program::{Place, Run, trabecula};

/// Each scene, and the line that shows its feature.
const GALLERY: [(&str, &str); 27] = [
    ("arm_compliance.toml", "[arm.compliance]"),
    ("arm_gantry.toml", "model = \"gantry\""),
    ("arm_joints.toml", "[[arm.joint]]"),
    ("arm_model.toml", "model = \"ur10e\""),
    ("arm_seven_joints.toml", "name = \"A7\""),
    ("arm_urdf.toml", "urdf = \"../arms/puma560/puma560.urdf\""),
    ("contact_voxels.toml", "voxels = \"balls\""),
    ("drilling_removal.toml", "removal = \"capped\""),
    ("drr_carm.toml", "[drr.carm]"),
    ("drr_detector.toml", "[drr.detector]"),
    ("drr_notch.toml", "[drr.notch]"),
    ("drr_objects.toml", "[[drr.object]]"),
    ("drr_projector.toml", "projector = \"siddon\""),
    ("drr_spectrum.toml", "[drr.spectrum]"),
    ("manipulator_model.toml", "model = \"spatial\""),
    ("sensors.toml", "fbg = {}"),
    ("structures.toml", "[[structure]]"),
    ("tendon_helix.toml", "twist_deg_per_mm = 3.8"),
    ("tendons.toml", "[[tendon]]"),
    ("tolerance.toml", "[tolerance]"),
    ("tool_drill_bit.toml", "shape = \"bit\""),
    ("tool_drive_shaft.toml", "[manipulator.tool.drive_shaft]"),
    ("tool_pre_curved.toml", "start_shape = \"straight\""),
    ("tool_rigid.toml", "file = \"../tools/rigid_drill.toml\""),
    ("tool_tube_in_tube.toml", "[controller.tube_deployment]"),
    ("tool_two_segments.toml", "file = \"../tools/two_segments.toml\""),
    ("truth.toml", "[truth.manipulator]"),
];

#[test]
fn every_example_is_clean_and_drills() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples");
    let mut there: Vec<String> = fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    there.sort();
    assert_eq!(there, GALLERY.map(|(name, _)| name), "a scene without a row, or a row without a scene");
    for (name, line) in GALLERY {
        let file = folder.join(name);
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.lines().any(|found| found == line), "{name} does not say `{line}`");
        let shared = SharedScene::load(Some(&file), &[], None).unwrap();
        let warned: Vec<_> = shared.notes().iter().filter(|note| note.contains("warning")).collect();
        assert!(warned.is_empty(), "{name}: {warned:?}");
        let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
        let place = Place::new();
        sim.record(&place.path("run")).unwrap();
        while sim.state().removed_total == 0 {
            assert!(sim.state().tick < 1000, "{name}: nothing was drilled");
            sim.step(&[], 100).unwrap();
        }
        sim.close_recording().unwrap();
        assert_replays(&place.path("run"));
    }
}

/// Examples of features that belong to other parts: the X-ray's, and the sensors'.
#[test]
fn examples_of_x_ray_and_sensors_run_and_replay_with_their_frames() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples");
    let names = GALLERY.map(|(name, _)| name);
    let mut own = names.iter().filter(|name| name.starts_with("drr_") || **name == "sensors.toml").peekable();
    assert!(own.peek().is_some());
    for name in own {
        let place = Place::new();
        let ended = Run::start(&folder.join(name), place.path("out"), &["--set", "run.duration_s=0.3"]).end();
        assert_eq!(ended.code, Some(0), "{name}: {}", ended.err);
        let done = trabecula(&[&"replay", &ended.folder, &"--verify", &"--frames"]);
        let has_frames = name.starts_with("drr_");
        assert_eq!(done.code, Some(if has_frames { 0 } else { 2 }), "{name}: {}{}", done.out, done.err);
        assert_replays(&ended.folder);
    }
}
