//! The DRR process: the X-ray of the crate `xray` on shared memory and this machine.
//!
//! **Boundary:** what a frame shows is computed in [`xray`], and which frames are due is decided in [`process`]; the rest here is
//! ports, threads, the clock and memory.

pub mod machine;
pub mod process;

pub use machine::ThisMachine;
