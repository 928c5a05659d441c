//! How errors are measured: runs in this process beside the reference that gets the same commands, on trials
//! in free space and in bone.
//!
//! The built-in table of the standard tool (`trabecula-lab chart physics`), the tables of scenes' own tools
//! and the random scenes of `trabecula-lab chart promise` all measure with this code.

pub mod against;
pub mod block;
pub mod trials;
