//! Runs beside critical structures: their events, what holds the arm back, what is removed, the prediction of
//! all of it, and its replay.

use serde_json::{Value, json};

use crate::common::logs::assert_replays;
use crate::common::program::{Place, only_entry, succeed};
use crate::common::scenes;

/// A vessel across the path, a target on it, and a nerve from a label map beside it.
fn structures(on_vessel: &str, label_map: &str) -> String {
    format!(
        "[[structure]]\nname = \"vessel\"\nmargin_mm = 2.0\n{on_vessel}\n\
         tube = {{ points_mm = [[-10.0, 0.0, -17.0], [10.0, 0.0, -17.0]], radius_mm = 1.5 }}\n\
         [[structure]]\nname = \"tumour\"\nrole = \"target\"\n\
         ball = {{ centre_mm = [0.0, 0.0, -25.0], radius_mm = 2.5 }}\n\
         [[structure]]\nname = \"nerve\"\nlabel = {{ file = {label_map:?}, label = 2 }}\n"
    )
}

#[test]
fn what_happens_at_a_structure_is_predicted_recorded_and_replayed() {
    let place = Place::new();
    let header = "NRRD0004\ntype: unsigned char\ndimension: 3\nspace: left-posterior-superior\nsizes: 2 2 1\n\
                  space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,12,-25)\nencoding: raw\n\n";
    let map = place.path("map.nrrd");
    std::fs::write(&map, [header.as_bytes(), &[1, 2, 2, 2]].concat()).unwrap();
    let map = map.to_str().unwrap();
    for (on_vessel, events, least_mm) in [
        ("", ["structure_margin", "structure_breach"], -9.0..0.0),
        ("on_margin = \"stop\"", ["structure_margin", "protective_stop"], 1.5..2.0),
        ("on_margin = \"fixture\"", ["command_refused", "command_refused"], 1.5..2.3),
    ] {
        let text =
            scenes::drill_unseen("lockstep", 2.0) + &structures(on_vessel, map) + &scenes::keyframes(0.5);
        let scene = place.scene(&text);
        let done = succeed(&[&"scene", &"check", &scene, &"--simulate", &"--json"]);
        let predicted: Value = serde_json::from_str(&done.out).unwrap();
        let output = place.path("out");
        succeed(&[&"run", &scene, &"--output", &output, &"--quiet"]);
        let folder = only_entry(&output);
        let summary = std::fs::read_to_string(folder.join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&summary).unwrap();
        for key in ["final_hash", "structures", "drilling", "plan"] {
            assert_eq!(predicted["prediction"][key], summary[key], "{on_vessel}: {key}");
        }
        for event in events {
            assert!(summary["events"][event].is_u64(), "{on_vessel}: {event} in {}", summary["events"]);
        }
        assert_eq!(summary["events"]["protective_stop"].is_u64(), on_vessel.contains("stop"), "{on_vessel}");
        let [vessel, tumour, nerve] = [0, 1, 2].map(|index| &summary["structures"][index]);
        let found_mm = vessel["least_clearance_mm"].as_f64().unwrap();
        assert!(least_mm.contains(&found_mm), "{on_vessel}: {found_mm}");
        // Voxels of 1 mm: what was removed is inside the target or outside, and its share is that of about as
        // many as the ball's volume in mm3, 65.4.
        let number = |value: &Value| value.as_f64().unwrap();
        let [share, in_target_mm3] = ["removed_share", "removed_mm3"].map(|key| number(&tumour[key]));
        let [all_mm3, healthy_mm3] =
            ["removed_volume_mm3", "healthy_removed_mm3"].map(|key| number(&summary["drilling"][key]));
        assert!(in_target_mm3 > 0.0 && healthy_mm3 > 0.0, "{on_vessel}: {tumour} {healthy_mm3}");
        assert!((in_target_mm3 + healthy_mm3 - all_mm3).abs() < 1e-6, "{on_vessel}: {all_mm3}");
        let voxels = in_target_mm3 / share;
        assert!((voxels - voxels.round()).abs() < 1e-6 && (45.0..85.0).contains(&voxels), "{voxels}");
        assert_eq!(nerve["removed_mm3"], json!(0.0));
        assert!(nerve["least_clearance_mm"].as_f64().is_some_and(|mm| (7.5..9.0).contains(&mm)), "{nerve}");
        assert_replays(&folder.join("run.mcap"));
        std::fs::remove_dir_all(&output).unwrap();
    }
}
