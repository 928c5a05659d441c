//! The laboratory's commands, one a file.

pub mod bench;
pub mod chart;
pub mod reproduce;
pub mod stress;
