//! Commands of the laboratory, which is a separate program: this one forwards them.

use std::ffi::{OsStr, OsString};
use std::io::ErrorKind;
use std::os::unix::process::CommandExt;
use std::process::Command;

use clap::{Args, Subcommand};

use crate::failure::Failure;

/// The laboratory's program, in this program's folder.
const PROGRAM: &str = "trabecula-lab";

/// A command of the laboratory.
#[derive(Debug, Subcommand)]
pub enum LaboratoryCommand {
    /// Measure what the hub costs on this machine.
    #[command(disable_help_flag = true)]
    Bench(HandedOn),
    /// Run a scene on limited cores beside neighbours, and say why ticks were late.
    #[command(disable_help_flag = true)]
    Stress(HandedOn),
    /// Measure accuracy against speed, as tables and figures.
    #[command(disable_help_flag = true)]
    Chart(HandedOn),
    /// Make the published behaviours again, from low-level rules: tunnel, skiving, deviation, bend.
    #[command(disable_help_flag = true)]
    Reproduce(HandedOn),
}

/// What the laboratory is called with.
#[derive(Debug, Args)]
pub struct HandedOn {
    /// See `--help`, which the laboratory's program answers.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<OsString>,
}

/// Replaces this process with the laboratory's program.
///
/// # Errors
/// The program cannot be started. On success this does not return.
pub fn run(command: &LaboratoryCommand) -> Result<(), Failure> {
    let (name, HandedOn { arguments }) = match command {
        LaboratoryCommand::Bench(words) => ("bench", words),
        LaboratoryCommand::Stress(words) => ("stress", words),
        LaboratoryCommand::Chart(words) => ("chart", words),
        LaboratoryCommand::Reproduce(words) => ("reproduce", words),
    };
    let own = std::env::current_exe()
        .map_err(|cause| Failure::failed(format!("the program's own path: {cause}")))?;
    let program = own.with_file_name(PROGRAM);
    let cause = Command::new(&program).arg(OsStr::new(name)).args(arguments).exec();
    Err(Failure::failed(match cause.kind() {
        ErrorKind::NotFound => format!(
            "`{name}` is a command of {}, which is not there; `cargo build --release` makes it",
            program.display()
        ),
        _ => format!("{}: cannot be started ({cause})", program.display()),
    }))
}
