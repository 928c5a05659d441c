//! Clocks: which ones the program reads, and a wall clock that steps.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use test_support::limited::Limited;

use crate::common::preload::library;

/// Builds a library that makes the wall clock of a program that preloads it step.
pub fn stepping_clock() -> PathBuf {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| library("faults/clock_step.c")).clone()
}

/// The wall clock of a program that preloads the library is an hour off.
#[test]
fn the_stepping_clock_steps() {
    let library = stepping_clock();
    let seconds = |command: &mut Command| -> i64 {
        let output = command.arg("+%s").limited_output().unwrap();
        String::from_utf8(output.stdout).unwrap().trim().parse().unwrap()
    };
    let off = seconds(Command::new("date").env("LD_PRELOAD", library)) - seconds(&mut Command::new("date"));
    assert!((off.abs() - 3600).abs() < 60, "{off} s");
}

/// Every use of a wall clock in the program's sources, with the reason why a step does no harm.
const WALL_CLOCK: [(&str, &str, &str); 8] = [
    ("src/launcher/run.rs", "Zoned::now", "the name of a run's folder; a name that is taken gets a suffix"),
    ("src/stress/mod.rs", "Zoned::now", "the date in a report"),
    (
        "src/commands/cache.rs",
        "SystemTime",
        "how long ago a file was used, to be shown; one of the future was used just now",
    ),
    (
        "crates/inputs/src/cache/mod.rs",
        "SystemTime",
        "which file was used longest ago and goes first; a wrong one is made again",
    ),
    ("crates/inputs/src/cache/tests.rs", "SystemTime", "times that a test gives to files"),
    ("crates/inputs/src/cache/tests.rs", ".modified()", "a test looks at a file's time"),
    ("crates/recorder_proc/src/log_file.rs", ".modified()", "which log is the newest, for `latest`"),
    ("crates/recorder_proc/src/log_file.rs", "SystemTime", "times that a test gives to files"),
];

/// Loops use the monotonic clock (`Instant`, `CLOCK_MONOTONIC`) only.
#[test]
fn no_loop_reads_the_wall_clock() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut folders: Vec<PathBuf> = [
        "src",
        "lab",
        "crates/inputs/src",
        "ipc_types/src",
        "crates/volume_io/src",
        "crates/voxel_grid/src",
        "crates/counter_random/src",
        "crates/sensors/src",
        "physics_proc/src",
        "crates/xray/src",
        "drr_proc/src",
        "crates/hub/src",
        "crates/simulation/src",
        "crates/scene/src",
        "crates/messages/src",
    ]
    .into_iter()
    .chain(["controller_proc/src", "crates/recorder_proc/src", "crates/viewer_proc/src", "clients/c/src"])
    .map(|folder| root.join(folder))
    .collect();
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let words = [
                "SystemTime",
                "Zoned::now",
                "Timestamp::now",
                "ClockId::Realtime",
                ".modified()",
                "CLOCK_REALTIME",
            ];
            for word in words.iter().filter(|word| text.contains(**word)) {
                found.push((path.strip_prefix(root).unwrap().to_str().unwrap().to_owned(), *word));
            }
        }
    }
    for (file, word) in &found {
        let known = WALL_CLOCK.iter().any(|(known, reads, _)| known == file && reads == word);
        assert!(known, "{file} reads a wall clock: {word}");
    }
    assert_eq!(found.len(), WALL_CLOCK.len(), "{found:?}");
}
