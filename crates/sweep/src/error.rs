//! Errors of reading a study.

use std::path::PathBuf;

use foreign_text::{foreign, foreign_line};
use thiserror::Error;

/// Errors of reading a study.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum StudyError {
    /// Not TOML, an unknown or missing key, or a value of a wrong type.
    #[error("{}, line {line}: {}", .file.display(), foreign_line(.cause))]
    Malformed {
        /// The study's file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong.
        cause: String,
    },
    /// A value out of range.
    #[error("{}: `{key}` is {}, expected {expected}", .file.display(), foreign(.given))]
    Value {
        /// The study's file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// What was given.
        given: String,
        /// What is allowed.
        expected: String,
    },
    /// Conflicting keys, or a missing key that the design needs.
    #[error("{}: `{key}` {}", .file.display(), foreign(.problem))]
    Contradiction {
        /// The study's file.
        file: PathBuf,
        /// Key with its path.
        key: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A malformed table of points.
    #[error("{}, line {line}: {}", .file.display(), foreign_line(.problem))]
    Table {
        /// The table's file.
        file: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong and what is expected.
        problem: String,
    },
}
