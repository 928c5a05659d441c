//! Code shared by the programs `trabecula` and `trabecula-lab`: commands, the launcher of a run, replay,
//! reports.
//!
//! **Boundary:** the laboratory (`lab/`) builds on this crate; nothing here depends on it. **Invariant:**
//! every command prints its result through [`mod@say`], so that a failed write is never reported as success,
//! and text from untrusted files never reaches the terminal unescaped.

#![cfg_attr(not(test), warn(clippy::print_stdout))]

#[macro_use]
pub mod say;

pub mod cli;
pub mod commands;
mod dataset;
pub mod fmu_controller;
pub mod geometry;
pub mod help;
mod identify;
mod keeper;
pub mod launcher;
pub mod machine;
pub mod output;
mod plan_edit;
mod plan_path;
mod planned;
pub mod prediction;
pub mod printer;
pub mod program;
mod redirect_file;
pub mod replay;
pub mod report;
mod scene_picture;
pub mod stress;
mod sweep;
pub mod tool;
mod x_ray;

pub use inputs::{cache, failure, feasibility, plan, scenes};
