//! The generated references, and the layout rules that every message follows.

use std::path::Path;

use ipc_types::messages;
use ipc_types::messages::layout::Description;
use ipc_types::reference::{every_message, message_reference};
use ipc_types::scene::reference::scene_reference;

/// `^(?!.*__)(?!.*_$)[a-z][a-z0-9_]*$`, the rule of the ROS interface language for field names.
fn is_ros_legal(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(allowed)
        && !name.contains("__")
        && !name.ends_with('_')
}

#[test]
fn the_rule_for_names_is_that_of_ros() {
    assert!(["x", "tip_position_m", "t_world_link", "q0"].iter().all(|name| is_ros_legal(name)));
    assert!(!["", "_x", "x_", "a__b", "tipPosition", "0q", "größe"].iter().any(|name| is_ros_legal(name)));
}

#[test]
fn every_field_name_is_ros_legal() {
    for message in every_message() {
        let tail = message.tail.map(|tail| tail.name);
        for name in message.fields.iter().map(|field| field.name).chain(tail) {
            assert!(is_ros_legal(name), "{}.{name} is no ROS field name", message.name);
        }
    }
}

#[test]
fn no_message_has_a_hole() {
    for message in every_message() {
        let mut end = 0;
        for field in message.fields {
            assert_eq!(field.offset, end, "{}: bytes without a field before `{}`", message.name, field.name);
            end += field.size;
        }
        assert_eq!(message.size, end, "{}: bytes without a field at its end", message.name);
    }
}

#[test]
fn every_message_and_field_is_documented() {
    for message in every_message() {
        assert!(!message.doc.trim().is_empty(), "{} has no documentation", message.name);
        for field in message.fields {
            assert!(!field.doc.trim().is_empty(), "{}.{} has no documentation", message.name, field.name);
        }
    }
}

#[test]
fn every_message_stands_in_the_list_once() {
    let all = every_message();
    let count = |wanted: &Description| all.iter().filter(|message| message.name == wanted.name).count();
    assert!(messages::ALL.iter().all(|message| count(message) == 1));
    assert!(all.iter().all(|message| count(message) == 1));
}

fn assert_written(name: &str, generated: &str) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../docs/{name}.md"));
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(
        written == generated,
        "docs/{name}.md is out of date; regenerate it from the repository's root:\n  \
         cargo run --release -- docs {name} > docs/{name}.md"
    );
}

#[test]
fn the_message_reference_is_up_to_date() {
    assert_written("messages", &message_reference());
}

#[test]
fn the_scene_reference_is_up_to_date() {
    // The tool's dimensions follow it; `tests/tool.rs` compares those.
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scene.md");
    let written = std::fs::read_to_string(file).unwrap_or_default();
    let keys = written.split("\n## The tool's dimensions\n").next().unwrap_or_default();
    assert!(
        keys == scene_reference(),
        "docs/scene.md is out of date; regenerate it: cargo run --release -- docs scene > docs/scene.md"
    );
}
