//! `trabecula log info|cat|diff`: what people ask of a log.

use std::io::{BufWriter, Write, stdout};
use std::path::PathBuf;

use clap::Subcommand;
use recorder_proc::{CatOptions, LogError, ReadOptions, cat, diff, info};

use super::replay::log_path;
use crate::failure::Failure;

/// What to do with a log.
#[derive(Debug, Subcommand)]
pub enum LogCommand {
    /// Summary: scene, build, ticks, topics, sizes, how it ends.
    Info {
        /// Log file, or the folder of a run.
        log: PathBuf,
    },
    /// Messages as JSON lines.
    Cat {
        /// Log file, or the folder of a run.
        log: PathBuf,
        /// Only this topic (may be repeated).
        #[arg(long = "topic")]
        topics: Vec<String>,
        /// Only this field, such as `t_world_tip.position_m` (may be repeated).
        #[arg(long = "field")]
        fields: Vec<String>,
        /// First tick.
        #[arg(long, default_value_t = 0)]
        from: u64,
        /// Last tick.
        #[arg(long)]
        to: Option<u64>,
    },
    /// First difference between two logs; exit code 1 if there is one.
    Diff {
        /// Log file, or the folder of a run.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
}

/// Runs the command.
///
/// # Errors
/// Not a log (2); two logs that differ (1).
pub fn run(command: &LogCommand) -> Result<(), Failure> {
    let mut out = BufWriter::new(stdout().lock());
    let read = ReadOptions::default();
    match command {
        LogCommand::Info { log } => {
            let summary = info(&log_path(log), read).map_err(Failure::bad_input)?;
            quiet_pipe(summary.write(&mut out))?;
        }
        LogCommand::Cat { log, topics, fields, from, to } => {
            let options = CatOptions {
                topics: topics.clone(),
                fields: fields.clone(),
                first_tick: *from,
                last_tick: *to,
                read,
            };
            quiet_pipe(cat(&log_path(log), &options, &mut out).map(|_ending| ()))?;
        }
        LogCommand::Diff { first, second } => {
            let report = diff(&log_path(first), &log_path(second), read).map_err(Failure::bad_input)?;
            quiet_pipe(report.write(&mut out))?;
            if !report.same_run() {
                // The report has said where.
                let _ = out.flush();
                return Err(Failure::failed("the logs differ"));
            }
        }
    }
    // A reader that has had enough (`| head`) is no failure.
    let _ = out.flush();
    Ok(())
}

fn quiet_pipe(result: Result<(), LogError>) -> Result<(), Failure> {
    match result {
        Err(LogError::Output { source }) if source.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.map_err(Failure::bad_input),
    }
}
