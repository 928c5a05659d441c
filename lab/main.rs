//! `trabecula-lab`: measures what the product costs, how accurate it is, and how it behaves under stress. A separate
//! program, so that `trabecula` stays small; it uses the same library, and starts the parts to be measured from its
//! own executable.

#![cfg_attr(not(test), warn(clippy::print_stdout))]

#[macro_use(say, tell)]
extern crate trabecula;

mod bench;
mod charts;
mod commands;
mod effort;
mod random;
mod reproduce;
mod stress;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use trabecula::commands::laboratory::about;
use trabecula::commands::proc::ProcCommand;
use trabecula::commands::run::RunArguments;
use trabecula::commands::view::ViewArguments;
use trabecula::failure::Failure;
use trabecula::program::{self, EXIT_CODES};

use commands::bench::BenchCommand;
use commands::chart::ChartCommand;
use commands::reproduce::ReproduceArguments;
use commands::stress::{LoadArguments, StressArguments};
/// Trabecula's laboratory: benchmarks, accuracy measurements and stress tests.
#[derive(Debug, Parser)]
#[command(name = "trabecula-lab", version, about, after_help = EXIT_CODES)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(flatten)]
    User(UserCommand),
    /// One part of a measured run.
    #[command(subcommand, hide = true)]
    Proc(ProcCommand),
}

#[derive(Debug, Subcommand)]
enum UserCommand {
    #[command(subcommand, about = about::BENCH)]
    Bench(BenchCommand),
    #[command(about = about::STRESS)]
    Stress(StressArguments),
    #[command(subcommand, about = about::CHART)]
    Chart(ChartCommand),
    #[command(about = about::REPRODUCE)]
    Reproduce(ReproduceArguments),
    /// The competing load of a stress test.
    #[command(hide = true)]
    Load(LoadArguments),
    /// A measured run.
    #[command(hide = true)]
    Run(RunArguments),
    /// The viewer of a measured run.
    #[command(hide = true)]
    View(ViewArguments),
}

fn main() -> ExitCode {
    let parse = || Arguments::try_parse().map(|arguments| arguments.command);
    program::run(parse, |command| match command {
        Command::Proc(part) => trabecula::commands::proc::run(&part).map(Some),
        Command::User(command) => dispatch(&command).map(|()| None),
    })
}

fn dispatch(command: &UserCommand) -> Result<(), Failure> {
    match command {
        UserCommand::Bench(command) => commands::bench::run(command),
        UserCommand::Stress(arguments) => commands::stress::run(arguments),
        UserCommand::Chart(command) => commands::chart::run(command),
        UserCommand::Reproduce(arguments) => commands::reproduce::run(arguments),
        UserCommand::Load(arguments) => commands::stress::disturb(arguments),
        UserCommand::Run(arguments) => trabecula::commands::run::run(arguments),
        UserCommand::View(arguments) => trabecula::commands::view::run(arguments),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    /// Commands with an output, and the argument that names it. All are in the table of `tests/processes/outputs.rs`,
    /// except `stress`, which creates a folder with a new name, and `chart flexure`, whose folder only holds a Python environment.
    const KNOWN: [&str; 8] = [
        "bench soak --output",
        "chart drr --out",
        "chart drr --rungs",
        "chart flexure --out",
        "chart physics --out",
        "chart stability --out",
        "reproduce --out",
        "stress --output",
    ];

    #[test]
    fn every_command_with_an_output_is_in_the_table_of_the_tests() {
        assert_eq!(test_support::outputs::outputs_of(&crate::Arguments::command()), KNOWN);
    }
}
