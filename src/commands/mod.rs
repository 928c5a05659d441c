//! The subcommands, one a file.

pub mod bench;
pub mod calibrate;
pub mod chart;
pub mod docs;
pub mod drr;
pub mod log;
pub mod plan;
pub mod proc;
pub mod replay;
pub mod run;
pub mod scene;
pub mod volume;
