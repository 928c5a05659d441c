//! Starts the project's programs, parses their command lines, and sets their exit codes.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ipc_types::process::{EXIT_BAD_INPUT, EXIT_FAILED, EXIT_GAP};

use crate::failure::Failure;
use crate::{printer, say};

/// The command succeeded.
const EXIT_DONE: u8 = 0;

/// Exit codes, for the help.
pub const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed; 2 bad input; 3 done, but the log has a gap or is incomplete; 130 interrupted";

/// Runs a program: `parse` reads its command line, `dispatch` executes the command. A command that returns an
/// exit code, as a part of a session does, ends with that code.
pub fn run<C>(
    parse: impl FnOnce() -> Result<C, clap::Error>,
    dispatch: impl FnOnce(C) -> Result<Option<ExitCode>, Failure>,
) -> ExitCode {
    let command = start().and_then(|()| parsed(parse()));
    let code = match command.and_then(|command| command.map_or(Ok(None), dispatch)) {
        Ok(Some(code)) => return code,
        Ok(None) => EXIT_DONE,
        Err(failure) => {
            // An empty message has already been reported.
            if !failure.message.is_empty() {
                tell!("trabecula: {failure}");
            }
            failure.code
        }
    };
    ExitCode::from(with_its_answer(code))
}

/// Prepares this process: exceeding the file size limit becomes an error instead of killing the process, and
/// cache warnings are printed.
fn start() -> Result<(), Failure> {
    crate::cache::tell_remarks_by(|text| tell!("trabecula: {text}"));
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .map(drop)
        .map_err(Failure::signals)
}

/// Returns the parsed command line, or `None` after printing help or the version.
fn parsed<A>(parsed: Result<A, clap::Error>) -> Result<Option<A>, Failure> {
    match parsed {
        Ok(command) => Ok(Some(command)),
        Err(error) => {
            let printed = error.print();
            match error.use_stderr() {
                // clap has already printed the error.
                true => Err(Failure { message: String::new(), code: EXIT_BAD_INPUT }),
                false => {
                    let _ = say::note(printed);
                    Ok(None)
                }
            }
        }
    }
}

/// Returns the exit code of a command that ends with `code`: if its output could not be written, success or a
/// gap becomes a failure.
fn with_its_answer(code: u8) -> u8 {
    let unwritten = printer::finish_answers().or_else(|| say::unwritten().map(str::to_owned));
    let code = match unwritten {
        None => code,
        Some(cause) => {
            tell!("trabecula: cannot write to standard output ({cause}); the command's output is lost");
            if matches!(code, EXIT_DONE | EXIT_GAP) { EXIT_FAILED } else { code }
        }
    };
    printer::finish_words();
    code
}
