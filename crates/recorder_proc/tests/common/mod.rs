//! The toy simulation of `run_log`'s tests, with logs in files.
#![allow(
    clippy::unwrap_used,
    missing_docs,
    unused_imports,
    dead_code,
    reason = "each test file uses a part of this"
)]

use std::path::{Path, PathBuf};

#[path = "../../../run_log/tests/common/mod.rs"]
mod toy;
pub use toy::*;

pub fn save(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}
