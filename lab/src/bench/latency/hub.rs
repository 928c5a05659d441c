//! The hub's side of a client's round trip: publishes states and receives commands as the physics does.

use std::process::Command as Program;
use std::time::{Duration, Instant};

use ipc_types::messages::services;
use ipc_types::messages::{ControllerIndex, Part, Phase, RunStatus, State};
use ipc_types::process::bind_to_parent;
use ipc_types::scene;
use ipc_types::session::{CONTROLLER_VARIABLE, Reader, SESSION_VARIABLE, SessionHost, SessionPlan};

use super::super::failed;
use super::super::ping_pong::Wait;
use super::super::samples::Samples;
use super::cores::Cores;
use trabecula::failure::Failure;

/// The client's name in its scene.
const NAME: &str = "echo";
const SCENE: &str = "name = \"latency\"
[run]
mode = \"lockstep\"
duration_s = 3600.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
bend_toward = [0.0, 0.0, 1.0]
[[controller]]
name = \"echo\"
drives = [\"tendon\"]
external = true
";
/// Timeout for the client.
const LIMIT: Duration = Duration::from_secs(20);

/// Measures round trips with a client in a separate process.
///
/// # Errors
/// Any error of the transport, or the client does not answer.
pub(super) fn measure(
    mut client: Program,
    wait: Wait,
    rounds: usize,
    cores: Cores,
) -> Result<Samples, Failure> {
    let plan = SessionPlan {
        controllers: vec![NAME.to_owned()],
        volume_bytes: 0,
        frame_bytes: 0,
        sensors: false,
        tip_jacobian: false,
        recorder: false,
        wait: scene::Wait::Hybrid,
        policy: scene::Policy::Other,
    };
    let host = SessionHost::create(&plan).map_err(failed)?;
    let session = &host.session;
    session.claim(Part::Physics).map_err(failed)?;
    std::fs::write(session.folder().join("scene.toml"), SCENE).map_err(failed)?;
    let states = session.publisher::<State>(&services::STATE).map_err(failed)?;
    let statuses = session.publisher::<RunStatus>(&services::RUN_STATUS).map_err(failed)?;
    let commands = session.command_subscriber(NAME).map_err(failed)?;
    let waiter = session.waiter(Reader::Physics).map_err(failed)?;
    let waker = session.waker(Reader::Controller(ControllerIndex(0))).map_err(failed)?;
    host.announce().map_err(failed)?;
    client.env(SESSION_VARIABLE, session.folder()).env(CONTROLLER_VARIABLE, NAME);
    let mut child = cores.apart(|| bind_to_parent(&mut client).spawn().map_err(failed))?;
    let mut state = State::zeroed();
    let mut trip = || -> Result<u64, Failure> {
        state.tick += 1;
        let began = Instant::now();
        states.send(&state).map_err(failed)?;
        waker.wake();
        loop {
            if let Some(command) = commands.receive().map_err(failed)? {
                // Reads the message, as the physics would.
                if command.message().state_tick == state.tick {
                    return Ok(began.elapsed().as_nanos() as u64);
                }
            }
            match wait {
                Wait::Spin => std::hint::spin_loop(),
                Wait::Yield => std::thread::yield_now(),
                Wait::Hybrid => {
                    waiter.wait_until(Instant::now() + Duration::from_millis(10), || commands.has_message());
                    // A client that joins after a state was published gets it here.
                    states.deliver_history().map_err(failed)?;
                }
            }
            if began.elapsed() > LIMIT {
                return Err(Failure::failed("latency: the client does not answer"));
            }
            if wait != Wait::Hybrid && began.elapsed() > Duration::from_millis(100) {
                states.deliver_history().map_err(failed)?;
            }
        }
    };
    let mut samples = Samples::default();
    for round in 0..rounds {
        match trip() {
            // The first round trip includes the client's start.
            Ok(_) if round == 0 => {}
            Ok(nanoseconds) => samples.add(nanoseconds),
            Err(failure) => {
                // It may already have ended.
                let _ = child.kill();
                let _ = child.wait();
                return Err(failure);
            }
        }
    }
    // An FMU's process answers until the run ends; the others know the number of round trips.
    let status = RunStatus { phase: Phase::Ended.code(), ..RunStatus::zeroed() };
    statuses.send(&status).map_err(failed)?;
    waker.wake();
    child.wait().map_err(failed)?;
    Ok(samples)
}
