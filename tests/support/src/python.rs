//! Python environments with pinned packages.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::limited::Limited;

/// Returns the interpreter of [`environment`]. If it is not available (never in CI), prints the reason
/// prominently.
///
/// # Panics
/// It is not available, in CI.
pub fn or_skip(name: &str, packages: &[&str], probe: &str) -> Option<PathBuf> {
    environment(name, packages, probe)
        .inspect_err(|reason| {
            assert!(std::env::var_os("CI").is_none(), "no {packages:?}: {reason}");
            println!("\n*** SKIPPED: no Python environment with {packages:?}: {reason} ***\n");
        })
        .ok()
}

/// Returns `target/tmp`, where tests keep what they fetch for reuse.
///
/// # Panics
/// The test binary is not in a target folder.
pub fn downloads() -> PathBuf {
    // target/<profile>/deps/<test>
    let program = std::env::current_exe().unwrap();
    let folder =
        program.ancestors().nth(3).expect("a test's program lies in target/<profile>/deps").join("tmp");
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// Returns a virtual environment with exactly these packages in [`downloads`], created once, and again when
/// they change.
///
/// # Errors
/// The reason why it is not available, as printed by the program that failed.
pub fn environment(name: &str, packages: &[&str], probe: &str) -> Result<PathBuf, String> {
    let folder = downloads().join(name);
    // Only one process creates it: tests in several binaries may need the same environment.
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
    // Only imported modules are compiled, on import.
    let quickly = ["install", "-q", "--no-compile", "--retries", "1", "--timeout", "10"];
    said(pip(&python).args(quickly).args(packages))?;
    said(Command::new(&python).args(["-c", &format!("import {probe}")]))?;
    std::fs::write(installed, wanted).map_err(|error| error.to_string())?;
    Ok(python)
}

/// Returns the pip that installs into an environment: its own, or else the machine's. Installing a pip in
/// each environment takes as long as many packages.
pub fn pip(python: &Path) -> Command {
    let own = said(Command::new(python).args(["-c", "import pip"])).is_ok();
    let mut pip = Command::new(if own { python } else { Path::new("python3") });
    pip.args(["-m", "pip"]);
    if !own {
        pip.arg("--python").arg(python);
    }
    pip
}

/// Returns the path of an interpreter's own shared library; prints that it has none.
///
/// # Panics
/// The interpreter does not run.
pub fn shared_library(python: &Path) -> Option<String> {
    let text = "import os, sysconfig; of = sysconfig.get_config_var; print(os.path.join(of('LIBDIR'), of('INSTSONAME')))";
    let output = Command::new(python).args(["-c", text]).limited_output().unwrap();
    let path = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    if path.contains(".so") && Path::new(&path).exists() {
        return Some(path);
    }
    println!("\n*** SKIPPED: {} has no shared library: {path} ***\n", python.display());
    None
}

/// Runs a program; the error is its last line of output.
fn said(command: &mut Command) -> Result<(), String> {
    let output = command.limited_output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stderr);
    if output.status.success() { Ok(()) } else { Err(text.lines().last().unwrap_or_default().to_string()) }
}
