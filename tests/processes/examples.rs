//! The gallery `configs/examples`: one scene a feature, each run for a second.

use std::fs;
use std::path::Path;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, Run, assert_nothing_left, trabecula};

/// Each scene, and the line by which it shows its feature.
const GALLERY: [(&str, &str); 25] = [
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
    ("drr_projector.toml", "projector = \"siddon\""),
    ("drr_spectrum.toml", "[drr.spectrum]"),
    ("manipulator_model.toml", "model = \"spatial\""),
    ("sensors.toml", "fbg = {}"),
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
fn every_example_is_clean_drills_for_a_second_and_replays() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples");
    let mut there: Vec<String> = fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    there.sort();
    assert_eq!(there, GALLERY.map(|(name, _)| name), "a scene without a row, or a row without a scene");
    for (name, line) in GALLERY {
        let text = fs::read_to_string(folder.join(name)).unwrap();
        assert!(text.lines().any(|found| found == line), "{name} does not say `{line}`");
        let place = Place::new();
        let checked = trabecula(&[&"scene", &"check", &folder.join(name)]);
        assert_eq!(checked.code, Some(0), "{name}: {}", checked.err);
        assert!(!checked.err.contains("warning"), "{name}: {}", checked.err);
        let ended = Run::start(&folder.join(name), place.path("out"), &["--set", "run.duration_s=1.0"]).end();
        assert_eq!(ended.code, Some(0), "{name}: {}", ended.err);
        // The scenes are longer: a second is short of what their controllers need.
        let warnings = || ended.err.lines().filter(|line| line.contains("warning"));
        assert!(warnings().all(|line| line.contains("`run.duration_s` is 1;")), "{name}: {}", ended.err);
        let removed = read(&ended.folder).ticks.last().unwrap().state.removed_total;
        assert!(removed > 0, "{name}: nothing was drilled");
        assert_replays(&ended.folder);
        assert_nothing_left(ended.pid);
    }
}
