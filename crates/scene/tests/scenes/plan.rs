//! Tests of scenes whose points come from a plan.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::Path;

use scene::{Scene, SceneError};

const PLAN: &str = r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": [
    {"label": "entry", "position": [10, 0, 0]}, {"label": "bend", "position": [10, 0, 40]},
    {"label": "target", "position": [5, 0, 55]}]}]}"#;

const SCENE: &str = "name = \"a\"
[run]
mode = \"lockstep\"
duration_s = 1.0
[volume]
phantom = \"block\"
[tool]
plan = \"plans/hip.mrk.json\"
[drr]
rate_hz = 1.0
columns = 16
rows = 16
pixel_pitch_mm = 1.0
[[controller]]
name = \"c\"
drives = [\"arm\"]
[controller.curved_drilling]
feed_mm_per_s = 1.0
tension_n = 3.0
burr_speed_rpm = 1.0
feedback = \"shape\"
";

fn parse(text: &str) -> Result<Scene, SceneError> {
    let read = |path: &Path| {
        assert_eq!(path, Path::new("/scenes/plans/hip.mrk.json"), "relative to the scene's file");
        Ok(PLAN.to_owned())
    };
    Scene::parse_with(text, Path::new("/scenes/a.toml"), &read)
}

#[test]
fn every_point_of_a_scene_follows_from_its_plan() {
    let scene = parse(SCENE).unwrap();
    assert_eq!(scene.tool.plan, None, "what a log keeps needs no other file");
    assert_eq!((scene.tool.burr_start_mm, scene.tool.direction), ([-10.0, 0.0, 40.0], [0.0, 0.0, 1.0]));
    assert_eq!(scene.tool.bend_toward, [1.0, 0.0, 0.0]);
    let [hole] = &scene.predrill[..] else { panic!("{:?}", scene.predrill) };
    assert_eq!((hole.from_mm, hole.to_mm), ([-10.0, 0.0, -10.0], [-10.0, 0.0, 40.0]));
    assert!((hole.diameter_mm - 7.0).abs() < 1e-12, "the burr's 6.5 mm and 0.5 mm");
    assert_eq!(scene.drr.unwrap().isocentre_mm, [-7.5, 0.0, 47.5]);
    let drilling = scene.controller[0].curved_drilling.as_ref().unwrap();
    assert_eq!(drilling.target_mm, Some([-5.0, 0.0, 55.0]));
    // Radius 25 mm, angle 2 atan(1/3).
    let arc_mm = 50.0 * (1.0_f64 / 3.0).atan();
    assert!((drilling.insertion_mm - arc_mm).abs() < 1e-9 && drilling.ramp_end_mm == drilling.insertion_mm);
}

#[test]
fn a_scene_is_the_same_from_its_plan_and_from_its_log() {
    let scene = parse(SCENE).unwrap();
    let logged = toml::to_string(&scene).unwrap();
    assert_eq!(Scene::parse(&logged, Path::new("/scenes/a.toml")).unwrap(), scene);
}

#[test]
fn what_is_not_a_place_of_the_plan_may_stand_beside_it() {
    let text = SCENE
        .replace("rate_hz = 1.0", "rate_hz = 1.0\nisocentre_mm = [1.0, 2.0, 3.0]")
        .replace("tension_n", "insertion_mm = 9.0\nramp_end_mm = 8.0\ntension_n")
        + "[manipulator]\nburr_diameter_mm = 8\n[[predrill]]\nfrom_mm = [0.0, 0.0, 0.0]\nto_mm = [0.0, 0.0, \
           9.0]\ndiameter_mm = 3.0\n";
    let scene = parse(&text).unwrap();
    assert_eq!(scene.drr.unwrap().isocentre_mm, [1.0, 2.0, 3.0]);
    let drilling = scene.controller[0].curved_drilling.as_ref().unwrap();
    assert_eq!((drilling.insertion_mm, drilling.ramp_end_mm), (9.0, 8.0));
    let diameters: Vec<f64> = scene.predrill.iter().map(|hole| hole.diameter_mm).collect();
    assert_eq!(diameters, [3.0, 8.5]);
}

/// A point must not be given twice: the two would differ once one is moved.
#[test]
fn a_point_of_the_plan_that_also_stands_in_the_scene_is_refused() {
    for (key, line) in [
        ("tool.burr_start_mm", "[tool]\nburr_start_mm = [0.0, 0.0, 0.0]"),
        ("tool.direction", "[tool]\ndirection = [0.0, 0.0, 1.0]"),
        ("tool.bend_toward", "[tool]\nbend_toward = [0.0, 0.0, 1.0]"),
        ("controller.curved_drilling.target_mm", "[controller.curved_drilling]\ntarget_mm = [0.0, 0.0, 1.0]"),
    ] {
        let head = line.lines().next().unwrap();
        let said = parse(&SCENE.replace(head, line)).unwrap_err().to_string();
        assert_eq!(
            said,
            format!("/scenes/a.toml: `{key}` follows from `tool.plan`; set only one of the two")
        );
    }
}

#[test]
fn errors_name_the_plan_or_the_line_of_the_scene() {
    for (from, to, said) in [
        ("rate_hz = 1.0", "rate_hz = \"x\"", "/scenes/a.toml, line 10: `drr.rate_hz`: invalid type"),
        ("rate_hz = 1.0", "rate = 1.0", "/scenes/a.toml, line 10: `drr.rate`: unknown field"),
        ("rate_hz = 1.0", "rate_hz = 900.0", "/scenes/a.toml: `drr.rate_hz` is 900"),
        ("tension_n = 3.0", "", "needs either `tension_n` or `calibration`"),
        ("\"plans/hip.mrk.json\"", "3", "/scenes/a.toml: `tool.plan` is 3, expected a path as a string"),
        ("[tool]", "[tool", "/scenes/a.toml, line 7: "),
    ] {
        let error = parse(&SCENE.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(error.contains(said), "{error}\nis not\n{said}");
    }
    let read = |_: &Path| Ok(PLAN.replace("target", "goal"));
    let error = Scene::parse_with(SCENE, Path::new("/scenes/a.toml"), &read).unwrap_err().to_string();
    let said = "/scenes/a.toml: `tool.plan` /scenes/plans/hip.mrk.json: has a control point named `entry` \
                but none named `target`";
    assert!(error.starts_with(said), "{error}");
    let error = Scene::parse(SCENE, Path::new("/scenes/a.toml")).unwrap_err().to_string();
    assert!(error.contains("`tool.plan` /scenes/plans/hip.mrk.json: cannot be read"), "{error}");
}

#[test]
fn the_schema_lets_a_plan_stand_for_its_points() {
    let schema = scene::json_schema();
    let tool = &schema["definitions"]["Tool"];
    assert_eq!(tool["anyOf"][0]["required"], serde_json::json!(["plan"]));
    assert_eq!(
        tool["anyOf"][1]["required"],
        serde_json::json!(["burr_start_mm", "direction", "bend_toward"])
    );
    let drilling = schema["definitions"]["CurvedDrilling"]["required"].to_string();
    assert!(!drilling.contains("insertion_mm") && drilling.contains("feed_mm_per_s"), "{drilling}");
}
