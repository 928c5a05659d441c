//! Starting, watching and ending the parts of a run.

pub mod hub;
pub mod part;
pub mod progress;
pub mod run;
mod understudy;
pub mod volume_source;
