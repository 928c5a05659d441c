//! Logs in memory, in one test binary: it is linked once, and its tests share both cores.

#[path = "../common/mod.rs"]
mod common;

mod damage;
mod determinism;
mod linear;
mod others;
mod readings;
mod replay;
mod ring;
mod round_trip;
mod schema;
mod segments;
mod words;
