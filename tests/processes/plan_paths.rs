//! `trabecula plan path`: plans that keep away from a vessel beside a path.
//!
//! Probabilities are compared with those of a larger sample; this command takes any number of runs for it:
//!
//! ```sh
//! TRABECULA_RISK_RUNS=2000 cargo test --release --test processes plan_paths -- --nocapture
//! ```

use std::fs;

use serde_json::Value;

use crate::common::program::{Place, call};

/// A curve in a block to (4, 0, -16), with a vessel on the outside of the bend: a path that starts away from
/// it keeps more clearance.
const SCENE: &str = r#"
name = "beside_a_vessel"
[run]
mode = "lockstep"
duration_s = 3.0
[volume]
phantom = "block"
spacing_mm = 1.0
[tool]
burr_start_mm = [0.0, 0.0, -32.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[structure]]
name = "vessel"
tube = { points_mm = [[-6.0, -10.0, -22.0], [-6.0, 10.0, -22.0]], radius_mm = 1.0 }
[[controller]]
name = "reference"
drives = ["tendon", "arm", "burr"]
[controller.curved_drilling]
feed_mm_per_s = 8.0
insertion_mm = 17.0
tension_n = 3.0
ramp_end_mm = 15.0
burr_speed_rpm = 8000.0
feedback = "shape"
guidance_gain_n_per_mm = 0.5
target_mm = [3.0, 0.0, -16.0]
"#;

fn json(place: &Place, words: &str) -> Value {
    let done = call(&place.words(words));
    assert_eq!(done.code, Some(0), "{}", done.err);
    serde_json::from_str(&done.out).unwrap()
}

#[test]
fn the_plans_keep_more_clearance_than_the_scene_and_do_what_is_said() {
    let place = Place::new();
    fs::write(place.path("scene.toml"), SCENE).unwrap();
    let words = "plan path @scene.toml --candidates 16 --samples 2 --json -o";
    let found = json(&place, &format!("{words} @first"));
    let own = &found["candidates"][0]["outcome"];
    let best = &found["plans"][0]["plan"];
    let clearance_mm = |outcome: &Value| outcome["clearance_mm"].as_f64().unwrap();
    assert!(clearance_mm(&best["outcome"]) > clearance_mm(own) + 0.3, "{own} {best}");
    assert!(best["offsets"]["entry_mm"][0].as_f64().unwrap() > 0.0, "away from the vessel: {best}");
    let risk = &found["plans"][0]["risk"];
    assert_eq!((&risk["breach"]["of"], &risk["miss"]["of"]), (&Value::from(2), &Value::from(2)));
    // The file is the candidate, to the bit.
    let check = json(&place, "scene check --simulate --json @first/plan-1.toml");
    let structure = &check["prediction"]["structures"][0];
    assert_eq!(structure["least_clearance_mm"], best["outcome"]["clearance_mm"]);
    assert_eq!(check["prediction"]["tool"]["target_error_mm"], best["outcome"]["target_error_mm"]);
    // A second search gives the same bytes.
    let again = json(&place, &format!("{words} @again"));
    assert_eq!(again["candidates"], found["candidates"]);
    let files = |folder: &str| {
        let entries = fs::read_dir(place.path(folder)).unwrap().map(|entry| entry.unwrap());
        let mut files: Vec<_> =
            entries.map(|entry| (entry.file_name(), fs::read(entry.path()).unwrap())).collect();
        files.sort();
        files
    };
    assert_eq!(files("first").len(), found["plans"].as_array().unwrap().len() + 1);
    assert!(files("first") == files("again"));
}

/// The probabilities of breach from 15 worlds each are within their intervals of 95 % of those from a larger
/// sample of other worlds, for 9 of 10 plans or more.
#[test]
fn probabilities_are_those_of_a_larger_sample_within_their_intervals() {
    const RUNS: &str = "TRABECULA_RISK_RUNS";
    let runs: u64 = std::env::var(RUNS).map_or(60, |text| text.parse().unwrap());
    let [plans, candidates] = if runs < 1000 { [2, 10] } else { [10, 60] };
    let place = Place::new();
    let scene =
        SCENE.replace("spacing_mm = 1.0", "spacing_mm = 2.0").replace("radius_mm = 1.0", "radius_mm = 2.0");
    fs::write(place.path("scene.toml"), scene).unwrap();
    let risks = |seed: u64, samples: u64| {
        let study = format!(
            "design = \"random\"\nseed = {seed}\nsamples = {samples}\n\
             [[parameter]]\nkey = \"truth.registration_error_mm.0\"\nmin = -2.0\nmax = 8.0\n\
             [[parameter]]\nkey = \"truth.manipulator.stiffness_scale\"\nmin = 0.7\nmax = 1.3\n"
        );
        fs::write(place.path("study.toml"), study).unwrap();
        let bounds = format!("--plans {plans} --candidates {candidates} --study @study.toml");
        let found = json(
            &place,
            &format!("plan path @scene.toml {bounds} --samples {samples} --json -o @plans-{seed}"),
        );
        found["plans"].as_array().unwrap().clone()
    };
    let (few, many) = (risks(1, 15), risks(2, runs / plans));
    let share = |plan: &Value| {
        let breach = &plan["risk"]["breach"];
        breach["count"].as_f64().unwrap() / breach["of"].as_f64().unwrap()
    };
    let mut outside = 0;
    for (few, many) in few.iter().zip(&many) {
        assert_eq!(few["plan"]["offsets"], many["plan"]["offsets"], "the same search");
        let [low, high] = [0, 1].map(|end| few["breach_interval"][end].as_f64().unwrap());
        println!("{:.3}, {low:.3} to {high:.3}; of {}: {:.3}", share(few), runs / plans, share(many));
        outside += u64::from(!(low..=high).contains(&share(many)));
    }
    println!("{} plans, {outside} outside of their intervals", many.len());
    assert!(outside * 10 <= many.len() as u64);
    assert!(many.iter().any(|plan| share(plan) > 0.0), "no plan is ever too close");
}

#[test]
fn without_bounds_the_scene_is_simulated_once() {
    let place = Place::new();
    fs::write(place.path("scene.toml"), SCENE).unwrap();
    let none = "--entry-mm 0 --tilt-deg 0 --bend-mm 0 --tension-percent 0 --feed-mm 0 --samples 0";
    let found = json(&place, &format!("plan path @scene.toml --json {none} -o @plans"));
    assert_eq!(found["candidates"].as_array().unwrap().len(), 1);
}

#[test]
fn what_has_no_path_to_plan_is_refused_by_name() {
    let place = Place::new();
    let refused = |text: &str, more: &str, code: i32, expected: &str| {
        fs::write(place.path("scene.toml"), text).unwrap();
        let done = call(&place.words(format!("plan path @scene.toml -o @plans {more}").trim()));
        assert!(done.code == Some(code) && done.err.contains(expected), "{:?}: {}", done.code, done.err);
        assert!(!place.path("plans").exists());
    };
    refused(&SCENE.replace("target_mm", "#"), "", 2, "no target; set `controller.curved_drilling.target_mm`");
    let program = "\n[[controller]]\nname = \"mine\"\ndrives = []\ncommand = [\"mine\"]\n";
    refused(&format!("{SCENE}{program}"), "", 2, "controller `mine` is not built in");
    let bare = SCENE
        .split("[[structure]]")
        .next()
        .unwrap()
        .replace("[volume]", "")
        .replace("phantom = \"block\"", "");
    let bare = bare.replace("spacing_mm = 1.0", "") + &SCENE[SCENE.find("[[controller]]").unwrap()..];
    refused(&bare, "", 2, "nothing to keep away from; add a `[[structure]]`");
    refused(
        SCENE,
        "--entry-mm 51",
        2,
        "invalid value '51' for '--entry-mm <MM>': expected a number from 0 to 50",
    );
    // Closer than the tool comes.
    let strict = SCENE.replace("[[controller]]", "[tolerance]\ntarget_mm = 0.05\n[[controller]]");
    refused(
        &strict,
        "--candidates 1",
        1,
        "no path without a fault: of 1 path: 0 without a fault, 1 misses the target",
    );
    refused(SCENE, "--tilt-deg -1", 2, "invalid value '-1' for '--tilt-deg <DEG>': expected a number");
    let ball = "ball = { centre_mm = [3.0, 0.0, -16.0], radius_mm = 1.0 }";
    let target = |number| format!("[[structure]]\nname = \"t{number}\"\nrole = \"target\"\n{ball}\n");
    let targets: String = (0..16).map(target).collect();
    let (before, after) = SCENE.split_at(SCENE.find("[[structure]]").unwrap());
    let after = &after[after.find("[[controller]]").unwrap()..];
    refused(&format!("{before}{targets}{after}"), "", 2, "all 16 structures are targets");
    // The study, before a search that would take more than a minute.
    let study = |key: &str, high: f64| {
        let design = "design = \"random\"\nsamples = 2\n[[parameter]]\nmin = 400.0\n";
        fs::write(place.path("study.toml"), format!("{design}key = \"{key}\"\nmax = {high}\n")).unwrap();
    };
    study("truth.nonsense", 500.0);
    refused(SCENE, "--candidates 2000 --study @study.toml", 2, "study.toml: `truth.nonsense`: unknown field");
    study("truth.registration_error_mm.0", 500.0);
    refused(SCENE, "--candidates 1 --study @study.toml", 2, "study.toml: all sampled runs are refused: ");
    fs::write(place.path("taken"), "").unwrap();
    let done = call(&place.words("plan path @scene.toml --candidates 2000 -o @taken/plans"));
    assert!(done.code == Some(2) && done.err.contains("taken/plans: cannot be created"), "{}", done.err);
}
