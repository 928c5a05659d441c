//! Runs the points of a study and saves a row for each.
//!
//! A sweep's folder contains:
//!
//! | file | contents |
//! |---|---|
//! | `study.json` | the study, its table of points, its scene and the build; others are rejected |
//! | `rows/0000012.json` | results of point 12, written atomically at the end of the run |
//! | `runs/0000012/` | its log, if the study keeps logs |
//! | `table/shard-0-of-1.parquet` | the rows of a shard; the folder is a Parquet dataset |
//!
//! A row is a function of its point and the build, so a killed sweep can be continued, machines can share a
//! folder, and folders can be merged.

pub mod folder;
mod in_process;
mod launched;
pub mod parquet;
pub mod report;
pub mod row;
pub mod runner;
