//! The process of a built-in controller, and the loop in which any Rust controller runs.
//!
//! **Boundary:** ports, clock and signals are here; what a controller does is in `controllers`.

pub mod process;
