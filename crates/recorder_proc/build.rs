//! Provides the crate's target, its compiler, and a hash of all source code that decides a tick. They go into
//! every log's header, so that a log of another build is rejected with that build's name.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use sha2::{Digest, Sha256};

/// Sources that decide a tick, relative to this crate's folder.
const SOURCES: [&str; 9] = [
    "../simulation/src",
    "../hub/src",
    "../messages/src",
    "../scene/src",
    "../voxel_grid/src",
    "../counter_random/src",
    "../sensors/src",
    "../volume_io/src",
    "../../Cargo.lock",
];

fn main() {
    let target = std::env::var("TARGET").unwrap_or_default();
    let compiler = std::env::var("RUSTC").unwrap_or_else(|_| "rustc".to_string());
    let version = Command::new(compiler).arg("--version").output();
    let version = version.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_string());
    println!("cargo::rustc-env=TRABECULA_TARGET={target}");
    println!("cargo::rustc-env=TRABECULA_RUSTC={}", version.unwrap_or_default());
    println!("cargo::rustc-env=TRABECULA_SOURCE={}", source_hash());
    println!("cargo::rerun-if-changed=build.rs");
    SOURCES.iter().for_each(|source| println!("cargo::rerun-if-changed={source}"));
}

/// Returns the first 12 hexadecimal digits of the SHA-256 of all names and contents, in order of the names.
fn source_hash() -> String {
    let mut files = Vec::new();
    SOURCES.iter().for_each(|source| collect(Path::new(source), &mut files));
    files.sort();
    let mut hasher = Sha256::new();
    for file in files {
        hasher.update(file.to_string_lossy().as_bytes());
        hasher.update(fs::read(&file).unwrap_or_default());
    }
    hasher.finalize().iter().take(6).map(|byte| format!("{byte:02x}")).collect()
}

fn collect(path: &Path, files: &mut Vec<PathBuf>) {
    match fs::read_dir(path) {
        Ok(entries) => entries.flatten().for_each(|entry| collect(&entry.path(), files)),
        Err(_) => files.push(path.to_owned()),
    }
}
