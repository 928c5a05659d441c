//! `trabecula log cat`: prints messages as JSON lines.

use std::path::PathBuf;

use clap::Args;
use ipc_types::messages::{Tick, TickRange};
use recorder_proc::exit_code::exit_code;
use recorder_proc::log_file::{LogFile, log_path};
use run_log::ReadOptions;
use run_log::cat::{CatOptions, CatSummary, cat};

use super::{Out, answered, concluded};
use crate::commands::{in_order, log_name};
use crate::failure::Failure;

/// Arguments of `log cat`.
#[derive(Debug, Args)]
pub struct CatArguments {
    /// Log file, or the folder of a run; `latest` is the newest run in `out`.
    #[arg(value_parser = log_name())]
    log: PathBuf,
    /// Only this topic (may be repeated); chunks without it are not read.
    #[arg(long = "topic")]
    topics: Vec<String>,
    /// Only this field, such as `t_world_tip.position_m` (may be repeated).
    #[arg(long = "field")]
    fields: Vec<String>,
    /// First tick.
    #[arg(long, default_value_t = 0)]
    from: u64,
    /// Last tick (inclusive).
    #[arg(long)]
    to: Option<u64>,
    /// First simulated time in seconds.
    #[arg(long, default_value_t = 0.0)]
    from_s: f64,
    /// Last simulated time in seconds (inclusive).
    #[arg(long)]
    to_s: Option<f64>,
}

/// Runs the command.
///
/// # Errors
/// Not a log, unknown field or topic (2); a damaged log (1), after printing the messages before the damage; a
/// log that has a gap, is truncated or was not ended (3).
pub fn run(arguments: &CatArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let options = CatOptions {
        topics: arguments.topics.clone(),
        fields: arguments.fields.clone(),
        ticks: in_order(TickRange { first: Tick(arguments.from), last: arguments.to.map(Tick) })?,
        first_ns: nanoseconds("--from-s", arguments.from_s)?,
        last_ns: arguments.to_s.map(|time_s| nanoseconds("--to-s", time_s)).transpose()?,
        read: ReadOptions::default(),
    };
    let log = log_path(&arguments.log);
    let CatSummary { messages, last_tick, verdict } = match cat(&LogFile::at(&log), &options, out) {
        Ok(written) => written,
        Err(error) => return answered(Err(error)),
    };
    if let Some(last) = last_tick.filter(|_| messages == 0) {
        let log = log.display();
        tell!(
            "trabecula: {log}: no messages in this range; the last message on these topics is at tick {}",
            last.0
        );
    }
    if !verdict.is_intact() {
        tell!("trabecula: {}: {verdict}", log.display());
    }
    concluded(out, exit_code(&verdict))
}

fn nanoseconds(option: &str, time_s: f64) -> Result<u64, Failure> {
    if (0.0..=1e9).contains(&time_s) {
        return Ok((time_s * 1e9 + 0.5) as u64);
    }
    Err(Failure::bad_input(format!("{option} is {time_s}; allowed: 0 to 1e9")))
}
