//! The shell lines in the READMEs of the clients do what they say, as far as the machine has their tools.
//!
//! What takes minutes and is done already is replaced: `cargo build` by what cargo has built for these tests, `pip install`
//! of the package by the environment that the tests of languages share.

use std::fs;
use std::process::Command;
use test_support::limited::Limited;
use test_support::python::downloads;

use crate::common::program::{LIMIT, Place};
use crate::languages::{ZIG, built, clients, environment_with, library, python};

/// The first block of shell lines of a README.
fn shell_lines(language: &str) -> Vec<String> {
    let text = fs::read_to_string(clients().join(language).join("README.md")).unwrap();
    let (_, rest) = text.split_once("```sh\n").unwrap_or_else(|| panic!("{language}: no shell lines"));
    let (block, _) = rest.split_once("```").unwrap();
    block.lines().map(str::to_owned).collect()
}

/// A checkout in which `target/release` holds what is built: links, so that nothing is copied and nothing is written.
fn checkout() -> Place {
    let place = Place::new();
    let link = |from: &std::path::Path, to: &str| std::os::unix::fs::symlink(from, place.path(to)).unwrap();
    link(&clients(), "clients");
    fs::create_dir_all(place.path("target/release")).unwrap();
    link(std::path::Path::new(env!("CARGO_BIN_EXE_trabecula")), "target/release/trabecula");
    link(&library(), "target/release/libtrabecula_client.so");
    link(&built().join("examples"), "target/release/examples");
    place
}

/// Runs the lines in one shell, as a user would paste them; the error is the reason why they cannot be run here.
fn pasted(language: &str) -> Result<String, String> {
    let python = match language {
        "python" => Some(python()?),
        "zig" => Some(environment_with(ZIG, "ziglang")?),
        _ => None,
    };
    let place = checkout();
    let mut script = String::from("set -e\n");
    for line in shell_lines(language) {
        match line.as_str() {
            line if line.starts_with("cargo build --release") || line.starts_with("pip install ") => {}
            line => {
                // Its session is told to the client, because other tests run theirs at the same time.
                let line = line.replace("free_space.toml &", "free_space.toml > said 2>&1 &\nRUN=$!");
                script += &format!("{line}\n");
                if line.contains("RUN=$!") {
                    script += "until TRABECULA_SESSION=$(sed -n 's/^session //p' said) && [ -n \"$TRABECULA_SESSION\" ]; do sleep 0.05; done\n\
                               export TRABECULA_SESSION\n";
                }
            }
        }
    }
    script += "wait $RUN\n";
    let mut shell = Command::new("timeout");
    shell.args([&LIMIT.as_secs().to_string(), "sh", "-c", &script]).current_dir(place.path(""));
    if let Some(python) = python {
        let path = std::env::var("PATH").unwrap();
        shell.env("PATH", format!("{}:{path}", python.parent().unwrap().display()));
        let cache = downloads().join("zig-cache");
        shell.env("ZIG_GLOBAL_CACHE_DIR", &cache).env("ZIG_LOCAL_CACHE_DIR", &cache);
    }
    let output = shell.limited_output().unwrap();
    let (out, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{language}: {}\n{script}\n{out}\n{error}", output.status);
    Ok(out.into_owned())
}

#[test]
fn the_shell_lines_of_every_readme_lead_to_a_running_controller() {
    let mut first: Option<String> = None;
    for language in ["rust", "c", "cpp", "python", "zig"] {
        match pasted(language) {
            Ok(said) => {
                assert!(said.lines().count() >= 5, "{language}: {said}");
                // The same example in every language.
                assert_eq!(*first.get_or_insert_with(|| said.clone()), said, "{language}");
            }
            Err(reason) => println!("\n*** SKIPPED {language}: {reason} ***\n"),
        }
    }
    assert!(first.is_some());
}
