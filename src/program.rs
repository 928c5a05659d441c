//! Starts the project's programs, parses their command lines, and sets their exit codes.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ipc_types::process::{
    EXIT_BAD_INPUT, EXIT_CAUTION, EXIT_FAILED, EXIT_GAP, exit_on_abort, reset_inherited_state,
};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::failure::Failure;
use crate::{printer, say};

/// The command succeeded.
const EXIT_DONE: u8 = 0;

/// Stack of the main thread: the system's usual limit. A smaller inherited one would end the program with
/// SIGSEGV as soon as it is exceeded.
const STACK_BYTES: u64 = 8 << 20;

/// Exit codes, for the help.
pub const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed; 2 bad input; 3 done, but the log has a gap or is incomplete; 4 done, with cautions (run --fail-on caution); 130 interrupted";

/// Runs a program: `parse` reads its command line, `dispatch` executes the command. A command that returns an
/// exit code, as a part of a session does, ends with that code.
pub fn run<C>(
    parse: impl FnOnce() -> Result<C, clap::Error> + Send,
    dispatch: impl FnOnce(C) -> Result<Option<ExitCode>, Failure> + Send,
) -> ExitCode {
    reset_inherited_state();
    with_stack(|| run_on_this_stack(parse, dispatch)).unwrap_or_else(|cause| {
        tell!(
            "trabecula: the stack limit is too low, and no thread with a larger stack can be started \
             ({cause}); raise it with `ulimit -s {}`",
            STACK_BYTES >> 10
        );
        ExitCode::from(EXIT_FAILED)
    })
}

/// Does the work with a stack of at least [`STACK_BYTES`]: of this thread, whose limit the kernel reads when
/// the stack grows, or of another one if the hard limit is lower.
fn with_stack<R: Send>(work: impl FnOnce() -> R + Send) -> std::io::Result<R> {
    let limit = getrlimit(Resource::Stack);
    let raised = Rlimit { current: Some(STACK_BYTES), maximum: limit.maximum };
    if limit.current.is_none_or(|bytes| bytes >= STACK_BYTES) || setrlimit(Resource::Stack, raised).is_ok() {
        return Ok(work());
    }
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("main".to_owned()).stack_size(STACK_BYTES as usize);
        let done = thread.spawn_scoped(scope, work)?.join();
        Ok(done.unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    })
}

fn run_on_this_stack<C>(
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

/// Prepares this process: exceeding the file size limit becomes an error instead of killing the process,
/// running out of memory ends it with an exit code, and cache warnings are printed.
fn start() -> Result<(), Failure> {
    crate::cache::tell_remarks_by(|text| tell!("trabecula: {text}"));
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)))
        .and_then(|_| exit_on_abort(EXIT_FAILED))
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
            if matches!(code, EXIT_DONE | EXIT_GAP | EXIT_CAUTION) { EXIT_FAILED } else { code }
        }
    };
    printer::finish_words();
    code
}
