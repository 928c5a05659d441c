//! The source distribution, as built without a git checkout.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::program::{Place, files_below};
use crate::languages::output_of;

/// Creates the source distribution of some sources with their backend, and unpacks it in a folder.
fn sdist(sources: &Path, folder: &Path) -> PathBuf {
    let script = "import sys, tarfile, build_backend as backend
name = backend.build_sdist(sys.argv[1])
with tarfile.open(f'{sys.argv[1]}/{name}') as archive:
    archive.extractall(sys.argv[1])
print(name.removesuffix('.tar.gz'))";
    let mut command = Command::new("python3");
    command.args(["-c", script]).arg(folder).env("PYTHONPATH", sources.join("clients/python"));
    folder.join(output_of(command.env("PYTHONDONTWRITEBYTECODE", "1")).trim())
}

/// Returns the names of all files below a folder.
fn files(folder: &Path) -> BTreeSet<PathBuf> {
    files_below(folder).into_iter().map(|(name, _)| name).collect()
}

#[test]
fn a_source_distribution_is_the_workspace_and_makes_itself_again() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    if !root.join(".git").exists() {
        println!("\n*** SKIPPED: no checkout of git ***\n");
        return;
    }
    let place = Place::new();
    let sources = sdist(root, &place.path(""));
    let first = files(&sources);
    for file in ["Cargo.lock", "PKG-INFO", "LICENSE-MIT", "configs/femur_curved_drilling.toml", ".ci/run"] {
        assert!(first.contains(Path::new(file)), "no {file}");
    }
    // Cargo agrees that every package is present.
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["metadata", "--offline", "--no-deps", "--format-version", "1"]);
    let metadata: serde_json::Value = serde_json::from_str(&output_of(cargo.current_dir(&sources))).unwrap();
    assert!(metadata["packages"].as_array().unwrap().len() > 25, "{metadata}");
    // It can build itself again without git.
    let again = Place::new();
    assert_eq!(files(&sdist(&sources, &again.path(""))), first);
}
