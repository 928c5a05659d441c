//! Delivery decisions: which messages a receiver gets and when, and what it misses. Covers X-ray frames and
//! the clients of a viewer.
//!
//! **Boundary:** decisions only. The DRR process, the controllers and the viewer take the messages, render
//! and send; the schedules of `hub_schedules` check the same decisions against an oracle. None of them
//! decides a tick.
//!
//! | module | what it holds |
//! |---|---|
//! | [`x_ray`] | which X-ray frames are due at which tick, which removed voxels they show, and when a controller sees them |
//! | [`viewer`] | what the clients of a viewer get and miss |

pub mod viewer;
pub mod x_ray;
