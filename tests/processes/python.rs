//! The Python package: an environment with it, shared by tests of several languages, and its own tests, run
//! by pytest.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use test_support::limited::Limited;
use test_support::python::{or_skip, pip};

use crate::languages::{built, clients, library};

/// Required by the tests in `clients/python/tests`, and by every test here that needs the package.
const REQUIREMENTS: &str = include_str!("../../clients/python/tests/requirements.txt");
/// For all tests of the package in sequence; only a hang reaches it.
const LIMIT: Duration = Duration::from_secs(1800);

/// Returns the Python of an environment with the wheel, created once per test run, with the libraries and the
/// program built for these tests.
pub fn python() -> Option<PathBuf> {
    static PYTHON: OnceLock<Option<PathBuf>> = OnceLock::new();
    PYTHON.get_or_init(make_python).clone()
}

fn make_python() -> Option<PathBuf> {
    let packages: Vec<&str> = REQUIREMENTS.lines().filter(|line| !line.starts_with('#')).collect();
    let python = or_skip("python-tests", &packages, "pytest, numpy")?;
    let program = Path::new(env!("CARGO_BIN_EXE_trabecula"));
    install_package(
        &python,
        &[
            ("TRABECULA_CLIENT_LIBRARY", &library()),
            ("TRABECULA_SIM_LIBRARY", &native()),
            ("TRABECULA_PROGRAM", program),
        ],
    );
    Some(python)
}

/// The native half of `trabecula.sim`, which cargo builds with the workspace.
fn native() -> PathBuf {
    let native = built().join("deps/libtrabecula_sim.so");
    let hint = "`cargo build --release --workspace` builds it";
    assert!(native.exists(), "{}: not built; {hint}", native.display());
    native
}

/// Installs the package into an environment as the README says, but with prebuilt libraries and program.
/// Unchanged files stay: another test, possibly in another process, may be about to import them.
fn install_package(python: &Path, binaries: &[(&str, &Path)]) {
    let folder = python.ancestors().nth(2).unwrap();
    let lock = fs::File::create(folder.join("package.lock")).unwrap();
    lock.lock().unwrap();
    let installed = folder.join("package.installed");
    let wanted = fingerprint(binaries);
    if fs::read_to_string(&installed).is_ok_and(|there| there == wanted) {
        return;
    }
    let mut install = pip(python);
    install.args(["install", "-q", "--no-deps", "--force-reinstall", "--disable-pip-version-check"]);
    install.arg(env!("CARGO_MANIFEST_DIR")).envs(binaries.iter().copied());
    let done = install.limited_output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    fs::write(installed, wanted).unwrap();
}

/// Returns a fingerprint of the package's sources and of the build outputs that it contains.
fn fingerprint(binaries: &[(&str, &Path)]) -> String {
    let package = clients().join("python");
    let mut sources: Vec<PathBuf> = [package.clone(), package.join("trabecula")]
        .iter()
        .flat_map(|folder| fs::read_dir(folder).unwrap())
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_file())
        .collect();
    sources.push(Path::new(env!("CARGO_MANIFEST_DIR")).join("pyproject.toml"));
    sources.sort();
    let mut hasher = DefaultHasher::new();
    for source in sources {
        (&source, fs::read(&source).unwrap()).hash(&mut hasher);
    }
    for (_, binary) in binaries {
        let facts = fs::metadata(binary).unwrap();
        (binary, facts.len(), facts.modified().unwrap()).hash(&mut hasher);
    }
    format!("{:016x}", hasher.finish())
}

/// A Python contributor runs them alone: `pytest clients/python`.
#[test]
fn the_packages_own_tests_pass() {
    let Some(python) = python() else { return };
    let mut command = Command::new(python);
    command.args(["-m", "pytest", "-ra", "-v", "--durations=20", "-p", "no:cacheprovider", "clients/python"]);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).env("PYTHONUNBUFFERED", "1");
    command.env_remove(SESSION_VARIABLE).env_remove(CONTROLLER_VARIABLE);
    let output = command.output_within(LIMIT).unwrap();
    println!("{}", String::from_utf8_lossy(&output.stdout));
    assert!(output.status.success(), "{}: {}", output.status, String::from_utf8_lossy(&output.stderr));
}
