//! Checks that the page lists everything that the bridge sends and understands.

#![allow(clippy::unwrap_used, reason = "a test")]

use bridge_proc::igtl::{SENT, UNDERSTOOD};

#[test]
fn the_page_lists_every_message() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/slicer.md")).unwrap();
    for (kind, device, meaning) in SENT.iter().chain(&UNDERSTOOD) {
        // "Link01ToRAS and so on": the name alone is code.
        let (name, more) = device
            .split_once(' ')
            .map_or((*device, String::new()), |(name, more)| (name, format!(" {more}")));
        let row = format!("| {kind} | `{name}`{more} | {meaning} |");
        assert!(page.contains(&row), "docs/slicer.md lacks the row\n{row}");
    }
}
