//! The services that the recorder subscribes to, and the two that it publishes on.

use ipc_types::messages::services;
use ipc_types::messages::{
    Command, DrrReply, DrrRequest, Event, Frame, FrameTiming, Keyframe, Latched, Part, Participant, Progress,
    Removed, RunControl, RunControlReply, RunStatus, SensorReading, State, TickTiming,
};
use ipc_types::ports::{Publisher, Subscriber};
use ipc_types::process::EventSender;
use ipc_types::scene::Scene;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use run_log::command_topic;

/// The recorder's ports: every service of the session.
pub(super) struct Ports {
    pub states: Subscriber<State>,
    pub latched: Subscriber<Latched>,
    pub removed: Subscriber<Removed>,
    /// `None` without sensors.
    pub readings: Option<Subscriber<SensorReading>>,
    pub keyframes: Subscriber<Keyframe>,
    pub frames: Option<Subscriber<Frame>>,
    pub replies: Subscriber<DrrReply>,
    pub requests: Subscriber<DrrRequest>,
    pub commands: Vec<(String, Subscriber<Command>)>,
    pub controls: Subscriber<RunControl>,
    pub control_replies: Subscriber<RunControlReply>,
    pub status: Subscriber<RunStatus>,
    pub events: Subscriber<Event>,
    pub tick_timing: Subscriber<TickTiming>,
    pub frame_timing: Subscriber<FrameTiming>,
    pub progress: Publisher<Progress>,
    pub events_sent: EventSender,
    pub waiter: Waiter,
    pub physics: Waker,
}

impl Ports {
    /// Opens all ports.
    pub fn open(session: &Session, scene: &Scene) -> Result<Ports, SessionError> {
        let command = |name: String| Ok((command_topic(&name), session.lossless_command_subscriber(&name)?));
        Ok(Ports {
            states: session.lossless_subscriber(&services::STATE)?,
            latched: session.lossless_subscriber(&services::LATCHED)?,
            removed: session.lossless_subscriber(&services::REMOVED)?,
            readings: scene
                .has_readings()
                .then(|| session.lossless_subscriber(&services::SENSOR))
                .transpose()?,
            keyframes: session.lossless_subscriber(&services::KEYFRAME)?,
            frames: scene.drr.as_ref().map(|_| session.lossless_subscriber(&services::FRAME)).transpose()?,
            replies: session.lossless_subscriber(&services::DRR_REPLY)?,
            requests: session.lossless_subscriber(&services::DRR_REQUEST)?,
            commands: scene
                .controller_names()
                .into_iter()
                .map(command)
                .collect::<Result<_, SessionError>>()?,
            controls: session.lossless_subscriber(&services::RUN_CONTROL)?,
            control_replies: session.lossless_subscriber(&services::RUN_CONTROL_REPLY)?,
            status: session.lossless_subscriber(&services::RUN_STATUS)?,
            events: session.lossless_subscriber(&services::EVENT)?,
            tick_timing: session.lossless_subscriber(&services::TICK_TIMING)?,
            frame_timing: session.lossless_subscriber(&services::FRAME_TIMING)?,
            progress: session.publisher(&services::PROGRESS)?,
            events_sent: EventSender::new(session, Participant::Part(Part::Recorder))?,
            waiter: session.waiter(Reader::Recorder)?,
            physics: session.waker(Reader::Physics)?,
        })
    }
}

impl Ports {
    /// Returns the number of messages so far that did not come from the service's owner.
    pub fn foreign_messages(&self) -> u64 {
        self.states.foreign_messages()
            + self.latched.foreign_messages()
            + self.removed.foreign_messages()
            + self.keyframes.foreign_messages()
            + self.frames.as_ref().map_or(0, Subscriber::foreign_messages)
            + self.replies.foreign_messages()
            + self.control_replies.foreign_messages()
            + self.status.foreign_messages()
            + self.tick_timing.foreign_messages()
            + self.frame_timing.foreign_messages()
    }
}
