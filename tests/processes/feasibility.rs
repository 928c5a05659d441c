//! Scenes that make no sense: `scene check`, `run` and `plan` say the same of them. What is said of each: `crates/simulation/tests/physics/feasibility/`.

use std::path::Path;

use ipc_types::scene::Scene;
use trabecula::feasibility;
use trabecula::launcher::volume_source::{self, VolumeFiles};

use crate::common::program::{Place, trabecula};
use crate::common::scenes;

/// What the three commands say of a scene: exit code and standard error, and for `scene check` also standard output.
fn said(place: &Place, text: &str) -> [(Option<i32>, String); 3] {
    let scene = place.scene(text);
    let check = trabecula(&[&"scene", &"check", &scene]);
    let run = trabecula(&[&"run", &scene, &"--output", &place.path("out"), &"--quiet"]);
    let plan = trabecula(&[&"plan", &scene]);
    [(check.code, check.out + &check.err), (run.code, run.err), (plan.code, plan.err)]
}

/// A run over a scene whose target lay behind the start drilled for its whole length into the wrong direction.
#[test]
fn an_impossible_scene_is_refused_by_every_command_before_anything_is_written() {
    let place = Place::new();
    let behind = scenes::drill("lockstep", 4.0) + "target_mm = [0.0, 0.0, -40.0]\n";
    let expected = "scene.toml: `controller.curved_drilling.target_mm` lies 6.0 mm behind the start, allowed is 0 to 20 ahead (`insertion_mm`)";
    for (code, text) in said(&place, &behind) {
        assert_eq!(code, Some(2), "{text}");
        assert!(text.contains(expected), "{text}");
    }
    assert_eq!(place.entries(), ["scene.toml"]);
}

#[test]
fn an_unlikely_scene_runs_and_every_command_warns_of_it() {
    let place = Place::new();
    let short = scenes::drill("lockstep", 0.1).replace("rate_hz = 10.0", "rate_hz = 30.0");
    let expected = "warning: PLACE: `drr.rate_hz` is 30; a frame every 33 ticks of 1 ms is 30.303 Hz"
        .replace("PLACE", &place.path("scene.toml").display().to_string());
    for (code, text) in said(&place, &short) {
        assert_eq!(code, Some(0), "{text}");
        assert!(text.contains(&expected), "{text}");
        assert!(text.contains("`run.duration_s` is 0.1; `controller.curved_drilling` needs 2.5 s"), "{text}");
    }
}

/// Keys that another table replaces were taken without a word.
#[test]
fn keys_that_a_table_replaces_are_warned_of() {
    for (example, from, to, said) in [
        (
            "drr_carm.toml",
            "\n\n[drr.carm]",
            "\nprimary_angle_deg = 30.0\n\n[drr.carm]",
            "`drr.primary_angle_deg` has no effect beside `[drr.carm]`",
        ),
        (
            "drr_spectrum.toml",
            "[drr]\n",
            "[drr]\nenergy_kev = 70.0\n",
            "`drr.energy_kev` has no effect beside `[drr.spectrum]`",
        ),
    ] {
        let place = Place::new();
        let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples");
        let text = std::fs::read_to_string(examples.join(example)).unwrap();
        assert!(text.contains(from));
        let scene = place.scene(&text.replacen(from, to, 1));
        let done = trabecula(&[&"scene", &"check", &scene]);
        assert_eq!(done.code, Some(0), "{}", done.err);
        assert!(done.out.contains(said), "{}{}", done.out, done.err);
    }
}

/// Every command of such a run was refused, and it ended with 0.
#[test]
fn a_feed_that_the_arm_refuses_is_refused() {
    let place = Place::new();
    let slow = scenes::drill("lockstep", 4.0) + "[arm]\nmax_speed_mm_per_s = 1.0\n";
    for (code, text) in said(&place, &slow) {
        assert_eq!(code, Some(2), "{text}");
        assert!(text.contains("`arm.max_speed_mm_per_s` is 1, expected at least 8"), "{text}");
    }
}

#[test]
fn keys_that_change_nothing_are_warned_of() {
    let place = Place::new();
    let scene = place.scene(
        &(scenes::drill_unseen("lockstep", 4.0)
            + "[arm]\nmodel = \"gantry\"\nholder_length_mm = 30.0\n[[sensor]]\nname = \"joints\"\nrate_hz = 100.0\nencoders = {}\n\
               [[sensor]]\nname = \"field\"\nrate_hz = 100.0\ntracker = { view_deg = 30.0 }\n"),
    );
    let done = trabecula(&[&"scene", &"check", &scene]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    for key in ["arm.holder_length_mm", "sensor.encoders", "sensor.tracker.view_deg"] {
        assert!(done.out.contains(&format!("`{key}` has no effect")), "{key}: {}{}", done.out, done.err);
    }
}

/// No false alarm: every scene of this repository, with its volume where that is at hand.
#[test]
fn no_scene_of_this_repository_is_warned_of() {
    let mut checked = 0;
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let scenes = ["configs", "clients/scenes"].map(|folder| std::fs::read_dir(root.join(folder)).unwrap());
    for entry in scenes.into_iter().flatten() {
        let file = entry.unwrap().path();
        if file.extension().is_none_or(|extension| extension != "toml") {
            continue;
        }
        let scene: Scene = ipc_types::scene_file::load(&file).unwrap();
        let volume = match volume_source::load(&scene, VolumeFiles::default()) {
            Ok(volume) => volume,
            Err(cause) => {
                println!("{}: without its volume ({cause})", file.display());
                None
            }
        };
        let warnings = feasibility::check(&scene, &file.display(), volume.as_ref()).unwrap();
        assert_eq!(warnings, Vec::<String>::new());
        checked += 1;
    }
    assert!(checked > 10, "{checked} scenes");
}
