//! Errors of scene files.

use std::path::PathBuf;

use foreign_text::{foreign_line, number};
use thiserror::Error;

/// Why a scene is refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SceneError {
    /// The file cannot be read.
    #[error("{file}: cannot be read ({cause})")]
    Unreadable {
        /// Scene file.
        file: PathBuf,
        /// The system's reason.
        cause: String,
    },
    /// Not TOML, an unknown or missing key, or a value of a wrong type.
    #[error("{file}, line {line}: {}", foreign_line(.cause))]
    Malformed {
        /// Scene file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        cause: String,
    },
    /// A number is outside its range.
    #[error("{file}: `{key}` is {}; allowed: {lowest} to {highest}", number(*.value))]
    OutOfRange {
        /// Scene file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// Value given.
        value: f64,
        /// Lowest allowed.
        lowest: f64,
        /// Highest allowed.
        highest: f64,
    },
    /// Keys contradict each other, or a text is not one of the allowed ones.
    #[error("{file}: `{key}` {}", foreign_line(.problem))]
    Invalid {
        /// Scene file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// What is wrong, and what is expected.
        problem: String,
    },
}

impl SceneError {
    /// The same error for the key inside another table.
    pub(crate) fn below(mut self, table: &str) -> SceneError {
        if let SceneError::OutOfRange { key, .. } | SceneError::Invalid { key, .. } = &mut self {
            *key = format!("{table}.{key}");
        }
        self
    }
}
