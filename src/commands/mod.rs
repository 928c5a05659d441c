//! The subcommands, one a file.

pub mod proc;
pub mod run;
