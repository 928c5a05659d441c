//! The command line of `trabecula`.

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use recorder_proc::build_info;

use crate::commands;
use crate::failure::Failure;
use crate::help;
use crate::program;

/// A zero-copy shared-memory co-simulation hub for image-guided bone drilling with a continuum manipulator.
#[derive(Debug, Parser)]
#[command(name = "trabecula", version = build_info::VERSION, about)]
pub struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[command(flatten)]
    User(UserCommand),
    /// Run one part of a session in this process.
    #[command(subcommand)]
    Proc(commands::proc::ProcCommand),
}

#[derive(Debug, Subcommand)]
enum UserCommand {
    /// Run a scene (default: the built-in femur).
    Run(commands::run::RunArguments),
    /// Replay a log by stepping the physics through its recorded commands.
    Replay(commands::replay::ReplayArguments),
    /// Watch and control a running session in the browser, or browse logs on a timeline.
    View(commands::view::ViewArguments),
    /// Connect a running session to other software.
    #[command(subcommand)]
    Bridge(commands::bridge::BridgeCommand),
    /// Drive a running session with a gamepad, a six-axis mouse or pedals.
    #[command(subcommand)]
    Device(commands::device::DeviceCommand),
    /// Write scenes as Functional Mock-up Units (FMI).
    #[command(subcommand)]
    Fmu(commands::fmu::FmuCommand),
    /// Plot log fields over time.
    Plot(commands::plot::PlotArguments),
    /// Inspect, convert and repair logs.
    #[command(subcommand)]
    Log(commands::log::LogCommand),
    /// Sweep a tendon and record the tip position at each level.
    Calibrate(commands::calibrate::CalibrateArguments),
    /// Choose the cheapest settings that meet a scene's tolerance, or measure the error of a finished run.
    Plan(commands::plan::PlanArguments),
    /// Check a scene, or write a built-in one to start from.
    #[command(subcommand)]
    Scene(commands::scene::SceneCommand),
    /// Run a scene many times with varied parameters, and report which ones affect the results.
    #[command(subcommand)]
    Sweep(commands::sweep::SweepCommand),
    /// Fit parameters of scenes to measured files, with their uncertainty.
    Identify(commands::identify::IdentifyArguments),
    /// List this user's running sessions; pause, resume or stop one.
    #[command(subcommand)]
    Session(commands::session::SessionCommand),
    /// Show or clear the cache of volumes and tool tables.
    #[command(subcommand)]
    Cache(commands::cache::CacheCommand),
    /// Show the tool's dimensions.
    #[command(subcommand)]
    Tool(commands::tool::ToolCommand),
    /// Inspect a CT volume, or export the drilled one.
    #[command(subcommand)]
    Volume(commands::volume::VolumeCommand),
    /// Write a synthetic CT volume to a file.
    Phantom(commands::volume::PhantomArguments),
    /// Render X-ray images of a volume to files.
    Drr(Box<commands::drr::DrrArguments>),
    /// Print generated documentation.
    #[command(subcommand)]
    Docs(commands::docs::DocsCommand),
    /// Check which limits of this machine affect real-time runs, what each costs and how to lift it.
    Doctor(commands::doctor::DoctorArguments),
    /// Run a scene on limited cores under competing load, and report why ticks were late.
    Stress(commands::stress::StressArguments),
    /// Run the competing load of a stress test.
    #[command(hide = true)]
    Load(commands::stress::LoadArguments),
}

/// Runs the program.
pub fn main() -> ExitCode {
    program::run(command, |command| match command {
        Command::Proc(part) => commands::proc::run(&part).map(Some),
        Command::User(command) => dispatch(&command).map(|()| None),
    })
}

/// Returns the whole command line; the help of each command includes examples and exit codes.
pub fn command_line() -> clap::Command {
    help::completed(Arguments::command(), help::EXAMPLES)
}

/// Parses the command; without one, defaults to `run` with the built-in scene.
fn command() -> Result<Command, clap::Error> {
    let parsed = |matches: clap::ArgMatches| Arguments::from_arg_matches(&matches).map(|all| all.command);
    match command_line().try_get_matches().and_then(parsed)? {
        Some(command) => Ok(command),
        None => {
            command_line().try_get_matches_from(["trabecula", "run"]).and_then(parsed)?.ok_or_else(|| {
                command_line().error(clap::error::ErrorKind::MissingSubcommand, "expected a command")
            })
        }
    }
}

fn dispatch(command: &UserCommand) -> Result<(), Failure> {
    match command {
        UserCommand::Run(arguments) => commands::run::run(arguments),
        UserCommand::Replay(arguments) => commands::replay::run(arguments),
        UserCommand::View(arguments) => commands::view::run(arguments),
        UserCommand::Bridge(command) => commands::bridge::run(command),
        UserCommand::Device(command) => commands::device::run(command),
        UserCommand::Fmu(command) => commands::fmu::run(command),
        UserCommand::Plot(arguments) => commands::plot::run(arguments),
        UserCommand::Log(command) => commands::log::run(command),
        UserCommand::Calibrate(arguments) => commands::calibrate::run(arguments),
        UserCommand::Plan(arguments) => commands::plan::run(arguments),
        UserCommand::Scene(command) => commands::scene::run(command),
        UserCommand::Sweep(command) => commands::sweep::run(command),
        UserCommand::Identify(arguments) => commands::identify::run(arguments),
        UserCommand::Session(command) => commands::session::run(command),
        UserCommand::Cache(command) => commands::cache::run(command),
        UserCommand::Tool(command) => commands::tool::run(command),
        UserCommand::Volume(command) => commands::volume::run(command),
        UserCommand::Phantom(arguments) => commands::volume::write_phantom(arguments),
        UserCommand::Drr(arguments) => commands::drr::run(arguments),
        UserCommand::Docs(command) => commands::docs::run(command),
        UserCommand::Doctor(arguments) => commands::doctor::run(arguments),
        UserCommand::Stress(arguments) => commands::stress::run(arguments),
        UserCommand::Load(arguments) => commands::stress::disturb(arguments),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use test_support::grammar;

    /// Commands without `--json`: they print text for another program, or write only images, pages or files.
    const WITHOUT_FIGURES: [&str; 24] = [
        "bridge igtl",
        "bridge ros2",
        "device mapping",
        "docs completions",
        "docs install",
        "docs man",
        "docs messages",
        "docs scene",
        "docs schema",
        "fmu drive",
        "log cat",
        "log cat-files",
        "log split",
        "plot",
        "scene init",
        "scene schema",
        "session env",
        "session pause",
        "session resume",
        "session save",
        "session stop",
        "sweep list",
        "sweep plot",
        "view",
    ];

    #[test]
    fn every_command_has_examples_that_it_accepts_and_its_exit_codes_in_its_help() {
        grammar::assert_helpful(&command_line(), &[]);
    }

    #[test]
    fn every_output_is_named_by_o_and_output_and_every_command_with_figures_has_json() {
        grammar::assert_outputs(&command_line());
        assert_eq!(grammar::without_json(&command_line(), &[]), WITHOUT_FIGURES);
    }

    /// clap makes the suggestions, but only with one of its optional features enabled.
    #[test]
    fn a_misspelt_command_or_option_is_answered_with_the_one_that_was_meant() {
        for (words, meant) in [
            (&["trabecula", "rpelay"][..], "'replay'"),
            (&["trabecula", "log", "exprot"], "'export'"),
            (&["trabecula", "run", "--duraton-s", "1"], "'--duration-s'"),
            (&["trabecula", "phantom", "pelvs", "-o", "x"], "'pelvis'"),
        ] {
            let said = command_line().try_get_matches_from(words).unwrap_err().to_string();
            assert!(said.contains(meant), "{said}");
        }
    }
}
