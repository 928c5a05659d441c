//! `trabecula log repair|compress|cat-files|split`: commands that write logs from logs.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use ipc_types::process::EXIT_GAP;
use recorder_proc::log_file::log_path;
use recorder_proc::rewritten::{Sizes, cat_files, compress, repair, split};
use run_log::Packing;

use super::{Out, json};
use crate::commands::{Choice, choice, log_name};
use crate::failure::Failure;
use crate::say::Figures;

/// Arguments of `log repair`.
#[derive(Debug, Args)]
pub struct RepairArguments {
    /// Log file, or the folder of a run; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// New log file.
    #[arg(short, long)]
    output: PathBuf,
    #[command(flatten)]
    figures: Figures,
}

/// Repairs a log and reports what is lost.
///
/// # Errors
/// Not a log, no header, or an output that already exists (2); a disk error (1); the log had faults, which
/// the report lists (3).
pub fn repair_log(arguments: &RepairArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let report = repair(&log_path(&arguments.log), &arguments.output)?;
    if arguments.figures.json {
        let _ = writeln!(out, "{}", json::of_repair(&report));
    } else {
        super::answered(report.write(out))?;
    }
    super::concluded(out, if report.was_whole() { 0 } else { EXIT_GAP })
}

/// Values of `--method`: minimum, maximum and default level, and the constructor for a level.
type Method = (u32, u32, u32, fn(u32) -> Packing);

const METHODS: [Choice<Method>; 3] = [
    ("none", "No compression", (0, 0, 0, |_| Packing::None)),
    ("lz4", "LZ4 (fast)", (0, 12, 9, Packing::Lz4)),
    ("zstd", "Zstandard (small files)", (1, 22, 9, Packing::Zstd)),
];

/// Arguments of `log compress`.
#[derive(Debug, Args)]
pub struct CompressArguments {
    /// Log file, or the folder of a run; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// New log file.
    #[arg(short, long)]
    output: PathBuf,
    /// Compression method.
    #[arg(long, value_parser = choice(&METHODS), default_value = "zstd")]
    method: Method,
    /// Compression level: 0 to 12 for lz4, 1 to 22 for zstd.
    #[arg(long)]
    level: Option<u32>,
    #[command(flatten)]
    figures: Figures,
}

/// Recompresses a log.
///
/// # Errors
/// A level out of range, not a log, an output that already exists (2); an incomplete log (1).
pub fn compress_log(arguments: &CompressArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let (lowest, highest, usual, packing) = arguments.method;
    let level = arguments.level.unwrap_or(usual);
    if !(lowest..=highest).contains(&level) {
        return Err(Failure::bad_input(format!("--level is {level}; allowed: {lowest} to {highest}")));
    }
    let Sizes { before, after } = compress(&log_path(&arguments.log), &arguments.output, packing(level))?;
    let share = 100.0 * after as f64 / before.max(1) as f64;
    // Output errors are reported when the command ends.
    let _ = match arguments.figures.json {
        true => writeln!(out, "{}", serde_json::json!({"before_bytes": before, "after_bytes": after})),
        false => writeln!(out, "{before} bytes before, {after} after ({share:.1} %), messages unchanged"),
    };
    Ok(())
}

/// Arguments of `log cat-files`.
#[derive(Debug, Args)]
pub struct CatFilesArguments {
    /// Log files, or folders of runs.
    #[arg(required = true, num_args = 2.., value_parser = log_name())]
    logs: Vec<PathBuf>,
    /// New file. Topics of the first log get the prefix /run1, those of the second /run2, and so on.
    #[arg(short, long)]
    output: PathBuf,
}

/// Concatenates logs into one file.
///
/// # Errors
/// Not a log, an output that already exists (2); an incomplete log (1).
pub fn cat_files_log(arguments: &CatFilesArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let inputs: Vec<PathBuf> = arguments.logs.iter().map(|log| log_path(log)).collect();
    cat_files(&inputs, &arguments.output)?;
    let _ = writeln!(out, "{}: {} runs", arguments.output.display(), inputs.len());
    Ok(())
}

/// Arguments of `log split`.
#[derive(Debug, Args)]
pub struct SplitArguments {
    /// File with several runs, or the folder that contains it as `run.mcap`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// Folder for run1.mcap, run2.mcap and so on.
    #[arg(short, long)]
    output: PathBuf,
}

/// Splits a file of several runs into one log per run.
///
/// # Errors
/// Not a log, the log of a single run, an output that already exists (2); an incomplete file (1).
pub fn split_log(arguments: &SplitArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    for path in split(&log_path(&arguments.log), &arguments.output)? {
        let _ = writeln!(out, "{}", path.display());
    }
    Ok(())
}
