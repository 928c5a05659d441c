//! The subcommands, one per file.

pub mod bridge;
pub(crate) mod cache;
pub(crate) mod calibrate;
pub(crate) mod device;
pub(crate) mod docs;
pub(crate) mod doctor;
pub(crate) mod drr;
pub(crate) mod fmu;
mod fmu_drive;
mod from_markups;
pub(crate) mod identify;
pub(crate) mod log;
pub(crate) mod plan;
mod plan_path;
pub(crate) mod plot;
pub mod proc;
pub(crate) mod replay;
pub mod run;
pub(crate) mod scene;
pub(crate) mod session;
mod show;
pub mod stress;
pub(crate) mod sweep;
pub(crate) mod tool;
pub mod view;
pub mod view_arm;
mod view_plan;
mod view_run;
pub(crate) mod volume;

use std::path::PathBuf;

use clap::builder::{PathBufValueParser, PossibleValue, PossibleValuesParser, TypedValueParser};
use ipc_types::messages::TickRange;
use recorder_proc::log_file::or_latest;

use crate::failure::Failure;

/// A possible value of an option: its name, its help text and its meaning.
pub type Choice<T> = (&'static str, &'static str, T);

/// Parses the name of a choice.
pub fn choice<T: Clone + Send + Sync + 'static>(
    choices: &'static [Choice<T>],
) -> impl TypedValueParser<Value = T> {
    let names = choices.iter().map(|(name, help, _)| PossibleValue::new(*name).help(*help));
    PossibleValuesParser::new(names).try_map(|given| {
        let chosen = choices.iter().find(|(name, ..)| name.eq_ignore_ascii_case(&given));
        chosen.map(|(.., value)| value.clone()).ok_or("no such value")
    })
}

/// Parses the path of a log, where `latest` is the newest run.
pub(crate) fn log_name() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().map(or_latest)
}

/// Checks that `--from` is not after `--to`.
fn in_order(ticks: TickRange) -> Result<TickRange, Failure> {
    let TickRange { first, last } = ticks;
    match last.filter(|last| *last < first) {
        Some(last) => Err(Failure::bad_input(format!("--to (tick {last}) is before --from (tick {first})"))),
        None => Ok(ticks),
    }
}
