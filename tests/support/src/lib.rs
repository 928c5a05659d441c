//! What the tests of several crates share.
//!
//! | module | what it holds |
//! |---|---|
//! | [`debian`] | programs of Debian packages, unpacked once below the target folder |
//! | [`grammar`] | what every command of a command line has: examples, exit codes, `-o`, `--json` |
//! | [`limited`] | programs that must end: who exceeds the limit is killed with all it started, and the test says what it waited for |
//! | [`python`] | virtual environments with pinned packages, made once below the target folder |
//! | [`scenes`] | parts of scenes |

// Only tests call this crate: a test that cannot go on panics.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

pub mod debian;
pub mod grammar;
pub mod limited;
pub mod outputs;
pub mod python;
pub mod scenes;
