//! The recorder and logs in files, in one test binary: it is linked once, and its tests share both cores.

#[path = "../common/mod.rs"]
mod common;

mod background;
mod ecosystem;
mod join;
mod log_file;
mod python;
mod repair;
mod ring_files;
mod tables;
mod verdict;
