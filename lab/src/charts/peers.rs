//! Runs other programs on the same problems: scripts with pinned packages, each in its own virtual
//! environment.

use std::path::{Path, PathBuf};
use std::process::Command;

use tempfile::TempDir;

use trabecula::failure::Failure;

/// Creates a folder for the scripts' input and results, deleted when the returned value is dropped.
///
/// # Errors
/// It cannot be created.
pub fn new_input(environments: &Path) -> Result<TempDir, Failure> {
    output_file::create_folder(environments)
        .and_then(|()| tempfile::Builder::new().prefix("input-").tempdir_in(environments))
        .map_err(Failure::folder(environments))
}

/// Returns the scripts `NAME.py` of a folder that have their packages in `NAME.txt`, with their names, in
/// order; any other files are shared by the scripts.
///
/// # Errors
/// Bad input: no folder.
pub fn scripts(folder: &Path) -> Result<Vec<(String, PathBuf)>, Failure> {
    let mut scripts: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(|cause| Failure::bad_input(format!("{}: cannot be read ({cause})", folder.display())))?
        .filter_map(|entry| entry.ok().map(|entry| entry.path()))
        .filter(|path| path.extension().is_some_and(|e| e == "py") && path.with_extension("txt").exists())
        .collect();
    scripts.sort();
    let named = |script: PathBuf| {
        let name = script.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        (name, script)
    };
    Ok(scripts.into_iter().map(named).collect())
}

/// Runs a script with its input folder (absolute) as working directory and argument, in an environment below
/// `environments` (absolute) with the packages of the `NAME.txt` next to the script. Returns its output, or
/// the last line of the error.
///
/// # Errors
/// It cannot be installed or run.
pub fn run(script: &Path, name: &str, environments: &Path, input: &Path) -> Result<String, String> {
    let script = std::path::absolute(script).map_err(|cause| cause.to_string())?;
    // Some write logs into their working directory.
    let call = |program: &Path, arguments: &[&std::ffi::OsStr]| {
        let mut command = Command::new(program);
        let output =
            command.args(arguments).current_dir(input).output().map_err(|cause| cause.to_string())?;
        if output.status.success() {
            return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
        }
        let text = String::from_utf8_lossy(&output.stderr);
        Err(text.lines().last().unwrap_or("no message").to_owned())
    };
    let venv = environments.join(format!("venv_{name}"));
    let python = venv.join("bin/python3");
    if !python.exists() {
        call(Path::new("python3"), &["-m".as_ref(), "venv".as_ref(), venv.as_ref()])?;
    }
    let pins = script.with_extension("txt");
    let install = ["-m", "pip", "install", "-q", "--retries", "1", "-r"].map(std::ffi::OsStr::new);
    call(&python, &[&install[..], &[pins.as_ref()]].concat())?;
    call(&python, &[script.as_ref(), input.as_ref()])
}
