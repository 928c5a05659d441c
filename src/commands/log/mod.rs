//! `trabecula log`: inspects logs, and writes logs from logs.

mod cat;
mod dataset;
mod export;
mod foxglove;
mod geometry;
pub(super) mod json;
mod lerobot;
mod make;

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::Subcommand;
use ipc_types::scene::Scene;
use recorder_proc::exit_code::exit_code;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::diff::diff;
use run_log::{LogError, LogInfo, ReadOptions, Verdict, info};

use crate::commands::log_name;
use crate::failure::Failure;
use crate::fmu_controller::replay_note;
use crate::say::{self, Figures, Out};

/// Arguments of `log`.
#[derive(Debug, Subcommand)]
pub enum LogCommand {
    /// Print a summary: scene, build, ticks, topics, sizes, gaps and how the log ends.
    Info {
        /// Log file, or the folder of a run; `latest` is the newest run in `out`.
        #[arg(value_parser = log_name())]
        log: PathBuf,
        #[command(flatten)]
        figures: Figures,
    },
    /// Print messages as JSON lines.
    Cat(cat::CatArguments),
    /// Print the first difference between two logs; exit code 1 if they differ.
    Diff {
        /// Log file, or the folder of a run; `latest` is the newest run in `out`.
        #[arg(value_parser = log_name())]
        first: PathBuf,
        /// Log to compare with.
        #[arg(value_parser = log_name())]
        second: PathBuf,
        #[command(flatten)]
        figures: Figures,
    },
    /// Recover a readable log from a truncated or damaged one, and report what is lost.
    Repair(make::RepairArguments),
    /// Recompress a log, or store it uncompressed; messages are unchanged.
    Compress(make::CompressArguments),
    /// Export a topic as a table (.csv, .parquet), the X-ray frames as PNG files, or tunnel, tool and path as
    /// geometry (.stl, .obj, .vtp, .mrk.json).
    Export(Box<export::ExportArguments>),
    /// Concatenate several complete logs into one file.
    CatFiles(make::CatFilesArguments),
    /// Split a file with several runs into one log per run.
    Split(make::SplitArguments),
}

/// Runs the command.
///
/// # Errors
/// Not a log, or an output that already exists (2); two logs that differ, a damaged log, a full disk (1);
/// done, but the log has a gap, is truncated or was not ended (3).
pub fn run(command: &LogCommand) -> Result<(), Failure> {
    let mut out = say::out();
    match command {
        LogCommand::Info { log, figures } => return told(log, *figures, &mut out),
        LogCommand::Cat(arguments) => cat::run(arguments, &mut out)?,
        LogCommand::Diff { first, second, figures } => return compared([first, second], *figures, &mut out),
        LogCommand::Repair(arguments) => make::repair_log(arguments, &mut out)?,
        LogCommand::Compress(arguments) => make::compress_log(arguments, &mut out)?,
        LogCommand::Export(arguments) => export::run(arguments)?,
        LogCommand::CatFiles(arguments) => make::cat_files_log(arguments, &mut out)?,
        LogCommand::Split(arguments) => make::split_log(arguments, &mut out)?,
    }
    // Output errors are reported when the command ends.
    let _ = out.flush();
    Ok(())
}

/// Prints the summary of a log; for a run's folder, checks both lanes.
fn told(log: &Path, figures: Figures, out: &mut Out<'_>) -> Result<(), Failure> {
    let read = ReadOptions::default();
    let summary = info(&LogFile::at(log_path(log)), read)?;
    let timing = log.join("timing.mcap");
    let lane = if log.is_dir() && timing.exists() { Some(info(&LogFile::at(&timing), read)?) } else { None };
    if figures.json {
        let timing = lane.as_ref().map(json::of_log);
        let _ = writeln!(out, "{}", serde_json::json!({"run": json::of_log(&summary), "timing": timing}));
    } else {
        answered(summary.write(out))?;
        if let Some(note) = fmus(&summary) {
            let _ = writeln!(out, "FMUs        {note}");
        }
        if let Some(lane) = &lane {
            answered(lane.write_misses(out))?;
            if !lane.verdict.is_intact() {
                let _ = writeln!(out, "timing lane {}", lane.verdict);
            }
        }
    }
    let of_lane = lane.map_or(0, |lane| exit_code(&lane.verdict));
    concluded(out, worse(exit_code(&summary.verdict), of_lane))
}

/// Returns how a log replays the FMUs of its scene; `None` without an FMU, or if the scene cannot be read.
fn fmus(log: &LogInfo) -> Option<String> {
    let scene = Scene::parse(&log.header.scene_toml, Path::new("scene.toml")).ok()?;
    replay_note(&scene)
}

/// Prints where two logs first differ.
fn compared(logs: [&PathBuf; 2], figures: Figures, out: &mut Out<'_>) -> Result<(), Failure> {
    let [first, second] = logs.map(|log| LogFile::at(log_path(log)));
    let report = diff(&first, &second, ReadOptions::default())?;
    if figures.json {
        let _ = writeln!(out, "{}", json::of_diff(&report));
    } else {
        answered(report.write(out))?;
    }
    if !report.same_run() {
        // The report has already been printed.
        let _ = out.flush();
        return Err(Failure::failed("the logs differ"));
    }
    let codes = report.verdicts.each_ref().map(exit_code);
    concluded(out, worse(codes[0], codes[1]))
}

/// The more serious of two exit codes: a failure outranks a gap.
fn worse(first: u8, second: u8) -> u8 {
    match (first, second) {
        (0, other) | (other, 0) => other,
        (first, second) => first.min(second),
    }
}

/// Ends a finished command with the exit code of the log's verdict, whose faults have already been printed.
fn concluded(out: &mut Out<'_>, code: u8) -> Result<(), Failure> {
    let _ = out.flush();
    ended_with(code)
}

/// Ends a finished command: prints the log's faults to standard error and returns its exit code.
///
/// # Errors
/// The log is damaged (1), or has a gap, is truncated or was not ended (3).
pub(super) fn judged(log: &Path, verdict: &Verdict) -> Result<(), Failure> {
    if !verdict.is_intact() {
        tell!("trabecula: {}: {verdict}", log.display());
    }
    ended_with(exit_code(verdict))
}

fn ended_with(code: u8) -> Result<(), Failure> {
    match code {
        0 => Ok(()),
        code => Err(Failure { message: "the log is not intact: see its verdict".to_owned(), code }),
    }
}

/// Ignores output errors: a closed pipe is fine, and any other error is reported when the command ends.
fn answered(result: Result<(), LogError>) -> Result<(), Failure> {
    match result {
        Err(LogError::Output { .. }) => Ok(()),
        other => Ok(other?),
    }
}
