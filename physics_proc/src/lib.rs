//! The manipulator, its contact with bone, drilling and the arm: a pure library that steps, and its process.
//!
//! [`simulation::Simulation`] is x_{k+1} = step(x_k, u_k): no clock, no randomness, no I/O, no allocation. The process
//! ([`process`]) gives it the commands that it has latched and publishes what comes out; replay gives it those of a log.

pub mod arm;
pub mod baselines;
pub mod bone;
pub mod contact_plane;
pub mod latch;
pub mod manipulator;
pub mod process;
pub mod rigid;
pub mod simulation;
