//! `trabecula scene show` and `trabecula volume probe`, on phantoms whose figures are known.

use serde_json::Value;

use crate::common::program::{Place, succeed, trabecula};
use crate::common::scenes::PLAN_OF_THE_BALL;

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// The ball has a radius of 10 mm, centred on the origin; the plan leads from below to its centre.
#[test]
fn the_figures_of_a_plan_in_a_ball_are_the_balls_and_the_picture_shows_hole_tool_and_path() {
    let place = Place::new();
    let (ball, plan, scene) = (place.path("ball.nrrd"), place.path("plan.fcsv"), place.path("s.toml"));
    succeed(&[&"phantom", &"sphere", &"-o", &ball]);
    std::fs::write(&plan, PLAN_OF_THE_BALL).unwrap();
    succeed(&[&"scene", &"from-markups", &plan, &"--ct", &ball, &"-o", &scene]);
    let picture = place.path("plan.png");
    let done = succeed(&[&"scene", &"show", &scene, &"-o", &picture, &"--json"]);
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
