//! Helpers shared by the tests.

pub mod client;
pub mod logs;
pub mod preload;
pub mod program;
pub mod scenes;
pub mod terminal;
