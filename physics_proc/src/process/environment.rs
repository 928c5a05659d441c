//! The hub's environment in a running session: ports in shared memory, the machine's clock, the kernel's
//! counters.

use std::time::{Duration, Instant};

use hub::rate_limit::Connection;
use hub::{Environment, IncomingMessage, Note, Outputs, Report, Start, Wait, WakeCondition};
use ipc_types::clock::now_ns;
use ipc_types::messages::services;
use ipc_types::messages::{
    Blame, Command, ControllerIndex, Keyframe, Latched, Part, Participant, Progress, Removed, RunControl,
    RunControlReply, RunStatus, SensorReading, State, Tick, TickTiming, TipJacobian,
};
use ipc_types::ports::{PortError, Publisher, ReceivedMessage, Subscriber};
use ipc_types::process::{EndRequest, EventSender};
use ipc_types::scene::Scene;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::{Waiter, Waker};
use zerocopy::IntoBytes;

use super::clock::Sleeper;
use super::disturbance::{Disturbances, Sample};

/// Every port of the physics process.
pub(super) struct SharedMemory<'s> {
    session: &'s Session,
    state: Publisher<State>,
    latched: Publisher<Latched>,
    removed: Publisher<Removed>,
    /// `None` without sensors.
    readings: Option<Publisher<SensorReading>>,
    /// `None` if the scene does not ask for it.
    tip_jacobian: Option<Publisher<TipJacobian>>,
    /// `None` without a recorder.
    keyframe: Option<Publisher<Keyframe>>,
    status: Publisher<RunStatus>,
    timing: Publisher<TickTiming>,
    control: Subscriber<RunControl>,
    control_reply: Publisher<RunControlReply>,
    progress: Subscriber<Progress>,
    events: EventSender,
    commands: Vec<Subscriber<Command>>,
    controller_wakers: Vec<Waker>,
    consumers: Vec<(Part, Waker)>,
    waiter: Waiter,
    sleeper: Sleeper,
    disturbances: Disturbances,
    end: EndRequest,
    /// One moment on our clock and on the standard library's, which is the same clock: converts times between
    /// the two.
    began: (u64, Instant),
}

impl<'s> SharedMemory<'s> {
    /// Opens the ports. Call it from the thread that will run the tick.
    pub(super) fn open(
        session: &'s Session,
        scene: &Scene,
        end: EndRequest,
    ) -> Result<SharedMemory<'s>, SessionError> {
        let names = || scene.controller.iter().map(|controller| controller.name.as_str());
        let announcement = session.announcement();
        let mut consumers = Vec::new();
        if announcement.frame_bytes > 0 {
            consumers.push((Part::Drr, session.waker(Reader::Drr)?));
        }
        if announcement.recorder {
            consumers.push((Part::Recorder, session.waker(Reader::Recorder)?));
        }
        let recorded = announcement.recorder && scene.keyframe_period_ticks().is_some();
        Ok(SharedMemory {
            session,
            state: session.publisher(&services::STATE)?,
            latched: session.publisher(&services::LATCHED)?,
            removed: session.publisher(&services::REMOVED)?,
            readings: scene.has_readings().then(|| session.publisher(&services::SENSOR)).transpose()?,
            tip_jacobian: scene
                .has_tip_jacobian()
                .then(|| session.publisher(&services::TIP_JACOBIAN))
                .transpose()?,
            keyframe: recorded.then(|| session.publisher(&services::KEYFRAME)).transpose()?,
            status: session.publisher(&services::RUN_STATUS)?,
            timing: session.publisher(&services::TICK_TIMING)?,
            control: session.subscriber(&services::RUN_CONTROL)?,
            control_reply: session.publisher(&services::RUN_CONTROL_REPLY)?,
            progress: session.subscriber(&services::PROGRESS)?,
            events: EventSender::new(session, Participant::Part(Part::Physics))?,
            commands: names().map(|name| session.command_subscriber(name)).collect::<Result<_, _>>()?,
            controller_wakers: ControllerIndex::first(names().count())
                .map(|index| session.waker(Reader::Controller(index)))
                .collect::<Result<_, _>>()?,
            consumers,
            waiter: session.waiter(Reader::Physics)?,
            sleeper: Sleeper::new(scene.run.wait),
            disturbances: Disturbances::new(),
            end,
            began: (now_ns(), Instant::now()),
        })
    }

    /// Returns the parts that must receive every state.
    pub(super) fn consumers(&self) -> Vec<Part> {
        self.consumers.iter().map(|(part, _)| *part).collect()
    }

    /// Returns the request to end.
    pub(super) fn end(&self) -> &EndRequest {
        &self.end
    }

    /// Waits for whatever the hub needs next.
    pub(super) fn wait(&mut self, wait: Wait) {
        let (began_ns, began) = self.began;
        let until = began + Duration::from_nanos(wait.until_ns.saturating_sub(began_ns));
        match wait.on {
            WakeCondition::Deadline => self.sleeper.wait_until(wait.until_ns),
            WakeCondition::Nothing => {
                std::thread::sleep(Duration::from_nanos(wait.until_ns.saturating_sub(now_ns())));
            }
            WakeCondition::Control => {
                self.waiter.wait_until(until, || self.control.has_message());
            }
            WakeCondition::Report => {
                self.waiter.wait_until(until, || self.progress.has_message());
            }
            WakeCondition::Command(index) => {
                self.waiter.wait_until(until, || self.commands[index.slot()].has_message());
            }
        }
    }
}

/// Copies a message, with its sender.
fn copied<M: ipc_types::messages::layout::Message>(received: &ReceivedMessage<M>) -> IncomingMessage<M> {
    IncomingMessage::Message(*received.message(), Connection(received.sender().number()))
}

impl Outputs for SharedMemory<'_> {
    type Error = PortError;

    fn send_latched(&mut self, latched: &Latched) -> Result<(), PortError> {
        self.latched.send(latched)
    }

    fn send_removed(&mut self, removed: &Removed, voxels: &[u32]) -> Result<(), PortError> {
        self.removed.send_with_tail(removed, voxels.as_bytes())
    }

    fn send_reading(&mut self, reading: &SensorReading) -> Result<(), PortError> {
        self.readings.as_ref().map_or(Ok(()), |publisher| publisher.send(reading))
    }

    fn send_tip_jacobian(&mut self, jacobian: impl FnOnce() -> Option<TipJacobian>) -> Result<(), PortError> {
        let Some(publisher) = &self.tip_jacobian else { return Ok(()) };
        jacobian().map_or(Ok(()), |jacobian| publisher.send(&jacobian))
    }

    fn send_state(&mut self, state: &State) -> Result<(), PortError> {
        self.state.send(state)
    }

    fn send_keyframe(&mut self, keyframe: &Keyframe, part: &[u8]) -> Result<(), PortError> {
        self.keyframe.as_ref().map_or(Ok(()), |publisher| publisher.send_with_tail(keyframe, part))
    }
}

impl Environment for SharedMemory<'_> {
    fn now_ns(&self) -> u64 {
        now_ns()
    }

    fn end_requested(&self) -> bool {
        self.end.is_set()
    }

    fn receive_command(
        &mut self,
        controller: ControllerIndex,
    ) -> Result<Option<IncomingMessage<Command>>, PortError> {
        match self.commands[controller.slot()].receive() {
            Ok(received) => Ok(received.map(|received| copied(&received))),
            Err(PortError::Length { service, bytes, expected }) => {
                let reason = format!("a message of {bytes} bytes on `{service}`, expected {expected}");
                Ok(Some(IncomingMessage::Malformed(reason)))
            }
            Err(other) => Err(other),
        }
    }

    fn receive_control(&mut self) -> Result<Option<IncomingMessage<RunControl>>, PortError> {
        match self.control.receive() {
            Ok(received) => Ok(received.map(|received| copied(&received))),
            Err(malformed @ PortError::Length { .. }) => {
                Ok(Some(IncomingMessage::Malformed(malformed.to_string())))
            }
            Err(other) => Err(other),
        }
    }

    fn receive_report(&mut self) -> Result<Option<Report>, PortError> {
        while let Some(received) = self.progress.receive_valid(|_| {})? {
            // The transport identifies the sender, not the report, so no part can impersonate another.
            if let Some(part) = received.part() {
                return Ok(Some(Report { part, tick: Tick(received.message().tick) }));
            }
        }
        Ok(None)
    }

    fn foreign_reports(&self) -> u64 {
        self.progress.foreign_messages()
    }

    fn send_status(&mut self, status: &RunStatus) -> Result<(), PortError> {
        self.status.send(status)
    }

    fn send_timing(&mut self, timing: &TickTiming) -> Result<(), PortError> {
        self.timing.send(timing)
    }

    fn send_control_reply(&mut self, reply: &RunControlReply) -> Result<(), PortError> {
        self.control_reply.send(reply)
    }

    fn send_event(&mut self, note: &Note<'_>) -> Result<(), PortError> {
        self.events.send(note.tick, note.severity, note.code, note.text)
    }

    fn leave_blame(&mut self, blame: &Blame) {
        // Without it clients receive only the event.
        let _ = self.session.leave_blame(blame);
    }

    fn wake_controllers(&mut self) {
        self.controller_wakers.iter().for_each(Waker::wake);
    }

    fn wake_consumers(&mut self) {
        self.consumers.iter().for_each(|(_, waker)| waker.wake());
    }

    fn deliver_state_history(&mut self) -> Result<(), PortError> {
        self.state.deliver_history()
    }

    fn deliver_status_history(&mut self) -> Result<(), PortError> {
        self.status.deliver_history()
    }

    fn work_ends(&mut self) {
        self.disturbances.work_ends();
    }

    fn tick_begins(&mut self, start_ns: u64, start: Start, timing: &mut TickTiming) {
        let sample = if start.missed { Sample::Late } else { Sample::InTime };
        self.disturbances.tick_begins(start_ns, start.lateness_ns, sample, timing);
    }

    fn tick_made(&mut self, timing: &mut TickTiming) {
        self.disturbances.count(timing);
    }

    fn status_is_due(&mut self) {
        self.disturbances.note_steal();
    }
}
