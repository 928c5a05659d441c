//! The physics process: runs the hub's tick on shared memory and the machine's clock.
//!
//! **Boundary:** it owns ports, clock, priority and locked memory, and makes no decisions: the [`hub`] decides when to
//! tick, what to latch and what to publish; the [`simulation`] computes the step. **Invariant:** everything the hub
//! sends is published in order, or the process ends with an error. It needs a session, so there is no example here;
//! `hub` and `simulation` have theirs.

pub mod process;
