//! Python with pinned packages.

use std::path::{Path, PathBuf};
use std::process::Command;

/// The interpreter of [`environment`]; where there is none (never in CI) the reason is said, loudly.
pub fn or_skip(name: &str, packages: &[&str], probe: &str) -> Option<PathBuf> {
    environment(name, packages, probe)
        .inspect_err(|reason| {
            assert!(std::env::var_os("CI").is_none(), "no {packages:?}: {reason}");
            println!("\n*** SKIPPED: no Python environment with {packages:?}: {reason} ***\n");
        })
        .ok()
}

/// A virtual environment with the packages below the target folder; made once. The error is the reason.
pub fn environment(name: &str, packages: &[&str], probe: &str) -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let python = folder.join("bin/python3");
    let run = |program: &Path, arguments: &[&str]| -> Result<(), String> {
        let output = Command::new(program).args(arguments).output().map_err(|error| error.to_string())?;
        let text = String::from_utf8_lossy(&output.stderr);
        if output.status.success() {
            Ok(())
        } else {
            Err(text.lines().last().unwrap_or_default().to_string())
        }
    };
    if run(&python, &["-c", &format!("import {probe}")]).is_ok() {
        return Ok(python);
    }
    run(Path::new("python3"), &["-m", "venv", folder.to_str().unwrap()])?;
    let mut install = vec!["-m", "pip", "install", "-q", "--retries", "1", "--timeout", "10"];
    install.extend(packages);
    run(&python, &install)?;
    Ok(python)
}
