//! The physics process: runs the hub's tick on shared memory and the machine's clock.
//!
//! **Boundary:** owns ports, clock, priority and locked memory, and makes no decisions: the [`hub`] decides
//! when to tick, what to latch and what to publish; the [`simulation`] computes the step. **Invariant:**
//! everything the hub sends is published in order, or the process ends with an error.
//!
//! ```
//! use physics_proc::process::{self, PhysicsError};
//!
//! // A physics process without its session says so; `trabecula run` starts it with one.
//! let outcome = process::run("/nowhere".as_ref());
//! assert!(matches!(outcome, Err(PhysicsError::Scene(_))), "{outcome:?}");
//! ```

pub mod process;
