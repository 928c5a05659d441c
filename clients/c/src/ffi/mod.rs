//! The C ABI. `include/trabecula.h` is generated from the declarations here and from the messages.
//!
//! A handle is a number, not an address. Clients live in a table of the thread that connected them, so a
//! wrong, stale or foreign handle, including one inherited by a `fork` child, is detected before anything is
//! accessed. There are no callbacks, and no panic crosses the boundary.

#[macro_use]
mod declare;
mod functions;
mod memory;
mod outcome;
mod table;
mod views;

pub use declare::{CType, Function, View};
pub use functions::*;
pub use outcome::STATUSES;
pub use views::*;
