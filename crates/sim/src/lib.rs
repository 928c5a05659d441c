//! Scenes stepped in this process: no session, no shared memory, no clock.
//!
//! [`Sim`] computes the same ticks as `trabecula run --mode lockstep`: the same latch, the same run lane, the
//! same step, so the same hash at every tick for the same commands. It adds what is possible only within one
//! process: snapshots, branches, a start from the middle of a log. [`Batch`] steps many of them on several
//! threads.
//!
//! **Boundary:** opens the files that a scene names and those of logs; starts no part and prints nothing. The
//! Python module `trabecula.sim` (`clients/python/native`) is a thin layer above it.
//!
//! **Invariants:** a tick depends on the scene and the commands alone, not on threads, other simulations,
//! snapshots taken, frames rendered, or whether it is recorded. Simulations of one [`SharedScene`] share its
//! volume. A refused command changes nothing.
//!
//! ```
//! use sim::{Drive, SharedScene, Sim};
//!
//! # fn main() -> Result<(), sim::SimError> {
//! let settings = ["volume.phantom=\"block\"".to_owned(), "predrill=[]".to_owned(),
//!     "tool.burr_start_mm=[0.0, 0.0, -35.0]".to_owned(), "controller.0.curved_drilling.target_mm=[0.0, 0.0, 0.0]".to_owned()];
//! # let settings = [settings.as_slice(), &["drr.isocentre_mm=[0.0, 0.0, 0.0]".to_owned()]].concat();
//! // The built-in femur scene with another volume; its own controller drives.
//! let scene = SharedScene::load(None, &settings, Some(3))?;
//! let mut sim = Sim::new(&scene, &Drive::Nothing)?;
//! sim.step(&[], 20)?;
//! let here = sim.snapshot();
//! sim.step(&[], 5)?;
//! let hash = sim.state().hash;
//! sim.restore(&here)?;
//! sim.step(&[], 5)?;
//! assert_eq!((sim.state().tick, sim.state().hash), (25, hash));
//! # Ok(())
//! # }
//! ```
//!
//! | module | what it holds |
//! |---|---|
//! | [`Sim`], [`Snapshot`] | one simulation; its state at a tick |
//! | [`SharedScene`] | a checked scene with its volume |
//! | [`Batch`] | many simulations on several threads |
//! | [`on_all_cores`] | results of many items, on several threads |
//! | [`LinearModel`] | a tick as A, B, C, D |
//! | [`identification`] | parameters of scenes from measured files |
//! | `from_log`, `recording`, `packed`, `x_ray` | from a log, into a log, as bytes, the X-ray of a state |

mod batch;
mod error;
mod from_log;
pub mod identification;
mod linear;
mod packed;
mod parallel;
mod recording;
mod shared;
mod simulator;
mod x_ray;

pub use batch::{Batch, SimFactory};
pub use error::SimError;
pub use linear::{LinearModel, Signal, used_elements};
pub use parallel::on_all_cores;
pub use shared::SharedScene;
pub use simulator::{Drive, Sim, Snapshot};
pub use x_ray::View;
