//! Measures errors: runs in this process next to the reference, with the same commands, on trials in free
//! space and in bone.
//!
//! Used for the built-in table of the standard tool (`trabecula-lab chart physics`), the tables of scenes'
//! own tools, and the random scenes of `trabecula-lab chart promise`.

pub mod against;
pub mod block;
pub mod trials;
