//! The process of a built-in controller, and the loop that runs any Rust controller.

use std::path::Path;
use std::time::{Duration, Instant};

use delivery::x_ray::{ControllerFrames, FrameMark, FrameStep, FrameTimeout};
use ipc_types::clock::now_ns;
use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{
    Command, EventCode, Frame, ImagePrefix, Participant, Phase, RunStatus, SensorReading, State, Tick,
};
use ipc_types::ports::{PortError, Publisher, ReceivedMessage, Subscriber};
use ipc_types::process::{EndRequest, EventSender, Role, prioritise, session_scene};
use ipc_types::scene::{Mode, Policy, Scene, SceneError};
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use thiserror::Error;

use controllers::{CalibrationError, Controller, built_in};

/// Time between polls for a frame that is due.
const FRAME_POLL_PERIOD: Duration = Duration::from_micros(500);
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
        "controller `{name}` is not built in; expected `curved_drilling`, `skiving`, `tension_sweep`, \
         `tube_deployment` or `hold` in the scene"
    )]
    NotBuiltIn {
        /// Its name.
        name: String,
    },
    /// A frame that was due did not arrive.
    #[error(transparent)]
    NoFrame(#[from] FrameTimeout),
    /// Signals cannot be handled.
    #[error("cannot install signal handlers: {0}")]
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
    let mut newest_tick = Tick::START;
    while !end.is_set() && !ports.run_has_ended()? {
        ports.waiter.wait_until(Instant::now() + POLL_PERIOD, || ports.states.has_message());
        let Some(state) = ports.states.receive_newest()? else { continue };
        let state = state.message();
        let tick = Tick(state.tick);
        ports.frames_for(tick, controller, &end)?;
        ports.readings_for(tick, controller)?;
        sequence += 1;
        let mut command = Command { sequence, state_tick: state.tick, ..Command::zeroed() };
        controller.step(state, &mut command);
        ports.commands.send(&command)?;
        ports.physics.wake();
        if let Some(remark) = controller.remark() {
            ports.events.inform(tick, EventCode::Controller, &remark)?;
        }
        newest_tick = ports.report_gap(newest_tick, tick)?;
    }
    Ok(())
}

struct Ports {
    states: Subscriber<State>,
    status: Subscriber<RunStatus>,
    frames: Option<Frames>,
    /// `None` without sensors.
    readings: Option<Subscriber<SensorReading>>,
    /// Taken from the queue, but arrives with a later state.
    kept: Option<SensorReading>,
    commands: Publisher<Command>,
    events: EventSender,
    physics: Waker,
    waiter: Waiter,
    lockstep: bool,
    policy: Policy,
    ended: bool,
}

impl Ports {
    fn open(session_folder: &Path, name: &str) -> Result<Ports, ControllerError> {
        let session = Session::join(session_folder)?;
        let scene = session_scene(session_folder)?;
        let index = session.controller_index(name)?;
        let frames = match scene.drr {
            // A separate queue, so that frames requested by other programs cannot evict the one that is due.
            Some(_) => Some(Frames::new(session.lossless_subscriber(&services::FRAME)?, scene.clone())),
            None => None,
        };
        Ok(Ports {
            waiter: session.waiter(Reader::Controller(index))?,
            states: session.subscriber(&services::STATE)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            frames,
            readings: scene.has_readings().then(|| session.subscriber(&services::SENSOR)).transpose()?,
            kept: None,
            events: EventSender::new(&session, Participant::Controller(index))?,
            physics: session.waker(Reader::Physics)?,
            commands: session.command_publisher(name)?,
            lockstep: scene.run.mode == Mode::Lockstep,
            policy: scene.run.policy,
            ended: false,
        })
    }

    fn run_has_ended(&mut self) -> Result<bool, PortError> {
        let status = self.status.receive_newest()?;
        self.ended |= status.is_some_and(|status| status.message().phase() == Ok(Phase::Ended));
        Ok(self.ended)
    }

    /// Shows the controller the frames that it must see before it answers the state of this tick.
    fn frames_for(
        &mut self,
        tick: Tick,
        controller: &mut dyn Controller,
        end: &EndRequest,
    ) -> Result<(), ControllerError> {
        let Some(mut frames) = self.frames.take() else { return Ok(()) };
        frames.begin(tick);
        // After the end of a run no further frame may arrive.
        while frames.show_arrived(controller)? == FrameStep::Wait && !end.is_set() && !self.run_has_ended()? {
            std::thread::sleep(FRAME_POLL_PERIOD);
        }
        if let lost @ 1.. = frames.decide.take_lost() {
            let frames = if lost == 1 { "frame" } else { "frames" };
            let text = format!("{lost} {frames} lost: this controller was busy");
            self.events.warn(tick, EventCode::MessagesLost, &text)?;
        }
        self.frames = Some(frames);
        Ok(())
    }

    /// Passes on the readings that arrive up to the state of this tick. They were published before it.
    fn readings_for(&mut self, tick: Tick, controller: &mut dyn Controller) -> Result<(), PortError> {
        let Some(readings) = &self.readings else { return Ok(()) };
        loop {
            let next = match self.kept.take() {
                None => readings.receive()?.map(|reading| *reading.message()),
                kept => kept,
            };
            match next {
                Some(reading) if reading.tick <= tick.0 => controller.reading(&reading),
                later => {
                    self.kept = later;
                    return Ok(());
                }
            }
        }
    }

    /// Reports states that were overwritten before this controller read them (real time).
    fn report_gap(&mut self, last: Tick, tick: Tick) -> Result<Tick, PortError> {
        let missed = tick.since(last).saturating_sub(1);
        if last > Tick::START && missed > services::STATE.queue_length as u64 {
            let text = format!("{missed} states lost: this controller was busy");
            self.events.warn(tick, EventCode::MessagesLost, &text)?;
        }
        Ok(tick)
    }
}

/// The frames that a controller sees, as [`ControllerFrames`] decides.
struct Frames {
    subscriber: Subscriber<Frame>,
    decide: ControllerFrames,
    /// Taken from the queue, but shown at a later state.
    kept: Option<ReceivedMessage<Frame>>,
    scene: Scene,
    pixels: Vec<u16>,
}

impl Frames {
    fn new(subscriber: Subscriber<Frame>, scene: Scene) -> Frames {
        let decide = ControllerFrames::new(scene.run.mode);
        Frames { subscriber, decide, kept: None, scene, pixels: Vec::new() }
    }

    fn begin(&mut self, tick: Tick) {
        self.decide.begin(self.scene.frame_seen_at(tick.0).map(Tick), now_ns());
    }

    /// Shows the frames that have arrived; returns whether to wait for more or to answer.
    fn show_arrived(&mut self, controller: &mut dyn Controller) -> Result<FrameStep, ControllerError> {
        loop {
            let next = match self.kept.take() {
                None => self.subscriber.receive()?,
                kept => kept,
            };
            let mark = next.as_ref().map(|frame| FrameMark::from(frame.message()));
            match (self.decide.step(mark, now_ns())?, next) {
                (FrameStep::Show, Some(frame)) => self.show(&frame, controller),
                (FrameStep::Keep, frame) => {
                    self.kept = frame;
                    return Ok(FrameStep::Answer);
                }
                (step @ (FrameStep::Wait | FrameStep::Answer), _) => return Ok(step),
                (FrameStep::Skip, _) | (FrameStep::Show, None) => {}
            }
        }
    }

    fn show(&mut self, frame: &ReceivedMessage<Frame>, controller: &mut dyn Controller) {
        let data = frame.tail().get(ImagePrefix::DESCRIPTION.size..).unwrap_or_default();
        self.pixels.clear();
        self.pixels.extend(data.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])));
        controller.frame(frame.message(), &self.pixels);
    }
}
