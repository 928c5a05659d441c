//! The baselines against the simulation.
#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod defects;
mod methods;
mod position_set;
mod tool;
