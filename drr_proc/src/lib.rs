//! The DRR process: runs the X-ray of the crate `xray` on shared memory and this machine.
//!
//! **Boundary:** [`xray`] computes what a frame shows, and [`process`] decides which frames are due; the rest here is
//! ports, threads, the clock and memory.

pub mod machine;
pub mod process;

pub use machine::ThisMachine;
