//! Infeasible scenes: `scene check`, `run` and `plan` report the same. The reports themselves:
//! `crates/simulation/tests/physics/feasibility/`.

use std::path::Path;

use ipc_types::scene::Scene;
use trabecula::feasibility;
use trabecula::launcher::volume_source::{self, VolumeFiles};

use crate::common::program::{Place, trabecula};
use crate::common::scenes;

/// Returns the output of the three commands for a scene: exit code and standard error, and for `scene check`
/// also standard output.
fn said(place: &Place, text: &str) -> [(Option<i32>, String); 3] {
    let scene = place.scene(text);
    let check = trabecula(&[&"scene", &"check", &scene]);
    let run = trabecula(&[&"run", &scene, &"--output", &place.path("out"), &"--quiet"]);
    let plan = trabecula(&[&"plan", &scene]);
    [(check.code, check.out + &check.err), (run.code, run.err), (plan.code, plan.err)]
}

#[test]
fn an_unlikely_scene_runs_and_every_command_warns_of_it() {
    let place = Place::new();
    let short = scenes::drill("lockstep", 0.1).replace("rate_hz = 10.0", "rate_hz = 30.0");
    let expected = "warning: PLACE: `drr.rate_hz` is 30, but a frame every 33 ticks of 1 ms is 30.303 Hz"
        .replace("PLACE", &place.path("scene.toml").display().to_string());
    for (code, text) in said(&place, &short) {
        assert_eq!(code, Some(0), "{text}");
        assert!(text.contains(&expected), "{text}");
        assert!(
            text.contains("`run.duration_s` is 0.1, but `controller.curved_drilling` needs 2.5 s"),
            "{text}"
        );
    }
}

/// No false alarm: every scene of this repository, with its volume if available.
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
            Ok(ct) => ct.map(|ct| ct.volume),
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
