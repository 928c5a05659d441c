//! The physics process: drives the [`Hub`] with shared memory and the machine's clock.
//!
//! ```text
//! join the session, take the volume, build the simulation
//! until the hub has ended:  advance it; wait for what it waits for
//! ```

mod clock;
mod connection;
mod disturbance;
mod environment;
mod held_back;

use std::path::Path;

use hub::{Environment, Hub, HubError, Next, Note, Settings};
use ipc_types::clock::now_ns;
use ipc_types::messages::{EventCode, Part, Severity, Tick};
use ipc_types::ports::PortError;
use ipc_types::process::{EndRequest, FIFO_REFUSED, Role, prioritise, session_scene};
use ipc_types::scene::{Mode, Policy, Scene, SceneError};
use ipc_types::session::{Session, SessionError};
use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use simulation::{Simulation, SimulationError};
use thiserror::Error;

use clock::wake_exactly;
use environment::SharedMemory;

pub use disturbance::{Disturbances, Sample};

/// Why the physics process ends early.
#[derive(Debug, Error)]
pub enum PhysicsError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be sent or received.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The simulation refuses the scene.
    #[error("tick 0: {0}")]
    Simulation(#[from] SimulationError),
    /// The bytes received are not a volume.
    #[error("malformed volume message: {problem}")]
    BadVolume {
        /// Description of the defect.
        problem: String,
    },
    /// The run ended early.
    #[error("{0}")]
    Run(HubError<PortError, SimulationError>),
    /// Signals cannot be handled.
    #[error("cannot install signal handlers: {0}")]
    Signals(std::io::Error),
}

/// Runs the physics of a session until the session ends.
///
/// # Errors
/// Any [`PhysicsError`].
pub fn run(session_folder: &Path) -> Result<(), PhysicsError> {
    let end = EndRequest::install().map_err(PhysicsError::Signals)?;
    let scene = session_scene(session_folder)?;
    let session = Session::join(session_folder)?;
    session.claim(Part::Physics)?;
    let mut memory = SharedMemory::open(&session, &scene, end)?;
    let volume = connection::receive_volume(&session, &scene, memory.end())?;
    let ct = volume.as_ref().map(connection::ct).transpose()?;
    let simulation = Simulation::new(&scene, ct)?;
    let settings = Settings::new(&scene, &memory.consumers());
    let mut hub = Hub::new(&scene, simulation, settings, now_ns());
    drive(&mut hub, &mut memory, &scene).map_err(PhysicsError::Run)
}

/// Advances the hub until the run is over.
fn drive(
    hub: &mut Hub<Simulation<'_>>,
    memory: &mut SharedMemory<'_>,
    scene: &Scene,
) -> Result<(), HubError<PortError, SimulationError>> {
    loop {
        match hub.advance(memory)? {
            Next::Wait(wait) => memory.wait(wait),
            Next::GetReady => {
                lock_memory(memory, scene)?;
                take_priority(memory, scene)?;
            }
            Next::Ended => return Ok(()),
        }
    }
}

/// Locks all memory of this process, where the system permits it. In real time all of it is faulted in before
/// the first tick. In lockstep nothing has a deadline: the rest, mostly queues that fill only while a reader
/// is seconds behind, is 150 MB to clear, so each page is locked at its first use.
fn lock_memory(memory: &mut SharedMemory<'_>, scene: &Scene) -> Result<(), PortError> {
    let all = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE;
    let flags = match scene.run.mode {
        Mode::Realtime => all,
        Mode::Lockstep => all | MlockAllFlags::ONFAULT,
    };
    match rustix::mm::mlockall(flags) {
        Ok(()) => keep_future_memory_unlocked_near_the_limit(),
        Err(cause) => {
            inform(memory, &format!("memory is not locked ({cause}): page faults may delay ticks"))?
        }
    }
    Ok(())
}

/// Locks only present memory if a limit leaves little room: with `MCL_FUTURE`, an allocation beyond the limit
/// fails. A process that has locked more than the limit may do so without one (`CAP_IPC_LOCK`).
fn keep_future_memory_unlocked_near_the_limit() {
    let Some(limit) = getrlimit(Resource::Memlock).current else { return };
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let size = status.lines().find_map(|line| line.strip_prefix("VmSize:")?.trim().strip_suffix(" kB"));
    let bytes = size.and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0).saturating_mul(1024);
    if bytes <= limit && limit - bytes < FUTURE_BYTES {
        // Present memory stays locked.
        let _ = rustix::mm::mlockall(MlockAllFlags::CURRENT);
    }
}

/// Memory that a run may still allocate after its start, at most: partly cut voxels and keyframes.
const FUTURE_BYTES: u64 = 256 << 20;

/// Raises the priority, because in real time the tick comes first; reports it if the scheduler refuses.
fn take_priority(memory: &mut SharedMemory<'_>, scene: &Scene) -> Result<(), PortError> {
    if scene.run.mode == Mode::Lockstep {
        return Ok(());
    }
    wake_exactly();
    let policy = scene.run.policy;
    let (wanted, got) = (Role::Physics.priority(policy), prioritise(Role::Physics, policy));
    if got == wanted {
        return Ok(());
    }
    let refused = match (policy, got.fifo) {
        (Policy::Fifo, None) => FIFO_REFUSED.to_owned(),
        _ => format!("priority {wanted} is not permitted"),
    };
    inform(memory, &format!("{refused}; the physics runs with {got} (see `trabecula doctor`)"))
}

fn inform(memory: &mut SharedMemory<'_>, text: &str) -> Result<(), PortError> {
    memory.send_event(&Note { tick: Tick::START, severity: Severity::Info, code: EventCode::Run, text })
}
