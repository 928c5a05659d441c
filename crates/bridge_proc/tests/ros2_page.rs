//! Checks that the page lists every topic with its type and quality of service, and every state command.

#![allow(clippy::unwrap_used, reason = "a test")]

use ros_interface::incoming::STATE_COMMANDS;
use ros_interface::topics::{INPUTS, OUTPUTS, Row};

fn row<T>(row: &Row<T>) -> String {
    format!("| `{}` | `{}` | {} | {} |", row.template, row.kind, row.qos.words(), row.meaning)
}

#[test]
fn the_page_lists_every_topic_and_every_state_command() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/ros2.md")).unwrap();
    let mut rows: Vec<String> = OUTPUTS.iter().map(row).collect();
    rows.extend(INPUTS.iter().map(row));
    rows.extend(STATE_COMMANDS.iter().map(|(_, word, meaning)| format!("| `{word}` | {meaning} |")));
    for row in rows {
        assert!(page.contains(&row), "docs/ros2.md lacks the row\n{row}");
    }
}
