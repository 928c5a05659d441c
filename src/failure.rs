//! How a command fails: a message and an exit code.

use ipc_types::process::{EXIT_BAD_INPUT, EXIT_FAILED};
use output_file::OutputError;

/// Why a command did not succeed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// What went wrong, where, and what to do.
    pub message: String,
    /// Exit code of the process.
    pub code: u8,
}

/// Exit code after Ctrl-C, as shells have it: 128 + SIGINT.
pub const EXIT_INTERRUPTED: u8 = 130;

impl From<OutputError> for Failure {
    fn from(error: OutputError) -> Failure {
        match error {
            OutputError::Exists { .. } => Failure::bad_input(error),
            _ => Failure::failed(error.to_string()),
        }
    }
}

impl Failure {
    /// The work failed.
    pub fn failed(message: impl Into<String>) -> Failure {
        Failure { message: message.into(), code: EXIT_FAILED }
    }

    /// The input is bad; nothing was written.
    pub fn bad_input(message: impl ToString) -> Failure {
        Failure { message: message.to_string(), code: EXIT_BAD_INPUT }
    }
}
