//! The process of a built-in controller, and the loop that runs any Rust controller.
//!
//! **Boundary:** ports, clock and signals are here; the control laws are in `controllers`, which does not
//! know sessions. **Invariants:** one command per state, numbered without gaps; the loop ends with its
//! session, however that ends.
//!
//! ```
//! use controller_proc::process::{self, ControllerError};
//!
//! // A controller process without its session says so; `trabecula run` starts it with one.
//! let outcome = process::run("/nowhere".as_ref(), "reference");
//! assert!(matches!(outcome, Err(ControllerError::Scene(_))), "{outcome:?}");
//! ```

pub mod process;
