//! The viewer as seen by Lichtblick: a WebSocket client in Python, Foxglove's published schema, and the
//! shipped layout.

use std::path::Path;
use std::process::Command;
use test_support::limited::Limited;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;
use crate::view::View;
use test_support::python::or_skip;

const PACKAGES: [&str; 5] = [
    "foxglove-schemas-protobuf==0.4.0",
    "protobuf==7.36.2",
    "mcap==1.6.0",
    "mcap-ros2-support==0.6.0",
    "websockets==17.4",
];

#[test]
fn the_layout_shows_what_is_advertised_and_the_scene_has_foxgloves_schema() {
    let modules = "foxglove_schemas_protobuf, mcap_ros2, websockets";
    let Some(python) = or_skip("lichtblick-1", &PACKAGES, modules) else { return };
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 0.5));
    let view = View::start(&[&ended.folder], None);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(python)
        .arg("-B")
        .arg(root.join("tests/lichtblick/client.py"))
        .arg(format!("ws://{}/ws?token={}", view.address, view.token))
        .arg(root.join("crates/viewer_proc/lichtblick-layout.json"))
        .arg(&view.token)
        .limited_output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("ok "), "{said}");
    view.stop();
}

/// A run's own log opened as a file has no 3D scene: its topics are the messages between the parts, which no
/// 3D panel knows.
#[test]
fn an_exported_file_fills_the_layouts_panels_and_its_poses_are_the_states() {
    let modules = "foxglove_schemas_protobuf, mcap_ros2, websockets";
    let Some(python) = or_skip("lichtblick-1", &PACKAGES, modules) else { return };
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 1.0));
    let file = place.path("view.mcap");
    let done = trabecula(&[&"log", &"export", &ended.folder, &"-o", &file, &"--foxglove", &"--rate", &"50"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(python)
        .arg("-B")
        .arg(root.join("tests/lichtblick/file.py"))
        .arg(&file)
        .arg(root.join("crates/viewer_proc/lichtblick-layout.json"))
        .limited_output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("ok 51 states"), "{said}");
    // It is not the log of a run, and no command mistakes it for one.
    let info = trabecula(&[&"log", &"info", &file]);
    assert!(info.code != Some(0) && info.err.contains("view.mcap"), "{}{}", info.out, info.err);
    for (words, said) in [
        (["-o", "view.csv", "--foxglove"], "expected a .mcap file"),
        (["-o", "new.mcap", "--rate=5"], "--foxglove"),
    ] {
        let done =
            trabecula(&[&"log", &"export", &ended.folder, &words[0], &place.path(words[1]), &words[2]]);
        assert!(done.code == Some(2) && done.err.contains(said), "{words:?}: {}", done.err);
    }
}
