//! Python with pinned packages.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::limited::Limited;

/// The interpreter of [`environment`]; where there is none (never in CI) the reason is said, loudly.
///
/// # Panics
/// There is none, in CI.
pub fn or_skip(name: &str, packages: &[&str], probe: &str) -> Option<PathBuf> {
    environment(name, packages, probe)
        .inspect_err(|reason| {
            assert!(std::env::var_os("CI").is_none(), "no {packages:?}: {reason}");
            println!("\n*** SKIPPED: no Python environment with {packages:?}: {reason} ***\n");
        })
        .ok()
}

/// `target/tmp`: what tests fetch lies there, is fetched once and reused.
///
/// # Panics
/// The test's own program lies in no target folder.
pub fn downloads() -> PathBuf {
    // target/<profile>/deps/<test>
    let program = std::env::current_exe().unwrap();
    let folder =
        program.ancestors().nth(3).expect("a test's program lies in target/<profile>/deps").join("tmp");
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// A virtual environment with exactly these packages in [`downloads`]: made once, and again when they change.
/// The error is the reason.
///
/// # Errors
/// Why there is none, in the words of the program that failed.
pub fn environment(name: &str, packages: &[&str], probe: &str) -> Result<PathBuf, String> {
    let folder = downloads().join(name);
    // One at a time makes it: tests of several programs may want the same.
    let lock = File::create(downloads().join(format!("{name}.lock"))).map_err(|error| error.to_string())?;
    lock.lock().map_err(|error| error.to_string())?;
    let python = folder.join("bin/python3");
    let (installed, wanted) = (folder.join("packages.installed"), packages.join("\n"));
    if python.exists() && std::fs::read_to_string(&installed).is_ok_and(|there| there == wanted) {
        return Ok(python);
    }
    let folder = folder.to_str().ok_or("a target folder that is not UTF-8")?;
    said(Command::new("python3").args(["-m", "venv", "--clear", "--without-pip", folder]))?;
    if said(pip(&python).arg("--version")).is_err() {
        said(Command::new(&python).args(["-m", "ensurepip", "--default-pip"]))?;
    }
    // Only what is imported is compiled, and then by its import.
    let quickly = ["install", "-q", "--no-compile", "--retries", "1", "--timeout", "10"];
    said(pip(&python).args(quickly).args(packages))?;
    said(Command::new(&python).args(["-c", &format!("import {probe}")]))?;
    std::fs::write(installed, wanted).map_err(|error| error.to_string())?;
    Ok(python)
}

/// The pip that installs into an environment: its own, or else the machine's. A pip for each environment
/// takes as long as many packages.
pub fn pip(python: &Path) -> Command {
    let own = said(Command::new(python).args(["-c", "import pip"])).is_ok();
    let mut pip = Command::new(if own { python } else { Path::new("python3") });
    pip.args(["-m", "pip"]);
    if !own {
        pip.arg("--python").arg(python);
    }
    pip
}

/// Runs a program; the error is the last line that it said.
fn said(command: &mut Command) -> Result<(), String> {
    let output = command.limited_output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stderr);
    if output.status.success() { Ok(()) } else { Err(text.lines().last().unwrap_or_default().to_string()) }
}
