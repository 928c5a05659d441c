//! `trabecula`: launches, watches, records and replays image-guided bone drilling across processes.

mod commands;
mod failure;
mod launcher;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use commands::proc::ProcCommand;
use commands::run::RunArguments;
use failure::Failure;

/// A zero-copy shared-memory co-simulation hub for image-guided bone drilling with a continuum manipulator.
#[derive(Debug, Parser)]
#[command(version, about)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a scene (the default: the femur).
    Run(RunArguments),
    /// Run one part of a session in this process.
    #[command(subcommand)]
    Proc(ProcCommand),
}

fn main() -> ExitCode {
    let arguments = match Arguments::parse().command {
        Some(command) => command,
        None => match Arguments::try_parse_from(["trabecula", "run"]).map(|arguments| arguments.command) {
            Ok(Some(command)) => command,
            Ok(None) | Err(_) => return ExitCode::from(ipc_types::process::EXIT_BAD_INPUT),
        },
    };
    let outcome: Result<(), Failure> = match &arguments {
        Command::Run(arguments) => commands::run::run(arguments),
        Command::Proc(command) => commands::proc::run(command),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("trabecula: {failure}");
            ExitCode::from(failure.code)
        }
    }
}
