//! Libraries that override functions of the C library (`LD_PRELOAD`).

use std::path::{Path, PathBuf};
use std::process::Command;
use test_support::limited::Limited;

/// Compiles a library from `tests/`; the error says why that is not possible.
pub fn library(source: &str) -> Result<PathBuf, String> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(source);
    let library = tempfile::NamedTempFile::with_suffix_in(".so", env!("CARGO_TARGET_TMPDIR")).unwrap();
    let library = library.into_temp_path().keep().unwrap();
    let output = Command::new("cc")
        .args(["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror", "-o"])
        .args([&library, &source])
        .limited_output()
        .map_err(|cause| format!("cc: {cause}"))?;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(library)
}
