//! `trabecula`: launches, watches, records and replays image-guided bone drilling across processes.

#![cfg_attr(not(test), warn(clippy::print_stdout))]

#[macro_use]
mod say;

mod bench;
mod charts;
mod commands;
mod doorway;
mod failure;
mod keeper;
mod launcher;
mod output;
mod plan;
mod printer;
mod replay;
mod report;
mod reproduce;
mod scenes;
mod stress;
mod x_ray;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::error::ErrorKind;
use clap::{CommandFactory, Parser, Subcommand};
use ipc_types::process::{EXIT_BAD_INPUT, EXIT_FAILED, EXIT_GAP};

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

/// Of a command that has done what it was asked for.
const EXIT_DONE: u8 = 0;

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
    // A file that reaches the process's size limit is an error to tell, not a death.
    let heard = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)));
    let outcome = heard
        .map_err(|cause| Failure::failed(format!("signals cannot be handled: {cause}")))
        .and_then(|_| command());
    let outcome = match outcome {
        // A part says nothing here, and may end as a program that is not ours does.
        Ok(Some(Command::Proc(part))) => match commands::proc::run(&part) {
            Ok(code) => return code,
            Err(failure) => Err(failure),
        },
        Ok(Some(command)) => obey(&command),
        Ok(None) => Ok(()),
        Err(failure) => Err(failure),
    };
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

/// What is asked for; none if that was the help or the version.
fn command() -> Result<Option<Command>, Failure> {
    let parsed = Arguments::try_parse().and_then(|arguments| match arguments.command {
        Some(command) => Ok(command),
        None => {
            let run = Arguments::try_parse_from(["trabecula", "run"])?.command;
            run.ok_or_else(|| Arguments::command().error(ErrorKind::MissingSubcommand, "expected a command"))
        }
    });
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

/// Does what is asked for.
fn obey(command: &Command) -> Result<(), Failure> {
    match command {
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
        Command::Proc(command) => commands::proc::run(command).map(|_| ()),
    }
}
