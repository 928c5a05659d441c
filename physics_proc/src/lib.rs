//! The physics process: the hub's tick on shared memory and the machine's clock.
//!
//! **Boundary:** it owns ports, clock, priority and locked memory, and decides nothing: when a tick is made, what is latched and what is
//! published are the [`hub`]'s, the step is the [`simulation`]'s. **Invariant:** whatever the hub sends goes out, in its order, or the
//! process ends with an error. It needs a session, so there is no example here; `hub` and `simulation` have theirs.

pub mod process;
