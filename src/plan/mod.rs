//! Finds the cheapest physics settings whose measured errors meet a scene's tolerance.
//!
//! The errors and costs are those of `table.csv`, which `trabecula chart physics` measures and writes again as
//! `physics-plan.csv`; a test compares a part of it with a fresh measurement.

pub mod check;
mod choice;
pub mod table;

pub use choice::{ModelError, resolve};
pub use table::{Row, Settings, write};

/// The measured table of this build.
pub const TABLE: &str = include_str!("table.csv");
