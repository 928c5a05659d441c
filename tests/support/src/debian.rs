//! Programs and libraries of Debian packages, unpacked below the target folder without installing them.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::limited::Limited;
use crate::python::downloads;

/// Returns a program of this name on the `PATH` or in a Debian package, which is fetched and unpacked once.
/// If it is not available, prints the reason prominently.
pub fn program_or_skip(package: &str, program: &str) -> Option<PathBuf> {
    let on_path = std::env::var_os("PATH").and_then(|folders| {
        std::env::split_paths(&folders).map(|folder| folder.join(program)).find(|file| file.is_file())
    });
    let probe = Path::new("usr/bin").join(program);
    let unpack = || unpacked(package, &[package], &probe).map(|folder| folder.join(&probe));
    let found = on_path.map_or_else(unpack, Ok);
    found
        .inspect_err(|reason| {
            println!("\n*** SKIPPED: no {program} (Debian package {package}): {reason} ***\n")
        })
        .ok()
}

/// Returns a library's headers and objects: the folder in which the packages are unpacked as below `/`.
/// `probe` is one of their files. If it is not available, prints the reason prominently.
pub fn library_or_skip(packages: &[&str], probe: &str) -> Option<PathBuf> {
    unpacked(packages.first()?, packages, Path::new(probe))
        .inspect_err(|reason| println!("\n*** SKIPPED: no Debian packages {packages:?}: {reason} ***\n"))
        .ok()
}

fn unpacked(name: &str, packages: &[&str], probe: &Path) -> Result<PathBuf, String> {
    let folder = downloads().join(name);
    // Only one process fetches it: tests in several binaries may need the same package.
    let lock = File::create(downloads().join(format!("{name}.lock"))).map_err(|error| error.to_string())?;
    lock.lock().map_err(|error| error.to_string())?;
    if folder.join(probe).is_file() {
        return Ok(folder);
    }
    for package in packages {
        let fetched = tempfile::tempdir_in(downloads()).map_err(|error| error.to_string())?;
        run(Command::new("apt-get").args(["download", package]).current_dir(fetched.path()))?;
        let archive = archive_in(fetched.path())?;
        run(Command::new("dpkg").arg("-x").arg(archive).arg(&folder))?;
    }
    let found = folder.join(probe);
    if found.is_file() { Ok(folder) } else { Err(format!("the packages have no {}", found.display())) }
}

fn archive_in(folder: &Path) -> Result<PathBuf, String> {
    let mut files = std::fs::read_dir(folder).map_err(|error| error.to_string())?.flatten();
    let file = files.find(|file| file.path().extension().is_some_and(|extension| extension == "deb"));
    file.map(|file| file.path()).ok_or_else(|| "apt-get fetched no package".to_owned())
}

fn run(command: &mut Command) -> Result<(), String> {
    let output = command.limited_output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stderr);
    if output.status.success() { Ok(()) } else { Err(text.lines().last().unwrap_or_default().to_owned()) }
}
