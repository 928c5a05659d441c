//! `scene check --simulate`: what is predicted is what happens, and what goes wrong is said before, in
//! the run and in the exit code.

use serde_json::Value;

use crate::common::program::{Place, only_entry, trabecula};
use crate::common::scenes;

/// The prediction of a scene, and the last line of its run in lockstep.
fn predicted_and_run(place: &Place, text: &str) -> (Value, Value) {
    let scene = place.scene(text);
    let done = trabecula(&[&"scene", &"check", &scene, &"--simulate", &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let predicted: Value = serde_json::from_str(&done.out).unwrap();
    let output = place.path("out");
    let done = trabecula(&[&"run", &scene, &"--output", &output, &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let ended = done.out.lines().last().unwrap();
    std::fs::remove_dir_all(&output).unwrap();
    (predicted, serde_json::from_str(ended).unwrap())
}

/// Feed, tension, model and feedback by shape and by image differ; the hash of the last state and every
/// figure of the plan are the same.
#[test]
fn a_run_in_lockstep_is_predicted_bit_for_bit() {
    let place = Place::new();
    let base = scenes::drill("lockstep", 0.4);
    for (change, to) in [
        ("", ""),
        ("tension_n = 6.0", "tension_n = 9.0"),
        ("feed_mm_per_s = 8.0", "feed_mm_per_s = 20.0"),
        ("feed_mm_per_s = 8.0", "feedback = \"shape\"\nfeed_mm_per_s = 8.0"),
        ("[tool]", "[manipulator]\nmodel = \"full\"\n[tool]"),
    ] {
        let (predicted, ended) = predicted_and_run(&place, &base.replace(change, to));
        let (prediction, summary) = (&predicted["prediction"], &ended["summary"]);
        assert_eq!(prediction["reach"], "whole", "{prediction}");
        assert!(prediction["final_hash"].is_string(), "{prediction}");
        for key in ["final_hash", "tool", "plan", "drilling", "ticks"] {
            assert_eq!(prediction[key], summary[key], "{key} of {to}");
        }
    }
}

/// A target to the side of what an untensioned tool reaches.
#[test]
fn a_miss_is_said_before_the_run_in_its_outcome_and_on_request_in_its_exit_code() {
    let place = Place::new();
    let text = scenes::drill("lockstep", 1.0)
        .replace("[tool]", "[tolerance]\ntarget_mm = 0.5\n[tool]")
        .replace("insertion_mm = 20.0", "insertion_mm = 20.0\ntarget_mm = [5.0, 0.0, -16.0]");
    let scene = place.scene(&text);
    let checked = trabecula(&[&"scene", &"check", &scene, &"--simulate"]);
    assert!(checked.out.contains("predicted: the burr ended "), "{}", checked.out);
    assert!(checked.out.contains("from the target, `tolerance.target_mm` is 0.5"), "{}", checked.out);
    assert_eq!(checked.code, Some(0), "a warning");
    let strict = trabecula(&[&"scene", &"check", &scene, &"--simulate", &"--strict"]);
    assert_eq!(strict.code, Some(2));
    assert!(strict.err.contains("treated as errors (--strict)"), "{}", strict.err);
    let output = place.path("out");
    let ran = trabecula(&[&"run", &scene, &"--output", &output, &"--quiet", &"--fail-on", &"caution"]);
    assert_eq!(ran.code, Some(4), "{}", ran.err);
    let summary = std::fs::read_to_string(only_entry(&output).join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["outcome"], "completed, out of tolerance");
    let cautions = summary["cautions"].as_array().unwrap();
    assert!(cautions[0].as_str().unwrap().starts_with("the burr ended "), "{cautions:?}");
}

/// A scene that an external controller drives: the prediction says that it was left out, and ends.
#[test]
fn a_controller_of_the_user_is_left_out_and_that_is_said() {
    let place = Place::new();
    let scene = place.scene(&scenes::piloted("lockstep", 0.2, ""));
    let done = trabecula(&[&"scene", &"check", &scene, &"--simulate", &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let said: Value = serde_json::from_str(&done.out).unwrap();
    assert!(
        said["prediction"]["notes"][0].as_str().unwrap().contains("was left out of the prediction"),
        "{said}"
    );
}
