//! `trabecula`: launches, watches, records and replays image-guided bone drilling across processes.

#[macro_use]
mod say;

mod bench;
mod charts;
mod commands;
mod failure;
mod keeper;
mod launcher;
mod output;
mod plan;
mod replay;
mod report;
mod reproduce;
mod stress;
mod x_ray;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use commands::bench::BenchCommand;
use commands::calibrate::CalibrateArguments;
use commands::chart::ChartCommand;
use commands::docs::DocsCommand;
use commands::doctor::DoctorArguments;
use commands::drr::DrrArguments;
use commands::log::LogCommand;
use commands::plan::PlanArguments;
use commands::plot::PlotArguments;
use commands::proc::ProcCommand;
use commands::replay::ReplayArguments;
use commands::reproduce::ReproduceArguments;
use commands::run::RunArguments;
use commands::scene::SceneCommand;
use commands::stress::{LoadArguments, StressArguments};
use commands::view::ViewArguments;
use commands::volume::{PhantomArguments, VolumeCommand};
use failure::Failure;

const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed; 2 bad input; 3 done, but the log has a gap or is not whole; 130 interrupted";

/// A zero-copy shared-memory co-simulation hub for image-guided bone drilling with a continuum manipulator.
#[derive(Debug, Parser)]
#[command(version, about, after_help = EXIT_CODES)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a scene (the default: the femur).
    Run(RunArguments),
    /// Step the physics through a log's commands again.
    Replay(ReplayArguments),
    /// Watch and steer a running session in the browser, or look at logs on a time line.
    View(ViewArguments),
    /// Draw fields of a log over time.
    Plot(PlotArguments),
    /// Look into logs.
    #[command(subcommand)]
    Log(LogCommand),
    /// Sweep a tendon and write which tension bends the tip to where.
    Calibrate(CalibrateArguments),
    /// Choose the cheapest settings that keep a scene's tolerance; check the error that a run made.
    Plan(PlanArguments),
    /// Check scenes.
    #[command(subcommand)]
    Scene(SceneCommand),
    /// Look into CT volumes.
    #[command(subcommand)]
    Volume(VolumeCommand),
    /// Write a synthetic volume to a file.
    Phantom(PhantomArguments),
    /// Render X-ray frames of a volume to files.
    Drr(Box<DrrArguments>),
    /// Print generated documentation.
    #[command(subcommand)]
    Docs(DocsCommand),
    /// Measure what the hub costs on this machine.
    #[command(subcommand)]
    Bench(BenchCommand),
    /// Run a scene on limited cores beside neighbours, and say why ticks were late.
    Stress(StressArguments),
    /// Say what this machine permits, what that costs, and what would grant it.
    Doctor(DoctorArguments),
    /// Measure accuracy against speed, as tables and figures.
    #[command(subcommand)]
    Chart(ChartCommand),
    /// Make the published behaviours again, from low-level rules: tunnel, skiving, deviation, bend.
    Reproduce(ReproduceArguments),
    /// A neighbour of a stress test.
    #[command(hide = true)]
    Load(LoadArguments),
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
        Command::Replay(arguments) => commands::replay::run(arguments),
        Command::View(arguments) => commands::view::run(arguments),
        Command::Plot(arguments) => commands::plot::run(arguments),
        Command::Log(command) => commands::log::run(command),
        Command::Calibrate(arguments) => commands::calibrate::run(arguments),
        Command::Plan(arguments) => commands::plan::run(arguments),
        Command::Scene(command) => commands::scene::run(command),
        Command::Volume(command) => commands::volume::run(command),
        Command::Phantom(arguments) => commands::volume::write_phantom(arguments),
        Command::Drr(arguments) => commands::drr::run(arguments),
        Command::Docs(command) => commands::docs::run(command),
        Command::Bench(command) => commands::bench::run(command),
        Command::Stress(arguments) => commands::stress::run(arguments),
        Command::Doctor(arguments) => commands::doctor::run(arguments),
        Command::Load(arguments) => commands::stress::disturb(arguments),
        Command::Chart(command) => commands::chart::run(command),
        Command::Reproduce(arguments) => commands::reproduce::run(arguments),
        Command::Proc(command) => match commands::proc::run(command) {
            Ok(code) => return code,
            Err(failure) => Err(failure),
        },
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            tell!("trabecula: {failure}");
            ExitCode::from(failure.code)
        }
    }
}
