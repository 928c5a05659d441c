//! Runs the points of a study and keeps a row of each.
//!
//! A sweep's folder holds what it is a sweep of, its rows, the logs that it keeps, and a table:
//!
//! | file | what it holds |
//! |---|---|
//! | `study.json` | the study, its table of points, its scene and the build: another study or build is refused |
//! | `rows/0000012.json` | what run 12 gave; written whole, at its end |
//! | `runs/0000012/` | its log, if the study keeps logs |
//! | `table/shard-0-of-1.parquet` | the rows of a shard; the folder is a Parquet dataset |
//!
//! A row is a function of its point and the build, so a sweep that was killed goes on where it was, machines
//! may share a folder, and folders may be joined.

pub mod folder;
mod in_process;
mod launched;
pub mod parquet;
pub mod report;
pub mod row;
pub mod runner;
