//! How a command fails: a message and an exit code.

use std::path::Path;

use ipc_types::process::{EXIT_BAD_INPUT, EXIT_FAILED};
use output_file::OutputError;
use run_log::LogError;
use rustix::io::Errno;
use volume_io::VolumeError;

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

/// Whether an error is the machine's: a full or broken disk, or a system limit, which no other argument
/// fixes. Any other system error, such as a missing file or denied permission, is bad input.
fn is_of_the_machine(cause: &std::io::Error) -> bool {
    let faults = [
        Errno::NOSPC,
        Errno::DQUOT,
        Errno::FBIG,
        Errno::IO,
        Errno::NOMEM,
        Errno::MFILE,
        Errno::NFILE,
        Errno::NODEV,
        Errno::STALE,
    ];
    cause.raw_os_error().is_some_and(|code| faults.iter().any(|fault| fault.raw_os_error() == code))
}

impl From<OutputError> for Failure {
    fn from(error: OutputError) -> Failure {
        match &error {
            OutputError::Write { .. } => Failure::failed(error),
            OutputError::Create { source, .. } if is_of_the_machine(source) => Failure::failed(error),
            OutputError::Exists { .. } | OutputError::Create { .. } => Failure::bad_input(error),
        }
    }
}

/// Errors that another argument fixes are bad input; damage and machine faults are not.
impl From<LogError> for Failure {
    fn from(error: LogError) -> Failure {
        match &error {
            LogError::Create { source, .. } | LogError::Open { source, .. } if is_of_the_machine(source) => {
                Failure::failed(error)
            }
            _ if error.is_bad_input() => Failure::bad_input(error),
            _ => Failure::failed(error),
        }
    }
}

impl From<VolumeError> for Failure {
    fn from(error: VolumeError) -> Failure {
        match error {
            VolumeError::Output(error) => Failure::from(error),
            VolumeError::Io { ref source, .. } if is_of_the_machine(source) => Failure::failed(error),
            other => Failure::bad_input(other),
        }
    }
}

impl Failure {
    /// An output folder cannot be created.
    pub fn folder(path: &Path) -> impl FnOnce(std::io::Error) -> Failure + '_ {
        move |source| OutputError::Create { path: path.to_owned(), source }.into()
    }

    /// The same failure, with the name of the scene or file whose content causes it.
    pub fn of(self, file: &dyn std::fmt::Display) -> Failure {
        Failure { message: format!("{file}: {}", self.message), ..self }
    }

    /// The work failed.
    pub fn failed(message: impl ToString) -> Failure {
        Failure { message: message.to_string(), code: EXIT_FAILED }
    }

    /// The system does not let the program handle its signals.
    pub fn signals(cause: std::io::Error) -> Failure {
        Failure::failed(format!("cannot install signal handlers: {cause}"))
    }

    /// A failure or bad input, depending on whether another argument would fix it.
    pub fn by_kind(is_bad_input: bool, message: impl ToString) -> Failure {
        if is_bad_input { Failure::bad_input(message) } else { Failure::failed(message) }
    }

    /// The input is bad; nothing was written.
    pub fn bad_input(message: impl ToString) -> Failure {
        Failure { message: message.to_string(), code: EXIT_BAD_INPUT }
    }
}
