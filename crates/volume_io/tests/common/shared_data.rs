//! Location of the shared data.

use std::path::{Path, PathBuf};

/// A file or folder of the shared data; prints a message and returns `None` if absent.
pub fn shared(name: &str) -> Option<PathBuf> {
    let root = match std::env::var_os("TRABECULA_SHARED_DATA") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
    };
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("SKIPPED: {} is absent; set TRABECULA_SHARED_DATA to the shared data folder", path.display());
    None
}
