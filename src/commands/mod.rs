//! The subcommands, one per file.

pub mod bridge;
pub mod cache;
pub mod calibrate;
pub mod docs;
pub mod doctor;
pub mod drr;
pub mod from_markups;
pub mod log;
pub mod plan;
pub mod plot;
pub mod proc;
pub mod replay;
pub mod run;
pub mod scene;
pub mod session;
pub mod show;
pub mod stress;
pub mod sweep;
pub mod tool;
pub mod view;
pub mod view_arm;
pub mod view_plan;
mod view_run;
pub mod volume;

use ipc_types::messages::TickRange;

use crate::failure::Failure;

/// The ticks of `--from` and `--to`.
///
/// # Errors
/// Bad input: the last lies before the first.
fn in_order(ticks: TickRange) -> Result<TickRange, Failure> {
    let TickRange { first, last } = ticks;
    match last.filter(|last| *last < first) {
        Some(last) => Err(Failure::bad_input(format!("--to (tick {last}) is before --from (tick {first})"))),
        None => Ok(ticks),
    }
}
