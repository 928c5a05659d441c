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

/// Returns the messages of a whole file, read by the mcap crate's own reader: topic, number, bytes.
pub fn messages(bytes: &[u8]) -> Vec<(String, u32, Vec<u8>)> {
    let read = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    read.map(|m| (m.channel.topic.clone(), m.sequence, m.data.to_vec())).collect()
}
