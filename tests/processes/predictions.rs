//! `scene check --simulate`: what is predicted is what happens, and what goes wrong is said before, in
//! the run and in the exit code.
//!
//! Every random scene follows from its seed. The tests run a few; this command runs any number:
//!
//! ```sh
//! TRABECULA_PREDICTIONS=50 cargo test --release --test processes predictions -- --nocapture
//! ```

use fastrand::Rng;
use serde_json::Value;

use crate::common::program::{Place, only_entry, trabecula};
use crate::common::scenes;

const COUNT_VARIABLE: &str = "TRABECULA_PREDICTIONS";
/// Number of random scenes in an ordinary test run.
const FEW: u64 = 6;

/// Radius to which the standard burr of 6.5 mm cuts, mm.
const BURR_REACH_MM: f64 = 3.25 + 0.1;

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

/// A block of coarse voxels, drilled for a fraction of a second by a random built-in controller with a random
/// tool in a random direction, with structures, sensors and model errors at random.
fn random_scene(seed: u64) -> String {
    let mut random = Rng::with_seed(seed);
    let kind = random.usize(..9);
    let mut between = |low: f64, high: f64| low + (high - low) * random.f64();
    let duration_ms = between(300.0, 800.0).round();
    let [x, y, gap_mm] = [between(-15.0, 15.0), between(-12.0, 12.0), between(0.05, 0.3)];
    let tilt = [between(-0.9, 0.9), between(-0.3, 0.3)];
    let [feed, tension_n, rpm] = [between(10.0, 20.0), between(0.0, 12.0), between(3e3, 12e3)];
    let [insertion_mm, ramp_mm] = [between(3.0, 10.0), between(0.5, 6.0)];
    let mut text = format!(
        "name = \"random\"\n[run]\nmode = \"lockstep\"\nduration_s = {:?}\nseed = {seed}\n\
         [volume]\nphantom = \"block\"\nspacing_mm = 1.0\n\
         [tool]\nburr_start_mm = [{x:?}, {y:?}, {:?}]\ndirection = [{:?}, {:?}, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [arm]\nmax_acceleration_mm_per_s2 = 2000.0\nmax_jerk_mm_per_s3 = 100000.0\n",
        duration_ms * 1e-3,
        -30.75 - gap_mm,
        tilt[0],
        tilt[1]
    );
    let drilling = |feedback: &str| {
        format!(
            "curved_drilling = {{ feed_mm_per_s = {feed:?}, insertion_mm = {insertion_mm:?}, \
             tension_n = {tension_n:?}, feedback = {feedback:?}, ramp_end_mm = {ramp_mm:?}, \
             burr_speed_rpm = {rpm:?}, guidance_gain_n_per_mm = 0.5, \
             target_mm = [{:?}, {y:?}, {:?}], retraction_mm = 1.0 }}",
            x + 0.5 * insertion_mm * tilt[0],
            -30.75 + insertion_mm
        )
    };
    let controller = match kind {
        0..=2 => drilling("none"),
        3 => drilling("shape"),
        4 => drilling("image"),
        5 | 6 => format!(
            "skiving = {{ feed_mm_per_s = {feed:?}, depth_mm = {insertion_mm:?}, \
             tension_n = {tension_n:?}, burr_speed_rpm = {rpm:?} }}"
        ),
        7 => format!("tension_sweep = {{ most_n = {:?}, step_n = 1.0, settle_s = 0.02 }}", 1.0 + tension_n),
        _ => format!("hold = {{ tension_n = {tension_n:?} }}"),
    };
    text += &format!(
        "[[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n{controller}\n"
    );
    if kind == 4 {
        text += "[drr]\nrate_hz = 20.0\nisocentre_mm = [0.0, 0.0, -25.0]\ncolumns = 32\nrows = 32\n\
                 pixel_pitch_mm = 3.0\nphotons_per_pixel = 5000.0\nthreads = 1\n";
    }
    let model = ["constant_curvature", "modal", "planar", "spatial", "full"][random.usize(..5)];
    text += &format!("[manipulator]\nmodel = {model:?}\n");
    if random.bool() {
        let action = ["event", "stop", "fixture"][random.usize(..3)];
        text += &format!(
            "[[structure]]\nname = \"nerve\"\nmargin_mm = {:?}\non_margin = {action:?}\n\
             ball = {{ centre_mm = [{x:?}, {y:?}, -20.0], radius_mm = 5.0 }}\n",
            0.5 + 4.0 * random.f64()
        );
    }
    if random.bool() {
        text += "[[structure]]\nname = \"outside\"\nmargin_mm = 2.0\nbuilt_in = \"outside_of_bone\"\n";
    }
    if random.bool() {
        text += "[[sensor]]\nname = \"fibre\"\nrate_hz = 100.0\njitter_ms = 5.0\ndropout = 0.1\nfbg = {}\n";
    }
    if random.bool() {
        text += &format!(
            "[truth]\nregistration_error_mm = [0.0, {:?}, 0.0]\nregistration_error_deg = [1.0, 0.0, 0.5]\n\
             [truth.manipulator]\nstiffness_scale = {:?}\n[truth.drilling]\nedge_pressure_mpa = {:?}\n",
            random.f64(),
            0.8 + 0.4 * random.f64(),
            4.0 * random.f64()
        );
    }
    text
}

/// Predicted and actual outcome of random scenes are the same, to the bit, as are their findings.
#[test]
fn random_scenes_are_predicted_bit_for_bit() {
    let count = std::env::var(COUNT_VARIABLE).map_or(FEW, |text| text.parse().unwrap());
    let [mut cut, mut breached, mut stopped, mut approached] = [0; 4];
    for seed in 1..=count {
        let place = Place::new();
        let text = random_scene(seed);
        let (predicted, ended) = predicted_and_run(&place, &text);
        let (prediction, summary) = (&predicted["prediction"], &ended["summary"]);
        assert!(prediction["final_hash"].is_string(), "seed {seed}: {prediction}");
        for key in ["final_hash", "ticks", "tool", "plan", "drilling", "structures"] {
            assert_eq!(prediction[key], summary[key], "seed {seed}: {key} of\n{text}");
        }
        let texts = |list: &Value| list.as_array().unwrap().clone();
        let cautions = texts(&summary["cautions"]);
        for finding in texts(&prediction["findings"]) {
            assert!(cautions.contains(&finding), "seed {seed}: {finding} is not of {cautions:?}");
        }
        let count = |found: bool| u64::from(found);
        cut += count(summary["drilling"]["removed_voxels"] != 0);
        breached += count(summary["breaches"] != 0);
        stopped += count(summary["plan"]["protective_stops"] != 0);
        approached += count(
            texts(&summary["structures"]).iter().any(|structure| structure["ticks_within_margin"] != 0),
        );
    }
    println!(
        "{count} scenes: {cut} cut bone, {breached} breached it, {stopped} stopped the arm, \
         {approached} with structures within their margins; all predicted to the bit"
    );
    assert!(count < 50 || cut > 0, "nothing was drilled");
}

/// A plate of 3 mm, drilled through: what counts is the exit, a circle, and not the entry of the same size.
/// Its radius is that of the burr with its reach, less half a voxel, because partly cut voxels still stand.
/// The tolerance is that of a rim of 20 mm through about 60 voxels of 0.4 mm.
#[test]
fn the_breach_area_of_a_hole_through_a_plate_is_that_of_its_exit() {
    let place = Place::new();
    let header = "NRRD0004\ntype: short\ndimension: 3\nspace: left-posterior-superior\nendian: little\n\
                  sizes: 60 60 40\nspace directions: (0.4,0,0) (0,0.4,0) (0,0,0.4)\n\
                  space origin: (-11.8,-11.8,-5.8)\nencoding: raw\n\n";
    let hu = (0..60 * 60 * 40).flat_map(|index| {
        let [i, j, k] = [index % 60, index / 60 % 60, index / 3600].map(|at| 0.4 * f64::from(at));
        let is_bone = (i - 11.8).abs().max((j - 11.8).abs()) < 10.0 && (k - 5.8).abs() < 1.5;
        (if is_bone { 900_i16 } else { -1000 }).to_le_bytes()
    });
    std::fs::write(place.path("plate.nrrd"), header.bytes().chain(hu).collect::<Vec<u8>>()).unwrap();
    let text = "name = \"plate\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.5\n\
                [volume]\npath = \"plate.nrrd\"\n\
                [tool]\nburr_start_mm = [0.0, 0.0, -5.0]\ndirection = [0.0, 0.0, 1.0]\n\
                bend_toward = [1.0, 0.0, 0.0]\n\
                [[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n\
                skiving = { feed_mm_per_s = 10.0, depth_mm = 11.0, burr_speed_rpm = 12000.0 }\n";
    let (predicted, ended) = predicted_and_run(&place, text);
    let drilling = &ended["summary"]["drilling"];
    assert_eq!(&predicted["prediction"]["drilling"], drilling);
    let area_mm2 = drilling["breach_area_mm2"].as_f64().unwrap();
    let circle_mm2 = std::f64::consts::PI * (BURR_REACH_MM - 0.2).powi(2);
    assert!((area_mm2 / circle_mm2 - 1.0).abs() < 0.05, "{area_mm2} mm2, the circle has {circle_mm2}");
    let (_, blind) = predicted_and_run(&place, &text.replace("depth_mm = 11.0", "depth_mm = 3.0"));
    let drilling = &blind["summary"]["drilling"];
    assert!(drilling["removed_voxels"].as_u64().unwrap() > 0);
    assert_eq!(drilling["breach_area_mm2"], 0.0, "a blind hole");
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
