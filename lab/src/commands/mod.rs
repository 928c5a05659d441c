//! The laboratory's commands, one per file.

pub mod bench;
pub mod chart;
pub mod reproduce;
