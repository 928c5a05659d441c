//! The DRR process: runs the X-ray of the crate `xray` on shared memory and this machine.
//!
//! **Boundary:** [`xray`] computes what a frame shows, and [`delivery::x_ray`] decides which frames are due;
//! the rest here is ports, threads, the clock and memory. **Invariants:** a frame shows one tick and lacks
//! every voxel removed up to it, or is not published; physics never waits for a frame in real time.
//!
//! ```
//! use drr_proc::process::{self, DrrProcessError};
//!
//! // A DRR process without its session says so; `trabecula run` starts it with one.
//! let outcome = process::run("/nowhere".as_ref());
//! assert!(matches!(outcome, Err(DrrProcessError::Scene(_))), "{outcome:?}");
//! ```

mod arm;
pub mod machine;
pub mod process;

pub use arm::arm_model;
pub use machine::ThisMachine;
