//! `trabecula scene show` and `trabecula volume probe`, on phantoms whose figures are known.

use std::path::Path;

use serde_json::Value;

use crate::common::program::{Place, succeed, trabecula};
use crate::common::scenes::PLAN_OF_THE_BALL;

/// Decodes a picture of 8-bit RGB.
fn pixels(picture: &Path) -> (png::OutputInfo, Vec<u8>) {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(picture).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    (info, pixels)
}

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

    let (info, pixels) = pixels(&picture);
    assert_eq!((info.width, info.color_type), (1760, png::ColorType::Rgb));
    // Regression: two screens tall.
    assert!(info.height <= 2100, "{}", info.height);
    let count = |colour: [u8; 3]| pixels.chunks_exact(3).filter(|pixel| *pixel == colour).count();
    // Hole, tool at the start, tool at the end, path, predicted path and tool.
    for colour in [[86, 180, 233], [240, 228, 66], [255, 140, 60], [204, 121, 167], [0, 200, 140]] {
        assert!(count(colour) > 500, "{colour:?}: {}", count(colour));
    }
}

/// A block of 3 mm of bone, scanned at 20 µm, in air; the plan leads from its lower face to its centre.
///
/// Regression: it was a stamp in grey panels, sampled every 13 voxels, and the path's first point was not
/// reported to be outside it.
#[test]
fn a_specimen_of_four_millimetres_fills_the_picture_and_is_measured_to_its_voxel() {
    const SIDE: usize = 195;
    let place = Place::new();
    let (ct, plan, scene) = (place.path("specimen.nrrd"), place.path("plan.fcsv"), place.path("s.toml"));
    let space = "type: short\ndimension: 3\nspace: left-posterior-superior\n\
                 space directions: (0.02,0,0) (0,0.02,0) (0,0,0.02)\nspace origin: (-1.94,-1.94,-1.94)\n";
    let head = format!("NRRD0004\n{space}sizes: {SIDE} {SIDE} {SIDE}\nendian: little\nencoding: raw\n\n");
    let mut bytes = head.into_bytes();
    for index in 0..SIDE * SIDE * SIDE {
        let at = [index % SIDE, index / SIDE % SIDE, index / SIDE / SIDE];
        let inside = at.iter().all(|at| (22..173).contains(at));
        bytes.extend_from_slice(&(if inside { 1200_i16 } else { -1000 }).to_le_bytes());
    }
    std::fs::write(&ct, bytes).unwrap();
    std::fs::write(&plan, PLAN_OF_THE_BALL.replace("-12,", "-1.6,")).unwrap();
    let made = trabecula(&[&"scene", &"from-markups", &plan, &"--ct", &ct, &"-o", &scene]);
    assert_eq!(made.code, Some(0), "{}", made.err);
    let picture = place.path("plan.png");
    let done = trabecula(&[&"scene", &"show", &scene, &"-o", &picture]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    assert!(done.out.contains("after the first point of the path"), "{}", done.out);
    let again = place.path("again.png");
    let said = trabecula(&[&"scene", &"show", &scene, &"-o", &again, &"--json"]);
    let said: Value = serde_json::from_str(&said.out).unwrap();
    // The faces of the block lie at 1.51 mm; a voxel is 0.02 mm.
    for (what, value, wanted) in [
        ("entry", &said["entry"]["place_mm"][2], -1.5),
        ("depth", &said["target_depth_mm"], 1.51),
        ("bone ahead", &said["bone_ahead_mm"], 1.51),
        ("in bone", &said["in_bone_mm"], 1.51),
    ] {
        assert!((number(value) - wanted).abs() <= 0.03, "{what}: {value}, expected {wanted}: {said}");
    }
    let (_, pixels) = pixels(&picture);
    let count = |colour: [u8; 3]| pixels.chunks_exact(3).filter(|pixel| *pixel == colour).count();
    // Grey outside the volume: less than half of the 1.87 million pixels of the 7 slices.
    assert!(count([235, 235, 235]) < 900_000, "{}", count([235, 235, 235]));
}
