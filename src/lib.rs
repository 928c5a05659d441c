//! What the programs `trabecula` and `trabecula-lab` are made of: commands, the launcher of a run, replay, reports.
//!
//! **Boundary:** the laboratory (`lab/`) is built on this crate; nothing here knows it, but for the commands that are handed on to it
//! ([`commands::laboratory`]). **Invariant:** every answer of a command goes through [`say`], so that one that could not be written is
//! never called done, and no text of a stranger's file reaches the terminal raw.

#![cfg_attr(not(test), warn(clippy::print_stdout))]

#[macro_use]
pub mod say;

pub mod cli;
pub mod commands;
mod doorway;
pub mod failure;
mod keeper;
pub mod launcher;
pub mod machine;
pub mod output;
pub mod plan;
pub mod printer;
pub mod program;
pub mod replay;
pub mod report;
pub mod scenes;
pub mod x_ray;
