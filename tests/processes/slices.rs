//! Slices of the CT from a viewer, beside a run and on logs.

use serde_json::{Value, json};

use crate::common::program::{Place, trabecula};
use crate::common::scenes;
use crate::view::{View, notices};

const SLICE: u32 = 5;
const OUTSIDE: i16 = i16::MIN;
const DRILLED: i16 = i16::MIN + 1;

/// A request for a plane of x and z about a place, as many pixels as millimetres each way.
fn about(centre_m: [f64; 3], side: u32) -> Value {
    let side_m = f64::from(side) * 1e-3;
    json!({"centre_m": centre_m, "right": [1, 0, 0], "down": [0, 0, -1], "side_m": [side_m, side_m], "columns": side, "rows": side})
}

/// The number of drilled voxels and the pixels of a slice.
fn slice(view: &mut View, request: Value) -> (u64, Vec<i16>) {
    let (encoding, bytes) = view.call_raw(SLICE, request);
    assert_eq!(encoding, "trabecula.slice", "{}", String::from_utf8_lossy(&bytes));
    let pixels = bytes[24..].chunks_exact(2).map(|pair| i16::from_le_bytes([pair[0], pair[1]])).collect();
    (u64::from_le_bytes(bytes[16..24].try_into().unwrap()), pixels)
}

fn refused(view: &mut View, request: Value) -> String {
    let answer = view.call(SLICE, request);
    answer["error"].as_str().unwrap_or_else(|| panic!("{answer}")).to_owned()
}

fn count(pixels: &[i16], value: i16) -> usize {
    pixels.iter().filter(|pixel| **pixel == value).count()
}

/// The block is 40 x 40 x 60 mm with its margin; the tool drills along z from its lower face.
#[test]
fn a_log_is_sliced_as_it_was_at_the_time_that_is_shown() {
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 2.0));
    let mut view = View::start(&[&ended.folder], None);
    let states = view.subscribe("/state");
    let (drilled, pixels) = slice(&mut view, about([0.0; 3], 80));
    assert_eq!((drilled, count(&pixels, DRILLED)), (0, 0));
    // 40 mm of 80 across, 60 mm of 80 down; a pixel is a voxel.
    let inside = pixels.len() - count(&pixels, OUTSIDE);
    assert!((2300..=2500).contains(&inside), "{inside} pixels of the volume");

    assert_eq!(view.call(4, json!({"action": "seek", "time_ns": 2_000_000_000})), json!({"ok": true}));
    let last = loop {
        let state = view.next_state(states);
        if state.tick == 2000 {
            break state;
        }
    };
    let (drilled, pixels) = slice(&mut view, about([0.0; 3], 80));
    assert!(last.removed_total > 100, "{}", last.removed_total);
    assert_eq!(drilled, last.removed_total);
    assert!(count(&pixels, DRILLED) > 20, "{} drilled pixels", count(&pixels, DRILLED));
    let (_, far) = slice(&mut view, about([0.5, 0.0, 0.0], 80));
    assert_eq!(count(&far, OUTSIDE), far.len(), "a slice beside the volume");

    // What is no slice.
    let mut bad = about([0.0; 3], 80);
    bad["right"] = json!([0, 0, 0]);
    assert!(refused(&mut view, bad).contains("perpendicular unit vectors"));
    assert!(refused(&mut view, about([0.0; 3], 513)).contains("513 x 513 pixels"));
    let mut not_a_number = about([0.0; 3], 8);
    not_a_number["centre_m"][2] = json!(f64::NAN);
    assert!(refused(&mut view, not_a_number).contains("malformed"));
    view.stop();
}

#[test]
fn a_running_session_is_sliced_and_one_without_volume_says_so() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 60.0));
    let mut view = View::start(&[], Some(&run.session()));
    let (_, pixels) = slice(&mut view, about([0.0; 3], 80));
    assert!(count(&pixels, OUTSIDE) > 3000 && pixels.iter().any(|hu| *hu > 500), "no bone");
    // As many as fit into the second, and the rest waits: none is lost.
    for _ in 0..40 {
        let (_, pixels) = slice(&mut view, about([0.0; 3], 512));
        assert_eq!(pixels.len(), 512 * 512);
    }
    assert_eq!(view.call(1, json!({"action": "stop"})), json!({"ok": true}));
    run.end();

    let run = place.start(&scenes::hold("realtime", 60.0));
    let mut view = View::start(&[], Some(&run.session()));
    assert!(refused(&mut view, about([0.0; 3], 80)).contains("no `[volume]`"));
    assert_eq!(view.call(1, json!({"action": "stop"})), json!({"ok": true}));
    run.end();
}

#[test]
fn a_log_whose_volume_is_another_now_is_not_sliced() {
    let place = Place::new();
    let [ball, pelvis] = ["ball.nrrd", "block.nrrd"].map(|name| place.path(name));
    for (kind, file) in [("sphere", &ball), ("block", &pelvis)] {
        let made = trabecula(&[&"phantom", &kind, &"-o", &file]);
        assert_eq!(made.code, Some(0), "{}", made.err);
    }
    let scene = scenes::drill("lockstep", 0.05).replace(
        "phantom = \"block\"\nspacing_mm = 1.0",
        &format!("path = {:?}", ball.display().to_string()),
    );
    let folder = place.complete(&scene).folder;
    std::fs::rename(&pelvis, &ball).unwrap();
    let mut view = View::start(&[&folder], None);
    let said = notices(&mut view, 1);
    assert!(said[0].contains("SHA-256"), "{said:?}");
    assert!(refused(&mut view, about([0.0; 3], 80)).contains("the run's volume is not here"));
    view.stop();
}
