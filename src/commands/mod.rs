//! The subcommands, one a file.

pub mod bench;
pub mod calibrate;
pub mod chart;
pub mod docs;
pub mod doctor;
pub mod drr;
pub mod log;
pub mod plan;
pub mod plot;
pub mod proc;
pub mod replay;
pub mod reproduce;
pub mod run;
pub mod scene;
pub mod stress;
pub mod view;
pub mod volume;
