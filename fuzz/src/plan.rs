//! Markups of 3D Slicer, and a scene that uses them as its plan.

use std::path::Path;

use ipc_types::scene::Scene;
use markups::{Plan, curve_json, points_fcsv, read};

const SCENE: &str = "name = \"plan\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n[tool]\nplan = \"p\"\n\
                     [drr]\nrate_hz = 0.0\ncolumns = 16\nrows = 16\npixel_pitch_mm = 1.0\n[[controller]]\nname = \"c\"\ndrives = []\n\
                     curved_drilling = { feed_mm_per_s = 1.0, tension_n = 1.0, burr_speed_rpm = 0.0, feedback = \"none\" }\n";

/// Reads a file of markups. An accepted one has finite positions and is unchanged when written and read
/// again. A plan in it makes a valid scene, or the scene reports which of its keys is out of range.
pub fn plan(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let Ok(markups) = read(text) else { return };
    for markup in &markups {
        let points_mm: Vec<[f64; 3]> = markup.points.iter().filter_map(|point| point.position_mm).collect();
        assert!(points_mm.iter().flatten().all(|x| x.is_finite()));
        for written in [curve_json("c", &points_mm), points_fcsv("c", &points_mm)] {
            let again = read(&written).unwrap();
            let again: Vec<[f64; 3]> = again[0].points.iter().filter_map(|point| point.position_mm).collect();
            assert_eq!(again.len(), points_mm.len());
            for (there, here) in again.iter().flatten().zip(points_mm.iter().flatten()) {
                // serde_json is off by up to one unit in the last place.
                assert!((there - here).abs() <= f64::EPSILON * here.abs(), "{there} {here}");
            }
        }
    }
    let parsed = Scene::parse_with(SCENE, Path::new("/s.toml"), &|_| Ok(text.to_owned()));
    match Plan::of(&markups) {
        Ok(plan) => {
            let numbers = [plan.direction(), plan.bend_toward(), plan.burr_start_mm(), plan.middle_mm()];
            assert!(numbers.iter().flatten().all(|x| x.is_finite()), "{plan:?}");
            assert!(plan.arc(0.0).length_mm.is_finite());
            if let Ok(scene) = parsed {
                assert_eq!(scene.tool.burr_start_mm, plan.burr_start_mm());
            }
        }
        Err(_) => assert!(parsed.is_err()),
    }
}

/// Seeds: points, a line and a curve in both formats.
pub fn seeds() -> Vec<Vec<u8>> {
    let points_mm = [[-150.2, -135.1, 101.5], [-99.1, -143.6, 116.6], [-82.0, -146.5, 129.3]];
    let named = |text: String| {
        ["entry", "bend", "target"]
            .iter()
            .enumerate()
            .fold(text, |text, (index, name)| text.replace(&format!("F-{}", index + 1), name))
    };
    let ras = r#"{"markups": [{"type": "Line", "coordinateSystem": "RAS", "coordinateUnits": ["mm", "UCUM"], "controlPoints": [
        {"label": "entry", "position": [0, 0, 0], "positionStatus": "defined"}, {"label": "target", "position": [30, 0, 0]}]}]}"#;
    let texts = [
        curve_json("F", &points_mm),
        named(curve_json("F", &points_mm)),
        named(points_fcsv("F", &points_mm)),
        points_fcsv("F", &points_mm).replace("= LPS", "= 0").replace("F-2", "\"a, \"\"b\"\"\""),
        ras.to_owned(),
    ];
    texts.map(String::into_bytes).into()
}
