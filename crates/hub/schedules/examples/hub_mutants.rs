//! Builds each deliberately broken version of the hub and runs the schedules until one fails.
//!
//! `cargo run --release -p hub_schedules --example hub_mutants [-- PART OF A NAME]`: exits with 1 if a mutant
//! survives ten thousand seeds.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use hub_schedules::mutants::{MUTANTS, Mutant};
use serde_json::Value;
use test_support::limited::Limited;

/// Number of seeds within which each mutant must be found.
const SEEDS: u64 = 10_000;

fn main() -> ExitCode {
    let wanted = std::env::args().nth(1).unwrap_or_default();
    match try_all(&wanted) {
        Ok(0) => ExitCode::SUCCESS,
        Ok(survivors) => {
            println!("{survivors} survived");
            ExitCode::FAILURE
        }
        Err(cause) => {
            eprintln!("hub_mutants: {cause}");
            ExitCode::FAILURE
        }
    }
}

/// Tries the mutants whose name contains a text; returns how many survived.
fn try_all(wanted: &str) -> Result<usize, Box<dyn Error>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..").canonicalize()?;
    let place = root.join("target/hub_mutants");
    copy_workspace(&root, &place)?;
    let mut survivors = 0;
    for mutant in MUTANTS.iter().filter(|mutant| mutant.name.contains(wanted)) {
        let found = try_one(mutant, &root, &place)?;
        survivors += usize::from(found.is_none());
        println!("{}: {}", mutant.name, found.unwrap_or_else(|| format!("SURVIVED {SEEDS} seeds")));
    }
    Ok(survivors)
}

/// Copies what the simulator needs into a separate workspace.
fn copy_workspace(root: &Path, place: &Path) -> Result<(), Box<dyn Error>> {
    let folders = needed_folders(root)?;
    for folder in &folders {
        let target = place.join(folder);
        std::fs::create_dir_all(&target)?;
        copy_changed(&root.join(folder).join("Cargo.toml"), &target.join("Cargo.toml"))?;
        copy_folder(&root.join(folder).join("src"), &target.join("src"))?;
    }
    let manifest = std::fs::read_to_string(root.join("Cargo.toml"))?;
    let (head, _) = manifest.split_once("\n[package]\n").ok_or("Cargo.toml has no [package]")?;
    let (_, rest) = head.split_once("resolver").ok_or("Cargo.toml has no resolver")?;
    let members = folders.iter().map(|folder| format!("{folder:?}")).collect::<Vec<_>>().join(", ");
    std::fs::write(place.join("Cargo.toml"), format!("[workspace]\nmembers = [{members}]\nresolver{rest}"))?;
    std::fs::copy(root.join("Cargo.lock"), place.join("Cargo.lock"))?;
    Ok(())
}

/// Returns the folders of the simulator's crate and of every workspace crate that it depends on, from the
/// manifests.
fn needed_folders(root: &Path) -> Result<Vec<String>, Box<dyn Error>> {
    let output = Command::new(cargo())
        .args(["metadata", "--offline", "--locked", "--no-deps", "--format-version", "1"])
        .current_dir(root)
        .limited_output()?;
    if !output.status.success() {
        return Err(format!("cargo metadata: {}", String::from_utf8_lossy(&output.stderr)).into());
    }
    let metadata: Value = serde_json::from_slice(&output.stdout)?;
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let packages: BTreeMap<String, Value> = list(&metadata["packages"])
        .into_iter()
        .map(|package| (package["name"].to_string(), package))
        .collect();
    let mut folders: Vec<String> = Vec::new();
    let mut open = vec![Value::from("hub_schedules").to_string()];
    while let Some(name) = open.pop() {
        let package = packages.get(&name).ok_or_else(|| format!("the workspace has no crate {name}"))?;
        let manifest = Path::new(package["manifest_path"].as_str().unwrap_or_default());
        let folder = manifest.parent().unwrap_or(manifest).strip_prefix(root)?.to_string_lossy().into_owned();
        if folders.contains(&folder) {
            continue;
        }
        folders.push(folder);
        let within =
            list(&package["dependencies"]).into_iter().filter(|dependency| dependency["path"].is_string());
        open.extend(within.map(|dependency| dependency["name"].to_string()));
    }
    Ok(folders)
}

fn cargo() -> String {
    std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned())
}

/// Copies what has changed, and removes what an earlier copy has and the source no longer has.
fn copy_folder(from: &Path, to: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(to)?;
    for entry in std::fs::read_dir(to)? {
        let path = entry?.path();
        match path.file_name().map(|name| from.join(name)) {
            Some(source) if source.is_dir() == path.is_dir() && source.exists() => {}
            _ if path.is_dir() => std::fs::remove_dir_all(&path)?,
            _ => std::fs::remove_file(&path)?,
        }
    }
    for entry in std::fs::read_dir(from)? {
        let path: PathBuf = entry?.path();
        let Some(name) = path.file_name() else { continue };
        match path.is_dir() {
            true => copy_folder(&path, &to.join(name))?,
            false => copy_changed(&path, &to.join(name))?,
        }
    }
    Ok(())
}

/// Leaves unchanged files alone, so that they keep the time by which cargo decides what to rebuild.
fn copy_changed(from: &Path, to: &Path) -> std::io::Result<()> {
    let text = std::fs::read(from)?;
    if std::fs::read(to).ok().as_ref() == Some(&text) { Ok(()) } else { std::fs::write(to, text) }
}

/// Builds one mutant and plays the schedules; returns how it was found.
fn try_one(mutant: &Mutant, root: &Path, place: &Path) -> Result<Option<String>, Box<dyn Error>> {
    let (source, target) = (root.join("crates").join(mutant.file), place.join("crates").join(mutant.file));
    let right = std::fs::read_to_string(source)?;
    if right.matches(mutant.right).count() != 1 {
        return Err(
            format!("{}: the text of mutant `{}` must occur exactly once", mutant.file, mutant.name).into()
        );
    }
    std::fs::write(&target, right.replace(mutant.right, mutant.wrong))?;
    let built = Command::new(cargo())
        .args(["build", "--release", "--offline", "--quiet", "-p", "hub_schedules", "--bin", "hub_schedules"])
        .env("RUSTFLAGS", "-Awarnings")
        // Most mutants are found within a hundred seeds, so a build that takes seconds saves more than a fast
        // program.
        .env("CARGO_INCREMENTAL", "1")
        .env("CARGO_PROFILE_RELEASE_OPT_LEVEL", "1")
        .env("CARGO_PROFILE_RELEASE_DEBUG", "0")
        .env("CARGO_TARGET_DIR", place.join("target"))
        .current_dir(place)
        .limited_output()?;
    if !built.status.success() {
        let cause = String::from_utf8_lossy(&built.stderr).into_owned();
        return Err(format!("`{}` does not compile:\n{cause}", mutant.name).into());
    }
    // A hub that never returns is found too: by the limit, with a panic that reports it.
    let played = Command::new(place.join("target/release/hub_schedules"))
        .args(["--count", &SEEDS.to_string()])
        .limited_output()?;
    std::fs::write(target, right)?;
    let text = String::from_utf8_lossy(&played.stdout);
    Ok((!played.status.success()).then(|| text.lines().next().unwrap_or_default().to_owned()))
}
