//! The baselines against the simulation.
#![allow(clippy::unwrap_used, reason = "a test that cannot build its tool has failed")]

mod defects;
mod methods;
mod position_set;
mod tool;
