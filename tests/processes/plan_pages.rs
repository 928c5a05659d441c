//! The page of a scene before its run: positions are moved, and a scene is saved only under a new name.

use std::fs;

use serde_json::{Value, json};

use crate::common::program::{Place, succeed, trabecula};
use crate::view::View;

const PLAN: u32 = 7;
const SCENE: &str = "# Mine.\nname = \"planned\"\n[run]\nmode = \"lockstep\"\nduration_s = 30.0\n[volume]\nphantom = \"block\"\nspacing_mm = 1.0\n\
    [tool]\nburr_start_mm = [0.0, 0.0, -34.0]   # before the block\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
    [[controller]]\nname = \"reference\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n[controller.curved_drilling]\nfeed_mm_per_s = 1.5\n\
    insertion_mm = 20.0\ntension_n = 6.0\nramp_start_mm = 1.0\nramp_end_mm = 16.0\nburr_speed_rpm = 8000.0\n\
    target_mm = [4.0, 0.0, -15.0] # inside\n";

fn moved(view: &mut View, places: Value) -> Value {
    view.call(PLAN, json!({"action": "move", "places": places}))
}

fn saved(view: &mut View, name: &str, replace: bool) -> Value {
    view.call(PLAN, json!({"action": "save", "name": name, "replace": replace}))
}

fn error(answer: &Value) -> String {
    assert_eq!(answer["ok"], false, "{answer}");
    answer["error"].as_str().unwrap().to_owned()
}

#[test]
fn a_moved_place_is_told_with_what_follows_and_refused_in_the_words_of_scene_check() {
    let place = Place::new();
    let file = place.path("scene.toml");
    fs::write(&file, SCENE).unwrap();
    let mut view = View::start(&[&file], None);
    let told = view.subscribe("/view/info");
    let before: Value = serde_json::from_slice(&view.next(told)).unwrap();
    assert_eq!(before["plan"]["places"]["target_mm"], json!([4.0, 0.0, -15.0]));
    // A circle from (0, 0, -33) along z to 6 mm to the side and 18 mm ahead.
    assert_eq!(moved(&mut view, json!({"target_mm": [6.0, 0.0, -15.0]})), json!({"ok": true}));
    // Predictions arrive in between.
    let target_is =
        |target_mm: [f64; 3]| move |told: &Value| told["plan"]["places"]["target_mm"] == json!(target_mm);
    let after = view.next_json(told, target_is([6.0, 0.0, -15.0]));
    assert_eq!(after["plan"]["places"]["target_mm"], json!([6.0, 0.0, -15.0]));
    let path = after["scene"]["planned_path_m"].as_array().unwrap();
    assert_eq!(path.last(), Some(&json!([6.0 * 1e-3, 0.0, -15.0 * 1e-3])));
    let half_rad = (6.0_f64 / 18.0).atan();
    let arc_mm = 18.0_f64.hypot(6.0) * half_rad / half_rad.sin();
    let length_mm = after["plan"]["facts"]["path_mm"].as_f64().unwrap();
    assert!((length_mm - 1.0 - arc_mm).abs() < 1e-2, "{length_mm}");

    // The same value in a file.
    let bad = place.path("bad.toml");
    fs::write(&bad, SCENE.replace("[0.0, 0.0, -34.0]", "[0.0, 1e7, -34.0]")).unwrap();
    let of_page = error(&moved(&mut view, json!({"burr_start_mm": [0.0, 1e7, -34.0]})));
    let of_command = trabecula(&[&"scene", &"check", &bad]);
    assert_eq!(of_command.code, Some(2));
    let words = of_page.strip_prefix(file.to_str().unwrap()).unwrap();
    assert!(
        words.contains("allowed:") && of_command.err.trim_end().ends_with(words),
        "{words}\n{}",
        of_command.err
    );
    assert!(error(&moved(&mut view, json!({"isocentre_mm": [0, 0, 0]}))).contains("missing `[drr]`"));
    assert!(error(&moved(&mut view, json!({"target_mm": [0.0]}))).contains("malformed request"));

    // Observers cannot change anything.
    let token = std::mem::replace(&mut view.token, "0".repeat(32));
    for body in
        [json!({"action": "restore"}), json!({"action": "run"}), json!({"action": "save", "name": "a"})]
    {
        assert!(error(&view.call(PLAN, body)).contains("wrong token"));
    }
    view.token = token;
    assert!(error(&view.call(PLAN, json!({"action": "run"}))).contains("unsaved changes"));
    assert_eq!(view.call(PLAN, json!({"action": "restore"})), json!({"ok": true}));
    let restored = view.next_json(told, target_is([4.0, 0.0, -15.0]));
    assert_eq!(restored["plan"]["places"], before["plan"]["places"]);
    view.stop();
}

#[test]
fn a_scene_is_saved_beside_the_one_that_was_opened_and_over_nothing_unasked() {
    let place = Place::new();
    let folder = place.path("scenes");
    fs::create_dir(&folder).unwrap();
    let file = folder.join("scene.toml");
    fs::write(&file, SCENE).unwrap();
    let mut view = View::start(&[&file], None);
    assert_eq!(moved(&mut view, json!({"target_mm": [4.5, 0.0, -15.0]})), json!({"ok": true}));
    for name in ["../out.toml", "/tmp/out.toml", ".out.toml", "", "a/b.toml", "a\n.toml"] {
        assert!(error(&saved(&mut view, name, true)).contains("invalid name"), "{name:?}");
    }
    let edited = folder.join("edited.toml");
    assert_eq!(saved(&mut view, "edited", false), json!({"ok": true, "path": edited}));
    let text = fs::read_to_string(&edited).unwrap();
    assert!(
        text.contains("target_mm = [4.5, 0.0, -15.0] # inside") && text.starts_with("# Mine.\n"),
        "{text}"
    );
    succeed(&[&"scene", &"check", &edited]);

    // An existing file stays until its replacement is confirmed; the original stays anyway, under any of its
    // names.
    let other = place.path("other.toml");
    fs::write(&other, "other").unwrap();
    std::os::unix::fs::symlink(&other, folder.join("link.toml")).unwrap();
    std::os::unix::fs::symlink(&file, folder.join("same.toml")).unwrap();
    fs::write(folder.join("taken.toml"), "taken").unwrap();
    for name in ["taken.toml", "link.toml"] {
        let answer = saved(&mut view, name, false);
        assert_eq!((&answer["exists"], error(&answer).contains("exists")), (&json!(true), true), "{answer}");
        assert_ne!(fs::read_to_string(folder.join(name)).unwrap(), text);
        assert_eq!(saved(&mut view, name, true)["ok"], true);
        assert_eq!(fs::read_to_string(folder.join(name)).unwrap(), text);
    }
    assert_eq!(fs::read_to_string(&other).unwrap(), "other", "a link was followed");
    for name in ["scene.toml", "same.toml"] {
        assert!(error(&saved(&mut view, name, true)).contains("never overwritten"), "{name}");
    }
    assert_eq!(fs::read_to_string(&file).unwrap(), SCENE);
    let mut names: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["edited.toml", "link.toml", "same.toml", "scene.toml", "taken.toml"]);
    view.stop();
}
