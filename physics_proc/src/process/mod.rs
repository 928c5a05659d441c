//! The physics process: it owns the tick.
//!
//! ```text
//! connect:  publish x_0 until every consumer and every controller has answered
//! tick k:   obey run control (pause, step, reset, stop)
//!           real time: sleep to the deadline t_0 + k dt          lockstep: wait for every controller's answer to x_k
//!           u_k := latch                                          (validated; late commands held, then the safe one)
//!           publish u_k
//!           x_{k+1}, h_{k+1} := step(x_k, u_k)
//!           publish removed voxels, then x_{k+1}; wake the readers that sleep
//! end:      publish the phase "ended", wait until the consumers have taken the last state
//! ```
//!
//! While somebody records, every `recording.keyframe_interval_s` a keyframe follows the state.
//!
//! A deadline that has passed is not caught up silently: a tick that begins more than one period late counts as
//! missed, and the schedule is moved by the time lost, so ticks never bunch up.

mod clock;
mod connection;
mod disturbance;
mod held_back;
mod keyframes;
mod late_notes;
mod lead;
mod pacing;
mod ports;
mod tick;

use std::path::Path;

use ipc_types::identity::Part;
use ipc_types::ports::PortError;
use ipc_types::process::{EndRequest, session_scene};
use ipc_types::scene::SceneError;
use ipc_types::session::{Session, SessionError};
use thiserror::Error;

use crate::bone::GridGeometry;
use crate::simulation::{CtView, Simulation, SimulationError};
use ports::Ports;
use tick::Runner;

pub use connection::ct_geometry;
pub use disturbance::Disturbances;

/// Why the physics process ends early.
#[derive(Debug, Error)]
pub enum PhysicsError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be sent or taken.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The simulation refuses the scene, or a tick.
    #[error("tick {tick}: {cause}")]
    Simulation {
        /// Tick.
        tick: u64,
        /// Its reason.
        cause: SimulationError,
    },
    /// The volume did not come.
    #[error("the volume did not arrive within {limit_s} s; is the launcher running?")]
    NoVolume {
        /// Seconds waited.
        limit_s: u64,
    },
    /// The volume's bytes are not one.
    #[error("the volume message is not one: {problem}")]
    BadVolume {
        /// What is wrong.
        problem: String,
    },
    /// A part never connected.
    #[error("{part} did not connect within {limit_s} s{hint}")]
    NotConnected {
        /// The part.
        part: String,
        /// Seconds waited.
        limit_s: u64,
        /// What to do.
        hint: String,
    },
    /// A controller did not answer in lockstep.
    #[error(
        "controller `{name}` did not answer tick {tick} within {limit_ms} ms (`run.controller_limit_ms`)"
    )]
    ControllerSilent {
        /// Its name.
        name: String,
        /// Tick.
        tick: u64,
        /// Limit.
        limit_ms: f64,
    },
    /// A consumer of the lossless streams stopped taking states.
    #[error("{part} has taken no state for {limit_s} s at tick {tick}")]
    ConsumerStuck {
        /// The part.
        part: &'static str,
        /// Tick.
        tick: u64,
        /// Limit.
        limit_s: u64,
    },
    /// Signals cannot be handled.
    #[error("signals cannot be handled: {0}")]
    Signals(std::io::Error),
}

/// Runs the physics of a session to its end.
///
/// # Errors
/// Any [`PhysicsError`].
pub fn run(session_folder: &Path) -> Result<(), PhysicsError> {
    let end = EndRequest::install().map_err(PhysicsError::Signals)?;
    let scene = session_scene(session_folder)?;
    let session = Session::join(session_folder)?;
    session.claim(Part::Physics)?;
    let ports = Ports::open(&session, &scene)?;
    let volume = connection::receive_volume(&session, &scene, &end)?;
    let ct = match &volume {
        Some(volume) => {
            let geometry: GridGeometry = ct_geometry(volume.message());
            Some(CtView { geometry, hu: connection::hounsfield_units(volume)? })
        }
        None => None,
    };
    let simulation =
        Simulation::new(&scene, ct).map_err(|cause| PhysicsError::Simulation { tick: 0, cause })?;
    Runner::new(&scene, simulation, ports, end).run()
}
