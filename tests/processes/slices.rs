//! Slices of the CT from a viewer, live and from logs.

use serde_json::{Value, json};

use crate::common::program::{Place, succeed, trabecula, wait_for};
use crate::common::scenes;
use crate::view::{View, notices};

const SLICE: u32 = 6;
const OUTSIDE: i16 = i16::MIN;
const DRILLED: i16 = i16::MIN + 1;

/// Returns a request for a plane of x and z about a point, with one pixel per millimetre.
fn about(centre_m: [f64; 3], side: u32) -> Value {
    let side_m = f64::from(side) * 1e-3;
    json!({"centre_m": centre_m, "right": [1, 0, 0], "down": [0, 0, -1], "side_m": [side_m, side_m], "columns": side, "rows": side})
}

/// Returns the number of drilled voxels and the pixels of a slice.
fn slice(view: &mut View, request: Value) -> (u64, Vec<i16>) {
    // A log is read in the background; until then the viewer reports that.
    let bytes = wait_for("a slice", || {
        let (encoding, bytes) = view.call_raw(SLICE, request.clone());
        let text = String::from_utf8_lossy(&bytes).into_owned();
        assert!(encoding == "trabecula.slice" || text.contains("the log is being read"), "{text}");
        (encoding == "trabecula.slice").then_some(bytes)
    });
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

    // Invalid slices.
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
    let run = place.start(&scenes::drill("realtime", 600.0));
    let mut view = View::start(&[], Some(&run.session()));
    let (_, pixels) = slice(&mut view, about([0.0; 3], 80));
    assert!(count(&pixels, OUTSIDE) > 3000 && pixels.iter().any(|hu| *hu >= 150), "no bone");
    // As many as fit into the second are answered, and the rest waits: none is lost.
    for _ in 0..40 {
        let (_, pixels) = slice(&mut view, about([0.0; 3], 512));
        assert_eq!(pixels.len(), 512 * 512);
    }
    assert_eq!(view.call(1, json!({"action": "stop"})), json!({"ok": true}));
    run.end();

    let run = place.start(&scenes::hold("realtime", 600.0));
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
        succeed(&[&"phantom", &kind, &"-o", &file]);
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
    assert!(refused(&mut view, about([0.0; 3], 80)).contains("the run's volume is not available"));
    view.stop();
}

/// The plan's figures match those of `scene show`; a pilot hole is drilled, and nothing can be controlled.
#[test]
fn a_scene_is_shown_before_its_run() {
    let place = Place::new();
    let hole = "[[predrill]]\nfrom_mm = [0.0, 0.0, -40.0]\nto_mm = [0.0, 0.0, -20.0]\ndiameter_mm = 7.0\n";
    let file = place.path("scene.toml");
    let text = scenes::drill("lockstep", 3.0)
        .replace("burr_start_mm = [0.0, 0.0, -34.0]", "burr_start_mm = [0.0, 0.0, -20.0]");
    std::fs::write(&file, format!("{text}{hole}")).unwrap();
    let shown =
        succeed(&[&"scene", &"show", &file, &"--no-simulate", &"-o", &place.path("plan.png"), &"--json"]);
    let figures: Value = serde_json::from_str(&shown.out).unwrap();

    let mut view = View::start(&[&file], None);
    let info = view.subscribe("/view/info");
    let info: Value = serde_json::from_slice(&view.next(info)).unwrap();
    assert_eq!(info["kind"], "plan");
    for key in ["path_mm", "in_bone_mm", "target_depth_mm", "arm_feed_mm", "findings", "target"] {
        assert!(!figures[key].is_null(), "{key}: {figures}");
        assert_eq!(info["plan"]["facts"][key], figures[key], "{key}");
    }
    let states = view.subscribe("/state");
    let state = view.next_state(states);
    let burr_mm = state.t_world_burr.position_m.map(|x| 1e3 * x);
    let off =
        burr_mm.iter().zip([0.0, 0.0, -20.0]).map(|(a, b): (&f64, f64)| (a - b).abs()).fold(0.0, f64::max);
    assert!(state.tick == 0 && off < 1e-6, "{burr_mm:?}");
    let (drilled, pixels) = slice(&mut view, about([0.0; 3], 80));
    // The hole is 7 mm wide and lies in the block, whose faces are at 27.5 mm and more, for 7 mm and more.
    assert!(
        drilled > 0 && count(&pixels, DRILLED) > 40,
        "{drilled} voxels, {} pixels",
        count(&pixels, DRILLED)
    );
    assert!(
        view.call(1, json!({"action": "pause"}))["error"].as_str().unwrap().contains("no run in progress")
    );
    view.stop();

    // Without a CT there is the tool, but no slice.
    let bare = place.path("bare.toml");
    std::fs::write(&bare, scenes::hold("realtime", 1.0)).unwrap();
    let mut view = View::start(&[&bare], None);
    assert!(refused(&mut view, about([0.0; 3], 80)).contains("no `[volume]`"));
    view.stop();

    for (arguments, why) in [(vec![&file, &file], "compared"), (vec![&place.path("none.toml")], "none.toml")]
    {
        let mut all: Vec<&dyn AsRef<std::ffi::OsStr>> = vec![&"view", &"--no-open", &"--port", &"0"];
        all.extend(arguments.into_iter().map(|path| path as &dyn AsRef<std::ffi::OsStr>));
        let done = trabecula(&all);
        assert!(done.code == Some(2) && done.err.contains(why), "{:?} {}", done.code, done.err);
    }
}
