//! The machine under a run: what it permits (`doctor`), what it did meanwhile, and how to confine a run to a
//! part of it.

mod confine;
mod facts;
mod watch;

pub use confine::{Confinement, allowed};
pub use facts::{Finding, Grade, MachineFacts, facts};
pub use watch::Machine;
