//! The process of a built-in controller, and the loop that runs any Rust controller.
//!
//! **Boundary:** ports, clock and signals are here; the control laws are in `controllers`.

pub mod process;
