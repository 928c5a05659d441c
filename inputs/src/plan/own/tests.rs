//! Tables of own tools.

#![allow(clippy::unwrap_used, reason = "tests")]
use std::path::Path;

use ipc_types::scene::ToolDescription;

use super::*;

const SCENE: &str = "name = \"own\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\n\
                     direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname = \"a\"\n\
                     drives = [\"tendon\", \"arm\", \"burr\"]\nhold = { tension_n = 5.0 }\n";

fn scene(more: &str, tool: Option<&str>) -> Scene {
    let mut scene = Scene::parse(&format!("{more}\n{SCENE}"), Path::new("own.toml")).unwrap();
    scene.manipulator.tool = tool.map(|text| ToolDescription::parse(text, Path::new("tool.toml")).unwrap());
    scene
}

#[test]
fn times() {
    for (name, text) in [
        ("rigid", include_str!("../../../../configs/tools/rigid_drill.toml")),
        ("two", include_str!("../../../../configs/tools/two_segments.toml")),
        ("steer", include_str!("../../../../configs/tools/steerable_drill.toml")),
    ] {
        for (more, ext) in [("", false), ("volume = { phantom = \"block\" }", false), ("", true)] {
            let mut scene = scene(more, Some(text));
            if ext {
                scene.controller[0].hold = None;
                scene.controller[0].external = true;
            }
            let began = Instant::now();
            let t = Table::own(&scene, None);
            println!("{name} {more} {ext}: {:.1} s", began.elapsed().as_secs_f64());
            match t {
                Ok(t) => println!("{}", write(&t.rows)),
                Err(e) => println!("{e}"),
            }
        }
    }
}
