//! Simulates a continuum manipulator on a robot arm that drills bone, one fixed time step at a time.
//!
//! [`Simulation`] computes x_{k+1} = step(x_k, u_k): the state after tick k from the state before it and the
//! commands of that tick. The physics process passes in the commands that the hub has latched and publishes
//! the new state; a replay passes in the commands of a log.
//!
//! **Boundary:** no clock, no randomness, no files, no other processes. The CT is borrowed and never copied.
//!
//! **Invariants**
//!
//! - The same scene, CT and commands give the same bits: with or without vector instructions, after a
//!   keyframe or a reset, and whether caches are kept or dropped.
//! - A step allocates no memory, except in Ruckig while the arm moves and in Rapier if there are free bodies.
//! - A rejected command changes nothing.
//!
//! ```
//! use std::path::Path;
//!
//! use messages::{CommandSource, Latched, TendonMode};
//! use scene::Scene;
//! use simulation::Simulation;
//!
//! let text = r#"
//! name = "bend"
//! [run]
//! mode = "lockstep"
//! duration_s = 1.0
//! [tool]
//! burr_start_mm = [0.0, 0.0, 0.0]
//! direction = [1.0, 0.0, 0.0]
//! bend_toward = [0.0, 0.0, 1.0]
//! [[controller]]
//! name = "me"
//! drives = ["tendon"]
//! [controller.hold]
//! tension_n = 5.0
//! "#;
//! let scene = Scene::parse(text, Path::new("bend.toml")).unwrap();
//! let mut simulation = Simulation::new(&scene, None).unwrap();
//! // u_k: the commands that the hub would latch.
//! let mut latched = Latched { controller_count: 1, ..Latched::zeroed() };
//! latched.commands[0].command.tendon_mode = TendonMode::ServoJf.code();
//! latched.commands[0].command.tendon_force_n[0] = 5.0;
//! for tick in 0..300 {
//!     latched.tick = tick;
//!     latched.commands[0].source = if tick == 0 { CommandSource::Fresh } else { CommandSource::Held }.code();
//!     simulation.step(&latched).unwrap();
//! }
//! assert_eq!(simulation.state().tick, 300);
//! assert!(simulation.state().bend_rad > 0.3);
//! ```
//!
//! | module | contents |
//! |---|---|
//! | [`manipulator`] | the tool: five models of increasing detail, tendons, contact impulses |
//! | [`bone`] | the voxels: contact planes, drilling |
//! | [`arm`] | kinematics, jerk-limited motion, elastic joints |
//! | [`rigid`] | free and fixed bodies in Rapier |

pub mod arm;
pub mod bone;
pub mod contact_plane;
pub mod manipulator;
pub mod rigid;
mod world;

pub use world::{
    CtView, Finding, KeyframeError, LostTool, Simulation, SimulationError, SimulationSnapshot, StateEntry,
    StateVectorError, ToolEffort, Verdict, contact_kind, creation_bound_j, findings, manipulator_parameters,
    outer_surface, planned_time_s, pose, rung, validated_range,
};
