//! Starts, watches and ends the parts of a run.

mod ending;
pub mod hub;
pub mod interrupt;
mod log_watch;
pub mod part;
pub mod progress;
mod replacements;
pub mod run;
mod running;
mod subscriptions;

pub use inputs::volume_source;
