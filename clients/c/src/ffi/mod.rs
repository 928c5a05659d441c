//! The C ABI. `include/trabecula.h` is generated from the declarations here and of the messages.
//!
//! A handle is a number, not an address: a client lives in a table of the thread that connected it, so a wrong, stale or
//! foreign handle is found out before anything is touched, and so is one that a child of `fork` has from its parent. No
//! function calls back, and no panic leaves one.

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
