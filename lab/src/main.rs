//! `trabecula-lab`: measures performance and accuracy of the product, and reproduces published results. A
//! separate program, so that `trabecula` stays small; it uses the same library, and starts the parts to be
//! measured from its own executable.

#![cfg_attr(not(test), warn(clippy::print_stdout))]

#[macro_use(say, tell)]
extern crate trabecula;

mod bench;
mod charts;
mod commands;
mod effort;
mod phantom;
mod random;
mod reproduce;
mod sheet;
mod tools;

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use trabecula::commands::bridge::BridgeCommand;
use trabecula::commands::proc::ProcCommand;
use trabecula::commands::run::RunArguments;
use trabecula::commands::stress::{LoadArguments, disturb};
use trabecula::commands::view::ViewArguments;
use trabecula::failure::Failure;
use trabecula::help;
use trabecula::program;

use commands::bench::BenchCommand;
use commands::chart::ChartCommand;
use commands::reproduce::ReproduceArguments;
/// Trabecula's laboratory: benchmarks, accuracy measurements and published results.
#[derive(Debug, Parser)]
#[command(name = "trabecula-lab", version, about)]
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
    /// Measure the hub's overhead on this machine.
    #[command(subcommand)]
    Bench(BenchCommand),
    /// Measure accuracy against computing time; write tables and figures.
    #[command(subcommand)]
    Chart(ChartCommand),
    /// Reproduce published results from low-level rules: tunnel, skiving, deviation, bend, thrust.
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
    /// The bridge of a measured run.
    #[command(subcommand, hide = true)]
    Bridge(BridgeCommand),
}

/// The complete command line, with examples and exit codes in each command's help.
fn command_line() -> clap::Command {
    help::completed(Arguments::command(), EXAMPLES)
}

const EXAMPLES: &str = include_str!("examples.txt");

fn main() -> ExitCode {
    let parse = || {
        let matches = command_line().try_get_matches()?;
        Arguments::from_arg_matches(&matches).map(|arguments| arguments.command)
    };
    program::run(parse, |command| match command {
        Command::Proc(part) => trabecula::commands::proc::run(&part).map(Some),
        Command::User(command) => dispatch(&command).map(|()| None),
    })
}

fn dispatch(command: &UserCommand) -> Result<(), Failure> {
    match command {
        UserCommand::Bench(command) => commands::bench::run(command),
        UserCommand::Chart(command) => commands::chart::run(command),
        UserCommand::Reproduce(arguments) => commands::reproduce::run(arguments),
        UserCommand::Load(arguments) => disturb(arguments),
        UserCommand::Run(arguments) => trabecula::commands::run::run(arguments),
        UserCommand::View(arguments) => trabecula::commands::view::run(arguments),
        UserCommand::Bridge(command) => trabecula::commands::bridge::run(command),
    }
}

#[cfg(test)]
mod tests {
    use test_support::grammar;

    #[test]
    fn every_command_has_examples_that_it_accepts_and_its_exit_codes_in_its_help() {
        grammar::assert_helpful(&crate::command_line(), &[]);
    }

    #[test]
    fn every_output_is_named_by_o_and_output() {
        grammar::assert_outputs(&crate::command_line());
    }

    /// Commands whose figures are tables in the CSV files they write.
    const WITHOUT_FIGURES: [&str; 3] = ["chart drr", "chart physics", "reproduce"];

    #[test]
    fn every_command_that_prints_figures_and_writes_no_table_of_them_has_json() {
        assert_eq!(grammar::without_json(&crate::command_line(), &[]), WITHOUT_FIGURES);
    }

    /// Commands with an output, and the argument that names it.
    const KNOWN: [&str; 7] = [
        "bench soak --output",
        "chart drr --output",
        "chart drr --rungs",
        "chart flexure --output",
        "chart physics --output",
        "chart stability --output",
        "reproduce --output",
    ];

    #[test]
    fn every_command_with_an_output_is_in_the_table_of_the_tests() {
        assert_eq!(test_support::outputs::outputs_of(&crate::command_line()), KNOWN);
    }
}
