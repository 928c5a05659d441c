//! Helpers shared by the tests of several crates.
//!
//! | module | contents |
//! |---|---|
//! | [`debian`] | programs of Debian packages, unpacked once below the target folder |
//! | [`grammar`] | rules for every command: examples, exit codes, `-o`, `--json` |
//! | [`limited`] | programs with a time limit, killed with everything they started |
//! | [`name_space`] | a mount namespace with its own file systems |
//! | [`python`] | virtual environments with pinned packages, created once below the target folder |
//! | [`scenes`] | fragments of scenes |

// Only tests call this crate: a test that cannot continue panics.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

pub mod debian;
pub mod grammar;
pub mod limited;
pub mod name_space;
pub mod outputs;
pub mod python;
pub mod scenes;
