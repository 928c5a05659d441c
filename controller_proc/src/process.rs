//! The process of a built-in controller, and the loop that runs any Rust controller.

use std::path::Path;
use std::time::{Duration, Instant};

use hub::patience::Patience;
use ipc_types::clock::now_ns;
use ipc_types::layout::Message;
use ipc_types::messages::{
    Command, EVENT_CONTROLLER, EVENT_MESSAGES_LOST, Frame, ImagePrefix, PHASE_ENDED, RunStatus,
    SENDER_CONTROLLER, SEVERITY_WARNING, State,
};
use ipc_types::ports::{PortError, Publisher, Received, Subscriber};
use ipc_types::process::{EndRequest, EventSender, Role, prioritise, session_scene};
use ipc_types::scene::{Mode, Policy, Scene, SceneError};
use ipc_types::services;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use thiserror::Error;

use controllers::{CalibrationError, Controller, built_in};

/// In lockstep, how long to wait for a frame that is due.
const FRAME_LIMIT: Duration = Duration::from_secs(120);
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// Why a controller process ends early.
#[derive(Debug, Error)]
pub enum ControllerError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// Its calibration cannot be used.
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    /// A message cannot be sent or received.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The scene's controller of this name is not built in.
    #[error(
        "controller `{name}` is not a built-in one; expected `curved_drilling`, `skiving`, `tension_sweep` or `hold` in the scene"
    )]
    NotBuiltIn {
        /// Its name.
        name: String,
    },
    /// A frame that was due did not arrive.
    #[error("the frame of tick {tick} did not come within {} s; is the DRR process running?", FRAME_LIMIT.as_secs())]
    NoFrame {
        /// Tick of the frame.
        tick: u64,
    },
    /// Signals cannot be handled.
    #[error("signals cannot be handled: {0}")]
    Signals(std::io::Error),
}

/// Runs the scene's built-in controller of this name until the run ends.
///
/// # Errors
/// Any [`ControllerError`].
pub fn run(session_folder: &Path, name: &str) -> Result<(), ControllerError> {
    let scene = session_scene(session_folder)?;
    match built_in(&scene, name, &ipc_types::text_file::read)? {
        Some(mut controller) => run_controller(session_folder, name, controller.as_mut()),
        None => Err(ControllerError::NotBuiltIn { name: name.to_owned() }),
    }
}

/// Runs any controller under a name of the scene until the run ends.
///
/// # Errors
/// Any [`ControllerError`].
pub fn run_controller(
    session_folder: &Path,
    name: &str,
    controller: &mut dyn Controller,
) -> Result<(), ControllerError> {
    let end = EndRequest::install().map_err(ControllerError::Signals)?;
    let mut ports = Ports::open(session_folder, name)?;
    if !ports.lockstep {
        prioritise(Role::Controller, ports.policy);
    }
    let mut sequence = 0;
    let mut newest_tick = 0;
    while !end.is_set() && !ports.run_has_ended()? {
        ports.waiter.wait_until(Instant::now() + POLL_PERIOD, || ports.states.has_message());
        let Some(state) = ports.states.receive_newest()? else { continue };
        let state = state.message();
        ports.frames_for(state.tick, controller, &end)?;
        sequence += 1;
        let mut command = Command { sequence, state_tick: state.tick, ..Command::zeroed() };
        controller.step(state, &mut command);
        ports.commands.send(&command)?;
        ports.physics.wake();
        if let Some(remark) = controller.remark() {
            ports.events.inform(state.tick, EVENT_CONTROLLER, &remark)?;
        }
        newest_tick = ports.report_gap(newest_tick, state.tick)?;
    }
    Ok(())
}

struct Ports {
    states: Subscriber<State>,
    status: Subscriber<RunStatus>,
    frames: Option<Frames>,
    commands: Publisher<Command>,
    events: EventSender,
    physics: Waker,
    waiter: Waiter,
    lockstep: bool,
    policy: Policy,
}

impl Ports {
    fn open(session_folder: &Path, name: &str) -> Result<Ports, ControllerError> {
        let session = Session::join(session_folder)?;
        let scene = session_scene(session_folder)?;
        let index = session.controller_index(name)?;
        let frames = match scene.drr {
            // A separate queue, so that frames requested by others cannot push out the one that is due.
            Some(_) => Some(Frames::new(session.lossless_subscriber(&services::FRAME)?, scene.clone())),
            None => None,
        };
        Ok(Ports {
            waiter: session.waiter(Reader::Controller(index))?,
            states: session.subscriber(&services::STATE)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            frames,
            events: EventSender::new(&session, SENDER_CONTROLLER + index as u32)?,
            physics: session.waker(Reader::Physics)?,
            commands: session.command_publisher(name)?,
            lockstep: scene.run.mode == Mode::Lockstep,
            policy: scene.run.policy,
        })
    }

    fn run_has_ended(&self) -> Result<bool, PortError> {
        let status = self.status.receive_newest()?;
        Ok(status.is_some_and(|status| status.message().phase == PHASE_ENDED))
    }

    fn frames_for(
        &mut self,
        tick: u64,
        controller: &mut dyn Controller,
        end: &EndRequest,
    ) -> Result<(), ControllerError> {
        match &mut self.frames {
            Some(frames) if self.lockstep => frames.due(tick, controller, end),
            Some(frames) => frames.arrived(controller),
            None => Ok(()),
        }
    }

    /// Reports states that were overwritten before this controller read them (real time).
    fn report_gap(&mut self, last: u64, tick: u64) -> Result<u64, PortError> {
        let missed = tick.saturating_sub(last + 1);
        if last > 0 && missed > services::STATE.queue_length as u64 {
            let text = format!("{missed} states passed while this controller was busy");
            self.events.send(tick, SEVERITY_WARNING, EVENT_MESSAGES_LOST, &text)?;
        }
        Ok(tick)
    }
}

/// The frames that a controller sees: in real time whatever has arrived, in lockstep whatever is due
/// ([`Scene::frame_seen_at`]).
struct Frames {
    subscriber: Subscriber<Frame>,
    scene: Scene,
    pixels: Vec<u16>,
}

impl Frames {
    fn new(subscriber: Subscriber<Frame>, scene: Scene) -> Frames {
        Frames { subscriber, scene, pixels: Vec::new() }
    }

    fn arrived(&mut self, controller: &mut dyn Controller) -> Result<(), ControllerError> {
        while let Some(frame) = self.subscriber.receive()? {
            self.show(&frame, controller);
        }
        Ok(())
    }

    fn due(
        &mut self,
        tick: u64,
        controller: &mut dyn Controller,
        end: &EndRequest,
    ) -> Result<(), ControllerError> {
        let Some(wanted) = self.scene.frame_seen_at(tick) else { return Ok(()) };
        let mut patience = Patience::new(FRAME_LIMIT.as_nanos() as u64, now_ns());
        while !patience.is_over(now_ns()) {
            match self.subscriber.receive()? {
                Some(frame) if frame.message().tick == wanted && frame.message().request_id == 0 => {
                    self.show(&frame, controller);
                    return Ok(());
                }
                Some(_) => {}
                None if end.is_set() => return Ok(()),
                None => std::thread::sleep(Duration::from_micros(500)),
            }
        }
        Err(ControllerError::NoFrame { tick: wanted })
    }

    fn show(&mut self, frame: &Received<Frame>, controller: &mut dyn Controller) {
        let data = frame.tail().get(ImagePrefix::DESCRIPTION.size..).unwrap_or_default();
        self.pixels.clear();
        self.pixels.extend(data.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])));
        controller.frame(frame.message(), &self.pixels);
    }
}
