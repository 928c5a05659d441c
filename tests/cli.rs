//! Command output as files: each page of `tests/cli` is a session in its own folder, which starts as a copy
//! of the folder next to the page. A command's exit code, if not 0, follows `?`; standard output and error
//! follow below; `[..]` matches anything.
//!
//! `SNAPSHOTS=overwrite cargo test --release --test cli` records the current output: review the difference
//! before you commit it.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use test_support::limited::Limited;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn pages() -> PathBuf {
    root().join("tests/cli")
}

/// Returns the output of a command in a folder, with its exit code.
fn said(command: &str, folder: &Path) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_trabecula"));
    let path = [program.parent().unwrap().to_str().unwrap(), &std::env::var("PATH").unwrap()].join(":");
    let configs = root().join("configs");
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("exec 2>&1\n{command}")]).current_dir(folder);
    shell.env("PATH", path).env("CONFIGS", &configs).env("LC_ALL", "C");
    shell.env("XDG_CACHE_HOME", concat!(env!("CARGO_TARGET_TMPDIR"), "/cli-cache"));
    let output = shell.limited_output().unwrap();
    let mut text = String::from_utf8(output.stdout).unwrap();
    for (place, name) in [(folder, "[CWD]"), (&configs, "[CONFIGS]")] {
        text = text.replace(place.to_str().unwrap(), name);
    }
    if !text.is_empty() && !text.ends_with('\n') {
        text.push('\n');
    }
    match output.status.code() {
        Some(0) => text,
        code => format!("? {}\n{text}", code.map_or("a signal".to_owned(), |code| code.to_string())),
    }
}

/// Returns a page with the current output of its commands.
fn played(page: &str, folder: &Path) -> String {
    let (mut now, mut is_output) = (String::new(), false);
    for line in page.lines() {
        if let Some(command) = line.strip_prefix("$ ") {
            let gap = if is_output { "\n" } else { "" };
            now += &format!("{gap}{line}\n{}", said(command, folder));
        }
        is_output = line.starts_with("$ ") || (is_output && line != "```");
        if !is_output {
            now += &format!("{line}\n");
        }
    }
    now
}

fn assert_says(name: &str) {
    let folder = tempfile::tempdir().unwrap();
    let inputs = pages().join(name);
    for input in fs::read_dir(inputs).into_iter().flatten().map(|entry| entry.unwrap()) {
        fs::copy(input.path(), folder.path().join(input.file_name())).unwrap();
    }
    let file = pages().join(format!("{name}.md"));
    let now = played(&fs::read_to_string(&file).unwrap(), folder.path());
    assert!(now.contains("\n$ trabecula "), "{name}: no command");
    let expected = snapbox::Data::read_from(&file, Some(snapbox::data::DataFormat::Text));
    // The backslashes belong to regular expressions here, not to paths.
    snapbox::Assert::new().action_env("SNAPSHOTS").normalize_paths(false).eq(now, expected);
}

/// A test for each page.
macro_rules! pages {
    ($($name:ident)*) => {
        $(#[test]
        fn $name() {
            assert_says(stringify!($name));
        })*

        #[test]
        fn every_page_has_a_test() {
            let pages = fs::read_dir(pages()).unwrap().map(|entry| entry.unwrap().path());
            let pages = pages.filter(|path| path.is_file());
            let mut names: Vec<_> = pages.map(|path| path.file_stem().unwrap().to_owned()).collect();
            names.sort();
            assert_eq!(names, [$(stringify!($name)),*]);
        }
    };
}

pages!(commands drr identifications logs plans scenes sweeps tools volumes);
