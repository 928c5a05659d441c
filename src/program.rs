//! How the project's programs begin, read their command line, and end.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ipc_types::process::{EXIT_BAD_INPUT, EXIT_FAILED, EXIT_GAP};

use crate::failure::Failure;
use crate::{printer, say};

/// Of a command that has done what it was asked for.
const EXIT_DONE: u8 = 0;

/// The exit codes, for the help.
pub const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed; 2 bad input; 3 done, but the log has a gap or is not whole; 130 interrupted";

/// Prepares this process: a file that reaches the process's size limit is an error to tell, not a death.
///
/// # Errors
/// The system refuses the signal handler.
pub fn start() -> Result<(), Failure> {
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .map(drop)
        .map_err(|cause| Failure::failed(format!("signals cannot be handled: {cause}")))
}

/// The command line, once it is parsed; none if it asked for the help or the version, which are printed.
///
/// # Errors
/// Bad input, which has been told.
pub fn parsed<A>(parsed: Result<A, clap::Error>) -> Result<Option<A>, Failure> {
    match parsed {
        Ok(command) => Ok(Some(command)),
        Err(error) => {
            let printed = error.print();
            match error.use_stderr() {
                // It has said what is wrong.
                true => Err(Failure { message: String::new(), code: EXIT_BAD_INPUT }),
                false => {
                    let _ = say::note(printed);
                    Ok(None)
                }
            }
        }
    }
}

/// Says why a command failed, unless that has been said, waits until its answer is written, and gives its exit code.
pub fn end(outcome: Result<(), Failure>) -> ExitCode {
    let code = outcome.map_or_else(told, |()| EXIT_DONE);
    ExitCode::from(with_its_answer(code))
}

/// Says why a command failed, unless that has been said; its exit code.
fn told(failure: Failure) -> u8 {
    if !failure.message.is_empty() {
        tell!("trabecula: {failure}");
    }
    failure.code
}

/// The exit code of a command that ends with `code`, seen with whether its answer has reached anybody.
fn with_its_answer(code: u8) -> u8 {
    let unwritten = printer::finish_answers().or_else(|| say::unwritten().map(str::to_owned));
    let code = match unwritten {
        None => code,
        Some(cause) => {
            tell!(
                "trabecula: standard output: cannot be written ({cause}); what it should have said is lost"
            );
            if matches!(code, EXIT_DONE | EXIT_GAP) { EXIT_FAILED } else { code }
        }
    };
    printer::finish_words();
    code
}
