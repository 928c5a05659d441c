//! The viewer as Lichtblick sees it: a WebSocket client in Python, Foxglove's published schema, and the layout that is shipped.

use std::path::Path;
use std::process::Command;
use test_support::limited::Limited;

use crate::common::program::Place;
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
        .arg(root.join("viewer_proc/lichtblick-layout.json"))
        .arg(&view.token)
        .limited_output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("ok "), "{said}");
    view.stop();
}
