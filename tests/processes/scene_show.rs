//! `trabecula scene show` and `trabecula volume probe`, on phantoms whose figures are known.

use serde_json::Value;

use crate::common::program::{Place, trabecula};
use crate::common::scenes::{self, PLAN_OF_THE_BALL};

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The ball is 10 mm in radius and lies at the origin; the plan goes from below to its centre.
#[test]
fn the_figures_of_a_plan_in_a_ball_are_the_balls_and_the_picture_shows_hole_tool_and_path() {
    let place = Place::new();
    let (ball, plan, scene) = (place.path("ball.nrrd"), place.path("plan.fcsv"), place.path("s.toml"));
    assert_eq!(trabecula(&[&"phantom", &"sphere", &"-o", &ball]).code, Some(0));
    std::fs::write(&plan, PLAN_OF_THE_BALL).unwrap();
    let made = trabecula(&[&"scene", &"from-markups", &plan, &"--ct", &ball, &"-o", &scene]);
    assert_eq!(made.code, Some(0), "{}", made.err);
    let picture = place.path("plan.png");
    let done = trabecula(&[&"scene", &"show", &scene, &"-o", &picture, &"--json"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let said: Value = serde_json::from_str(&done.out).unwrap();
    // Voxels of half a millimetre.
    for (what, value, wanted) in [
        ("entry", &said["entry"]["place_mm"][2], -10.0),
        ("target", &said["target"]["place_mm"][2], 0.0),
        ("depth", &said["target_depth_mm"], 10.0),
        ("bone ahead", &said["bone_ahead_mm"], 10.0),
        ("in bone", &said["in_bone_mm"], 10.0),
    ] {
        assert!((number(value) - wanted).abs() <= 0.6, "{what}: {value}, expected {wanted}: {said}");
    }
    assert!(number(&said["arm_feed_mm"]) >= 100.0, "the comfortable arm moves 100 mm in every direction");
    let probed = trabecula(&[&"volume", &"probe", &ball, &"--at", &"0,0,0", &"--json"]);
    let probed: Value = serde_json::from_str(&probed.out).unwrap();
    assert_eq!(probed["places"][0]["hu"], said["target"]["hu"], "two ways to the same voxels");

    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&picture).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.color_type), (1760, png::ColorType::Rgb));
    let count = |colour: [u8; 3]| pixels.chunks_exact(3).filter(|pixel| *pixel == colour).count();
    // Hole, tool at the start, tool at the end, path.
    for colour in [[86, 180, 233], [240, 228, 66], [255, 140, 60], [204, 121, 167]] {
        assert!(count(colour) > 500, "{colour:?}: {}", count(colour));
    }
}

#[test]
fn a_scene_that_cannot_be_shown_ends_with_2_and_writes_nothing() {
    let place = Place::new();
    let scene = place.scene(&scenes::hold("lockstep", 1.0));
    for (name, said) in [("a.png", "the scene has no `[volume]`"), ("a.svg", "expected a .png file")] {
        let output = place.path(name);
        let done = trabecula(&[&"scene", &"show", &scene, &"-o", &output]);
        assert!(done.code == Some(2) && done.err.contains(said) && !output.exists(), "{name}: {}", done.err);
    }
}

#[test]
fn a_place_is_read_in_its_frame_or_refused_with_the_volumes_corners() {
    let place = Place::new();
    let block = place.path("block.nrrd");
    assert_eq!(trabecula(&[&"phantom", &"pelvis", &"-o", &block, &"--spacing-mm", &"2"]).code, Some(0));
    let probe = |words: &[&dyn AsRef<std::ffi::OsStr>]| {
        let mut all: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"volume", &"probe", &block, &"--json"];
        all.extend(words);
        trabecula(&all)
    };
    let lps = probe(&[&"--at=-99.1,-143.6,116.6", &"--at", &"-98,-144,116"]);
    let ras = probe(&[&"--ras", &"--at=99.1,143.6,116.6", &"--at=98,144,116"]);
    assert_eq!((lps.code, &lps.out), (Some(0), &ras.out), "{}{}", lps.err, ras.err);
    let said: Value = serde_json::from_str(&lps.out).unwrap();
    assert_eq!(said["places"].as_array().unwrap().len(), 2);
    assert!(said["places"][0]["hu"].is_number() && said["places"][0]["voxel_hu"].is_number());
    let outside = probe(&[&"--at=5000,0,0"]);
    let expected = "--at is [5000, 0, 0], expected a place within the volume, from [";
    assert!(outside.code == Some(2) && outside.err.contains(expected), "{}", outside.err);
    for wrong in ["--at=1,2", "--at=1,2,x", "--at=1,2,3,4", "--at=nan,0,0"] {
        let done = probe(&[&wrong]);
        assert!(done.code == Some(2) && done.err.contains("expected three numbers"), "{wrong}: {}", done.err);
    }
}
