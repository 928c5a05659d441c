//! Finds the cheapest physics settings whose measured errors meet a scene's tolerance.
//!
//! The errors and costs are those of `table.csv`, which `trabecula chart physics` measures and writes again as
//! `physics-plan.csv`; a test compares a part of it with a fresh measurement.

pub mod check;
mod choice;
mod load;
mod model_error;
pub mod reference;
pub mod table;

pub use choice::resolve;
pub use load::{GENTLE_N, Load, MOST_TENDON_FRICTION, Pull, RAMPED_N};
pub use model_error::ModelError;
pub use table::{Row, Settings, write};

/// The measured table of this build.
pub const TABLE: &str = include_str!("table.csv");
