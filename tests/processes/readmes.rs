//! The shell lines in the READMEs of the clients work, as far as the machine has the required tools.
//!
//! Steps that take minutes and are already done are replaced: `cargo build` by the output of cargo for these
//! tests, `pip install` of the package by the environment that the tests of languages share.

use std::fs;
use std::path::Path;
use std::process::Command;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use test_support::limited::Limited;
use test_support::python::downloads;

use crate::common::program::{LIMIT, Place};
use crate::languages::{built, clients, library, zig};
use crate::python::python;

/// Returns the first block of shell lines of a README.
fn shell_lines(language: &str) -> Vec<String> {
    let text = fs::read_to_string(clients().join(language).join("README.md")).unwrap();
    let (_, rest) = text.split_once("```sh\n").unwrap_or_else(|| panic!("{language}: no shell lines"));
    let (block, _) = rest.split_once("```").unwrap();
    block.lines().map(str::to_owned).collect()
}

/// Creates a checkout in which `target/release` contains the build output: links, so that nothing is copied
/// and nothing is written.
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

/// Runs the lines in one shell, as a user would paste them, if their tools are available.
fn pasted(language: &str) -> Option<String> {
    let python = match language {
        "python" => Some(python()?),
        "zig" => Some(zig()?),
        _ => None,
    };
    let place = checkout();
    let mut script = String::from("set -e\n");
    for line in shell_lines(language) {
        match line.as_str() {
            line if line.starts_with("cargo build --release") || line.starts_with("pip install ") => {}
            line => {
                // The client gets its session explicitly, because other tests run theirs at the same time.
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
    Some(out.into_owned())
}

#[test]
fn the_shell_lines_of_every_readme_lead_to_a_running_controller() {
    let mut first: Option<String> = None;
    for language in ["rust", "c", "cpp", "python", "zig"] {
        if let Some(said) = pasted(language) {
            assert!(said.lines().count() >= 5, "{language}: {said}");
            // The same example in every language.
            assert_eq!(*first.get_or_insert_with(|| said.clone()), said, "{language}");
        }
    }
    assert!(first.is_some());
}

/// Returns the page as one script (shell lines unchanged, Python blocks as programs), and the lines that it
/// shows as output.
fn script_of(page: &str) -> (String, Vec<String>) {
    let (mut script, mut shown) = (String::from("set -e\n"), Vec::new());
    for block in page.split("```").skip(1).step_by(2) {
        let (kind, body) = block.split_once('\n').unwrap();
        match kind {
            "sh" => {
                let is_done =
                    |line: &&str| line.starts_with("cargo build ") || line.starts_with("pip install ");
                body.lines().filter(|line| !is_done(line)).for_each(|line| script += &format!("{line}\n"));
            }
            "python" => script += &format!("python3 - <<'END'\n{body}END\n"),
            "text" => shown.extend(body.lines().map(|line| line.trim_end().to_owned())),
            other => panic!("a block of `{other}`, expected sh, python or text"),
        }
    }
    (script, shown)
}

/// A guide that is never executed becomes wrong with the next renaming. Wall-clock times are not compared.
#[test]
fn the_first_hour_goes_as_its_page_says() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (script, shown) = script_of(&fs::read_to_string(root.join("docs/first-hour.md")).unwrap());
    assert!(script.lines().count() > 20 && shown.len() > 8, "{script}{shown:?}");
    let Some(python) = python() else { return };
    let place = checkout();
    std::os::unix::fs::symlink(root.join("configs"), place.path("configs")).unwrap();
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("exec 2>&1\n{script}")]);
    let path = std::env::var("PATH").unwrap();
    shell.env("PATH", format!("{}:{path}", python.parent().unwrap().display()));
    shell.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE).current_dir(place.path(""));
    let output = shell.limited_output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}\n{script}\n{said}", output.status);
    for line in shown {
        assert!(said.contains(&line), "`{line}` is not in:\n{said}");
    }
}
