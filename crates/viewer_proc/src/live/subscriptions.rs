//! Takes the session's messages and publishes them on the board under the logs' topics.

use std::collections::BTreeSet;

use delivery::viewer::Decimation;
use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{
    Command, ControllerIndex, DrrReply, DrrRequest, DrrStatus, Event, Frame, FrameTiming, Latched, Part,
    Phase, Progress, Removed, RunControl, RunControlReply, RunStatus, SensorReading, State, TickTiming,
};
use ipc_types::ports::{PortError, ReceivedMessage, Subscriber};
use ipc_types::scene::Scene;
use ipc_types::session::{Session, SessionError};
use run_log::{Logged, Topic, command_topic};

use super::frame_requests::turns_the_c_arm;
use super::parts::Parts;
use crate::board::Board;
use crate::channels::ASKED_FRAME;
use crate::info::{CONTROLLER, ToolShape};
use crate::scene_update::Drawer;

/// Maximum number of messages taken from one queue before the others are polled.
const ROUND: usize = 1024;

/// Maximum number of requested frames to wait for; beyond that, the oldest count as lost.
const MOST_ASKED: usize = 64;

/// The subscriptions.
pub(super) struct Subscriptions {
    states: Subscriber<State>,
    frames: Option<Subscriber<Frame>>,
    status: Subscriber<RunStatus>,
    replies: Subscriber<DrrReply>,
    progress: Subscriber<Progress>,
    commands: Vec<(String, Subscriber<Command>)>,
    others: Vec<Box<dyn Forward>>,
    /// The viewer's index among the controllers, if it requests frames as a controller rather than as an
    /// observer.
    own_index: Option<ControllerIndex>,
    /// Request numbers of the viewer's frames that have not arrived yet.
    asked: BTreeSet<u64>,
    parts: Parts,
    drawer: Drawer,
    /// The newest state not yet drawn.
    newest: Option<State>,
    dt_ns: u64,
    tick: u64,
    ended: bool,
    physics_heard: bool,
}

/// A queue whose messages are forwarded unchanged to a topic.
trait Forward {
    fn poll(&mut self, board: &Board, time_ns: u64) -> Result<usize, PortError>;
}

struct Forwarded<M> {
    subscriber: Subscriber<M>,
}

impl<M: Logged> Forward for Forwarded<M> {
    fn poll(&mut self, board: &Board, time_ns: u64) -> Result<usize, PortError> {
        forward(&self.subscriber, M::TOPIC.name(), board, |_| time_ns, |_| ())
    }
}

/// Forwards queued messages: all of them if a client subscribes to the topic, otherwise only the newest.
/// Skips malformed ones. Returns the number received.
fn forward<M: Message>(
    subscriber: &Subscriber<M>,
    topic: &str,
    board: &Board,
    time_ns: impl Fn(&M) -> u64,
    mut see: impl FnMut(&M),
) -> Result<usize, PortError> {
    let Some(channel) = board.channels().id(topic) else { return Ok(0) };
    let publish = |received: &ReceivedMessage<M>| {
        board.publish_cdr(topic, time_ns(received.message()), &[received.bytes()]);
    };
    let (mut count, mut decimation) = (0, Decimation::new(board.wanted(), channel));
    while count < ROUND
        && let Some(received) = subscriber.receive_valid(|_| {})?
    {
        count += 1;
        see(received.message());
        if let Some(received) = decimation.next(received) {
            publish(&received);
        }
    }
    if let Some(received) = decimation.last() {
        publish(&received);
    }
    Ok(count)
}

impl Subscriptions {
    pub(super) fn open(
        session: &Session,
        scene: &Scene,
        tool: &ToolShape,
    ) -> Result<Subscriptions, SessionError> {
        let names = scene.controller_names();
        let commands = names
            .iter()
            .map(|name| Ok((name.clone(), session.command_subscriber(name)?)))
            .collect::<Result<_, SessionError>>()?;
        let sensors =
            scene.has_readings().then(|| Forwarded::<SensorReading>::open(session, &services::SENSOR));
        let sensors = sensors.transpose()?;
        Ok(Subscriptions {
            states: session.subscriber(&services::STATE)?,
            frames: scene.drr.as_ref().map(|_| session.subscriber(&services::FRAME)).transpose()?,
            status: session.subscriber(&services::RUN_STATUS)?,
            replies: session.subscriber(&services::DRR_REPLY)?,
            progress: session.subscriber(&services::PROGRESS)?,
            commands,
            others: vec![
                Forwarded::<Latched>::open(session, &services::LATCHED)?,
                Forwarded::<Removed>::open(session, &services::REMOVED)?,
                Forwarded::<TickTiming>::open(session, &services::TICK_TIMING)?,
                Forwarded::<FrameTiming>::open(session, &services::FRAME_TIMING)?,
                Forwarded::<Event>::open(session, &services::EVENT)?,
                Forwarded::<RunControl>::open(session, &services::RUN_CONTROL)?,
                Forwarded::<RunControlReply>::open(session, &services::RUN_CONTROL_REPLY)?,
                Forwarded::<DrrRequest>::open(session, &services::DRR_REQUEST)?,
            ]
            .into_iter()
            .chain(sensors)
            .collect(),
            own_index: ControllerIndex::first(names.len())
                .find(|index| names[index.slot()] == CONTROLLER)
                .filter(|_| turns_the_c_arm(scene)),
            asked: BTreeSet::new(),
            parts: Parts::new(scene, session),
            drawer: Drawer::new(tool),
            newest: None,
            dt_ns: scene.dt_ns(),
            tick: 0,
            ended: false,
            physics_heard: false,
        })
    }

    /// Whether the run's status has reported its end.
    pub(super) fn run_has_ended(&self) -> bool {
        self.ended
    }

    /// Whether the physics has sent a message.
    pub(super) fn physics_is_heard(&self) -> bool {
        self.physics_heard
    }

    /// Takes the messages received since the last poll.
    pub(super) fn poll(&mut self, board: &Board) -> Result<(), PortError> {
        self.look_at_states(board)?;
        let time_ns = self.time_ns();
        for other in &mut self.others {
            other.poll(board, time_ns)?;
        }
        self.look_at_frames(board)?;
        let (mut ended, mut recorded) = (self.ended, 0);
        let heard = forward(
            &self.status,
            Topic::RunStatus.name(),
            board,
            |_| time_ns,
            |status| {
                ended |= status.phase() == Ok(Phase::Ended);
            },
        )?;
        self.ended = ended;
        self.physics_heard |= heard > 0;
        for _ in 0..ROUND {
            let Some(progress) = self.progress.receive_valid(|_| {})? else { break };
            recorded += usize::from(progress.message().consumer() == Some(Part::Recorder));
        }
        self.parts.count_messages(Part::Recorder.name(), recorded);
        for (name, commands) in &self.commands {
            let topic = command_topic(name);
            self.parts.count_messages(name, forward(commands, &topic, board, |_| time_ns, |_| ())?);
        }
        self.parts.publish(board);
        Ok(())
    }

    fn time_ns(&self) -> u64 {
        self.tick.saturating_mul(self.dt_ns)
    }

    fn look_at_states(&mut self, board: &Board) -> Result<(), PortError> {
        let (dt_ns, mut tick) = (self.dt_ns, self.tick);
        let time_ns = |state: &State| state.tick.saturating_mul(dt_ns);
        let newest = &mut self.newest;
        let count = forward(&self.states, Topic::State.name(), board, time_ns, |state| {
            tick = state.tick;
            *newest = Some(*state);
        })?;
        // Also draws the last state of a paused run, for clients that subscribe later.
        if self.drawer.is_due(board)
            && let Some(state) = self.newest.take()
        {
            self.drawer.draw(&state, time_ns(&state), board);
        }
        self.tick = tick;
        board.set_time_ns(self.time_ns());
        self.parts.count_messages(Part::Physics.name(), count);
        Ok(())
    }

    fn look_at_frames(&mut self, board: &Board) -> Result<(), PortError> {
        let Some(frames) = self.frames.take() else { return Ok(()) };
        let mut count = 0;
        while count < ROUND
            && let Some(received) = frames.receive_valid(|_| {})?
        {
            count += 1;
            // A frame's reply is sent before the frame.
            self.look_at_replies(board)?;
            let frame = received.message();
            let time_ns = frame.tick.saturating_mul(self.dt_ns);
            if self.asked.remove(&frame.sequence) {
                board.publish_cdr(ASKED_FRAME, time_ns, &[received.bytes()]);
            }
            // A superseded frame is not published.
            if !frames.has_message() {
                board.publish_cdr(Topic::DrrFrame.name(), time_ns, &[zerocopy::IntoBytes::as_bytes(frame)]);
                board.publish_cdr(Topic::DrrImage.name(), time_ns, &[received.tail()]);
            }
        }
        self.frames = Some(frames);
        self.parts.count_messages(Part::Drr.name(), count);
        self.look_at_replies(board)
    }

    fn look_at_replies(&mut self, board: &Board) -> Result<(), PortError> {
        let time_ns = self.time_ns();
        let mut refused = None;
        let (own_index, asked) = (self.own_index, &mut self.asked);
        forward(
            &self.replies,
            Topic::DrrReply.name(),
            board,
            |_| time_ns,
            |reply| {
                if reply.status() != Ok(DrrStatus::Accepted) {
                    refused = Some(reply.requester);
                } else if reply.request_id != 0 && reply.requester == DrrRequest::requester_of(own_index) {
                    asked.insert(reply.frame_sequence);
                    if asked.len() > MOST_ASKED {
                        asked.pop_first();
                    }
                }
            },
        )?;
        if let Some(requester) = refused {
            let text = format!("a frame request of controller {requester} was refused; see the events");
            board.notice("warning", &text);
        }
        Ok(())
    }
}

impl<M: Logged + 'static> Forwarded<M> {
    fn open(session: &Session, service: &services::Service) -> Result<Box<dyn Forward>, SessionError> {
        Ok(Box::new(Forwarded::<M> { subscriber: session.subscriber(service)? }))
    }
}
