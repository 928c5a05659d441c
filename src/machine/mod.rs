//! The machine under a run: its limits (`doctor`), its load during a measurement, and confining a run to part
//! of it.

mod confine;
mod facts;
pub mod memory;
mod watch;

pub use confine::{Confinement, allowed};
pub use facts::{Finding, Grade, MachineFacts, facts};
pub use watch::Machine;
