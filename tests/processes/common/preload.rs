//! Libraries that override functions of the C library (`LD_PRELOAD`).

use std::path::{Path, PathBuf};
use std::process::Command;
use test_support::limited::Limited;

/// Compiles a library from `tests/`.
pub fn library(source: &str) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(source);
    let library = tempfile::NamedTempFile::with_suffix_in(".so", env!("CARGO_TARGET_TMPDIR")).unwrap();
    let library = library.into_temp_path().keep().unwrap();
    let output = Command::new("cc")
        .args(["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror", "-o"])
        .args([&library, &source])
        .limited_output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    library
}
