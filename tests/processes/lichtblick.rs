//! The viewer as seen by Lichtblick: a WebSocket client in Python, Foxglove's published schema, and the
//! shipped layout.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::program::{Place, succeed, trabecula};
use crate::common::scenes;
use crate::languages::output_of;
use crate::view::View;
use test_support::python::or_skip;

const PACKAGES: [&str; 5] = [
    "foxglove-schemas-protobuf==0.4.0",
    "protobuf==7.36.2",
    "mcap==1.6.0",
    "mcap-ros2-support==0.6.0",
    "websockets==17.4",
];

fn python() -> Option<PathBuf> {
    or_skip("lichtblick-1", &PACKAGES, "foxglove_schemas_protobuf, mcap_ros2, websockets")
}

/// Runs a script with what it looks at and the shipped layout; it must succeed and print these words.
fn assert_said(python: &Path, script: &str, seen: &OsStr, more: &[&str], words: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut command = Command::new(python);
    command.arg("-B").arg(root.join("tests/lichtblick").join(script)).arg(seen);
    command.arg(root.join("crates/viewer_proc/lichtblick-layout.json")).args(more);
    let said = output_of(&mut command);
    assert!(said.contains(words), "{said}");
}

#[test]
fn the_layout_shows_what_is_advertised_and_the_scene_has_foxgloves_schema() {
    let Some(python) = python() else { return };
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 0.5));
    let view = View::start(&[&ended.folder], None);
    let url = format!("ws://{}/ws?token={}", view.address, view.token);
    assert_said(&python, "client.py", url.as_ref(), &[&view.token], "ok ");
    view.stop();
}

/// A run's own log opened as a file has no 3D scene: its topics are the messages between the parts, which no
/// 3D panel knows.
#[test]
fn an_exported_file_fills_the_layouts_panels_and_its_poses_are_the_states() {
    let Some(python) = python() else { return };
    let place = Place::new();
    let ended = place.complete(&scenes::drill("lockstep", 1.0));
    let file = place.path("view.mcap");
    succeed(&[&"log", &"export", &ended.folder, &"-o", &file, &"--foxglove", &"--rate", &"50"]);
    assert_said(&python, "file.py", file.as_ref(), &[], "ok 51 states");
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
