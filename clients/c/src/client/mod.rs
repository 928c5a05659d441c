//! A program's connection to a session: states, commands, and the state of the run.

mod connection;
mod control;
mod events;

pub use connection::{Connection, Info};
pub(crate) use events::event_text;

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{
    Command, DrrReply, DrrRequest, Event, Frame, Phase, Removed, RunStatus, SensorReading, State,
    TipJacobian, Volume,
};
use ipc_types::own::ProcessOwned;
use ipc_types::ports::{Publisher, ReceivedMessage, Subscriber};
use ipc_types::process::{EventSender, session_scene};
use ipc_types::scene::{Mode, Scene};
use ipc_types::session::{Reader, Session};
use ipc_types::wake::{Waiter, Waker};

use connection::{await_folder, controller_of};
use control::Control;

use crate::error::ClientError;

/// Interval at which a waiting client checks that the hub is alive.
const HUB_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Poll interval of an observer, which is never woken.
const OBSERVER_POLL_PERIOD: Duration = Duration::from_micros(200);
/// Maximum wait; longer ones overflow clocks.
const LONGEST_WAIT_S: f64 = 1e9;

/// A connection. It belongs to the thread and process that created it: in a `fork` child every call fails
/// with [`ClientError::Forked`], and dropping it there does not disconnect it.
#[derive(Debug)]
pub struct Client {
    pub(crate) session: ProcessOwned<Session>,
    pub(crate) scene: Scene,
    pub(crate) info: Info,
    states: Subscriber<State>,
    status: Subscriber<RunStatus>,
    waiter: Option<Waiter>,
    physics: Waker,
    commands: Option<Publisher<Command>>,
    state: Option<ReceivedMessage<State>>,
    /// Filled in by the caller and copied when sent, so later writes have no effect. Boxed, because callers
    /// of the C interface hold its address.
    command: Box<Command>,
    /// Whether a command has been requested and not yet sent.
    is_begun: bool,
    sequence: u64,
    newest_tick: Option<u64>,
    states_missed: u64,
    newest_status: Option<RunStatus>,
    hub_seen: Instant,
    /// Time at which this client learned that the run is over.
    pub(crate) ended: Option<Instant>,
    control: Option<Control>,
    events: Option<Subscriber<Event>>,
    pub(crate) event: Option<ReceivedMessage<Event>>,
    remarks: Option<EventSender>,
    removed: Option<Subscriber<Removed>>,
    pub(crate) removal: Option<ReceivedMessage<Removed>>,
    /// `None` without sensors.
    readings: Option<Subscriber<SensorReading>>,
    pub(crate) reading: Option<ReceivedMessage<SensorReading>>,
    /// `None` if the scene does not ask for it.
    tip_jacobians: Option<Subscriber<TipJacobian>>,
    pub(crate) tip_jacobian: Option<ReceivedMessage<TipJacobian>>,
    pub(crate) frames: Option<Subscriber<Frame>>,
    pub(crate) frame: Option<ReceivedMessage<Frame>>,
    pub(crate) requests: Option<Requests>,
    pub(crate) volumes: Option<Subscriber<Volume>>,
    pub(crate) volume: Option<ReceivedMessage<Volume>>,
}

#[derive(Debug)]
pub(crate) struct Requests {
    pub(crate) publisher: Publisher<DrrRequest>,
    pub(crate) replies: Subscriber<DrrReply>,
    pub(crate) drr: Waker,
    /// Id of the newest request that the DRR process has accepted for rendering.
    pub(crate) accepted: u64,
}

/// Converts a foreign caller's seconds to a duration.
pub(crate) fn limit_of(seconds: f64) -> Result<Duration, ClientError> {
    // Written so that NaN fails the check.
    if !(0.0..=f64::INFINITY).contains(&seconds) {
        let expected = "0 or more seconds";
        return Err(ClientError::BadArgument { name: "timeout_s", value: seconds, expected });
    }
    Ok(Duration::from_secs_f64(seconds.min(LONGEST_WAIT_S)))
}

impl Client {
    /// Joins a session.
    ///
    /// # Errors
    /// No session within the limit; several sessions and none named; another layout or transport version (the
    /// error names it); an unknown controller, or one that is already connected.
    pub fn connect(connection: &Connection) -> Result<Client, ClientError> {
        let folder = await_folder(connection)?;
        let named = folder.clone();
        Client::join(connection, folder).map_err(|cause| cause.of(&named))
    }

    fn join(connection: &Connection, folder: PathBuf) -> Result<Client, ClientError> {
        let session = Session::join_within(&folder, connection.limit)?;
        let scene = session_scene(&folder)?;
        let controller = controller_of(connection, &session, &scene)?;
        let info = Info {
            folder,
            controller_count: scene.controller.len(),
            lockstep: scene.run.mode == Mode::Lockstep,
            dt_s: scene.dt_s(),
            tick_count: scene.tick_count(),
            frame_period_ticks: scene.frame_period_ticks().unwrap_or(0),
            frame_columns: scene.drr.as_ref().map_or(0, |drr| drr.columns),
            frame_rows: scene.drr.as_ref().map_or(0, |drr| drr.rows),
            has_volume: scene.volume.is_some(),
            controller,
        };
        let index = info.controller.as_ref().map(|(_, index)| *index);
        Ok(Client {
            states: session.subscriber(&services::STATE)?,
            status: session.subscriber(&services::RUN_STATUS)?,
            waiter: index.map(|index| session.waiter(Reader::Controller(index))).transpose()?,
            physics: session.waker(Reader::Physics)?,
            // Last, because this claims the name.
            commands: info
                .controller
                .as_ref()
                .map(|(name, _)| session.command_publisher(name))
                .transpose()?,
            state: None,
            command: Box::new(Command::zeroed()),
            is_begun: false,
            sequence: 0,
            newest_tick: None,
            states_missed: 0,
            newest_status: None,
            hub_seen: Instant::now(),
            ended: None,
            control: None,
            events: None,
            event: None,
            remarks: None,
            removed: None,
            removal: None,
            readings: scene.has_readings().then(|| session.subscriber(&services::SENSOR)).transpose()?,
            reading: None,
            tip_jacobians: scene
                .has_tip_jacobian()
                .then(|| session.subscriber(&services::TIP_JACOBIAN))
                .transpose()?,
            tip_jacobian: None,
            frames: None,
            frame: None,
            requests: None,
            volumes: None,
            volume: None,
            session: ProcessOwned::new(session),
            scene,
            info,
        })
    }

    /// Whether this process created the connection, rather than a parent that forked it.
    pub(crate) fn is_ours(&self) -> bool {
        self.session.is_ours()
    }

    /// Fails in a child of the process that created the connection.
    pub(crate) fn check_process(&self) -> Result<(), ClientError> {
        if self.is_ours() { Ok(()) } else { Err(ClientError::Forked) }
    }

    /// Returns the constant properties of the session.
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Returns the newest state if one has arrived since the last call. Skips older ones and counts them
    /// ([`Client::states_missed`]). The state stays in shared memory, unchanged, until the next one is taken.
    ///
    /// # Errors
    /// [`ClientError::Ended`] after the last state; or a transport error.
    pub fn poll_state(&mut self) -> Result<Option<&State>, ClientError> {
        self.check_process()?;
        let mut came = false;
        while self.take_state()? {
            came = true;
        }
        if came {
            self.count_missed();
        } else {
            self.check_end()?;
        }
        Ok(self.state.as_ref().filter(|_| came).map(ReceivedMessage::message))
    }

    /// Waits for the newest state, like [`Client::poll_state`]: yields for 20 µs, then sleeps until woken.
    ///
    /// # Errors
    /// [`ClientError::TimedOut`], [`ClientError::Ended`] after the last state, [`ClientError::HubGone`]; or a
    /// transport error.
    pub fn wait_state(&mut self, limit: Duration) -> Result<&State, ClientError> {
        self.await_state(limit)?;
        while self.take_state()? {}
        self.count_missed();
        self.state.as_ref().map(ReceivedMessage::message).ok_or(ClientError::Ended)
    }

    /// Waits for the oldest state not yet taken, for clients that need every state. The queue holds 512
    /// states.
    ///
    /// # Errors
    /// Same as [`Client::wait_state`].
    pub fn next_state(&mut self, limit: Duration) -> Result<&State, ClientError> {
        self.await_state(limit)?;
        self.count_missed();
        self.state.as_ref().map(ReceivedMessage::message).ok_or(ClientError::Ended)
    }

    /// Waits for a state and takes the oldest one.
    fn await_state(&mut self, limit: Duration) -> Result<(), ClientError> {
        self.check_process()?;
        let deadline = Instant::now() + limit;
        loop {
            if self.take_state()? {
                return Ok(());
            }
            self.check_end()?;
            let now = Instant::now();
            if now >= deadline {
                return Err(ClientError::TimedOut(limit));
            }
            let slice = deadline.min(now + HUB_CHECK_PERIOD);
            let (states, status) = (&self.states, &self.status);
            let ready = || states.has_message() || status.has_message();
            match &self.waiter {
                Some(waiter) => {
                    waiter.wait_until(slice, ready);
                }
                None => poll_until(slice, ready),
            }
        }
    }

    /// Returns the last state taken.
    pub fn state(&self) -> Option<&State> {
        self.state.as_ref().filter(|_| self.is_ours()).map(ReceivedMessage::message)
    }

    /// Returns the number of states skipped or overwritten before this client took them.
    pub fn states_missed(&self) -> u64 {
        self.states_missed
    }

    fn take_state(&mut self) -> Result<bool, ClientError> {
        while let Some(state) = self.states.receive()? {
            if put(&mut self.state, state) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Counts the states between this one and the last one returned.
    fn count_missed(&mut self) {
        let Some(tick) = self.state.as_ref().map(|state| state.message().tick) else { return };
        if let Some(before) = self.newest_tick.replace(tick) {
            self.states_missed += tick.saturating_sub(before.saturating_add(1));
        }
    }

    /// Fails if no more states will arrive.
    fn check_end(&mut self) -> Result<(), ClientError> {
        // The last state is published before the status; it may have arrived since the queue was polled.
        if self.has_ended()? && !self.states.has_message() { Err(ClientError::Ended) } else { Ok(()) }
    }

    /// Whether the run is over. Fails if the hub is gone without announcing the end.
    pub(crate) fn has_ended(&mut self) -> Result<bool, ClientError> {
        if self.ended.is_some() {
            return Ok(true);
        }
        if self.status()?.is_some_and(|status| status.phase() == Ok(Phase::Ended)) {
            self.ended = Some(Instant::now());
            return Ok(true);
        }
        if self.hub_seen.elapsed() >= HUB_CHECK_PERIOD {
            if !self.session.host_is_alive() {
                return Err(ClientError::HubGone { folder: self.info.folder.clone() });
            }
            self.hub_seen = Instant::now();
        }
        Ok(false)
    }

    /// The session's name.
    pub fn session_name(&self) -> String {
        self.session.name()
    }

    /// Returns why the run is over, once [`ClientError::Ended`] has been returned: a controller that did not
    /// join or was late, by name; a stop; or its last tick.
    pub fn end_reason(&self) -> String {
        let name = self.session_name();
        let tick = self.newest_status.map_or(0, |status| status.tick);
        match self.session.blame() {
            Some(blame) => format!("session {name}: the run has ended: {}", blame.text),
            None if tick < self.info.tick_count => {
                format!("session {name}: the run was stopped at tick {tick} of {}", self.info.tick_count)
            }
            None => format!("session {name}: the run has ended after its last tick"),
        }
    }

    /// Returns the run's newest status, or `None` if none has arrived.
    ///
    /// # Errors
    /// A transport error.
    pub fn status(&mut self) -> Result<Option<RunStatus>, ClientError> {
        self.check_process()?;
        if let Some(status) = self.status.receive_newest()? {
            self.newest_status = Some(*status.message());
        }
        Ok(self.newest_status)
    }

    /// Returns the next command to send: every mode is "none", `sequence` and `state_tick` are filled in. The
    /// same command is returned until it is sent or discarded.
    ///
    /// # Errors
    /// [`ClientError::Observer`], [`ClientError::Forked`].
    pub fn command(&mut self) -> Result<&mut Command, ClientError> {
        self.check_process()?;
        if self.commands.is_none() {
            return Err(ClientError::Observer);
        }
        if !self.is_begun {
            let state_tick = self.newest_tick.unwrap_or(0);
            *self.command = Command { sequence: self.sequence + 1, state_tick, ..Command::zeroed() };
            self.is_begun = true;
        }
        Ok(&mut self.command)
    }

    /// Sends the current content of the command from [`Client::command`] and wakes the physics. After an
    /// error it can be sent again.
    ///
    /// # Errors
    /// [`ClientError::Misuse`] without a command, [`ClientError::Forked`]; or a transport error.
    pub fn send(&mut self) -> Result<(), ClientError> {
        self.check_process()?;
        let publisher = self.commands.as_ref().filter(|_| self.is_begun);
        publisher.ok_or(ClientError::Misuse("no command to send; request one first"))?.send(&self.command)?;
        self.is_begun = false;
        self.sequence = self.command.sequence;
        self.physics.wake();
        Ok(())
    }

    /// Discards the command being filled in, if any.
    pub fn discard_command(&mut self) {
        self.is_begun = false;
    }

    /// Waits for the newest state, calls `step` to fill in the command, and sends it.
    ///
    /// # Errors
    /// Same as [`Client::wait_state`] and [`Client::send`].
    pub fn answer(
        &mut self,
        limit: Duration,
        step: impl FnOnce(&State, &mut Command),
    ) -> Result<(), ClientError> {
        self.wait_state(limit)?;
        self.command()?;
        if let Some(state) = &self.state {
            step(state.message(), &mut self.command);
        }
        self.send()
    }

    /// Leaves the session, but keeps the messages given to the caller.
    pub(crate) fn leave(self) -> Kept {
        Kept {
            _state: self.state.map(|state| (state, self.states)),
            _event: self.event.zip(self.events),
            _removal: self.removal.zip(self.removed),
            _reading: self.reading.zip(self.readings),
            _tip_jacobian: self.tip_jacobian.zip(self.tip_jacobians),
            _frame: self.frame.zip(self.frames),
            _volume: self.volume.zip(self.volumes),
            _command: self.command,
        }
    }
}

/// The last message of each kind given to the caller, with its port; the memory is not reused before these
/// are dropped.
#[derive(Debug)]
pub(crate) struct Kept {
    _state: Option<(ReceivedMessage<State>, Subscriber<State>)>,
    _event: Option<(ReceivedMessage<Event>, Subscriber<Event>)>,
    _removal: Option<(ReceivedMessage<Removed>, Subscriber<Removed>)>,
    _reading: Option<(ReceivedMessage<SensorReading>, Subscriber<SensorReading>)>,
    _tip_jacobian: Option<(ReceivedMessage<TipJacobian>, Subscriber<TipJacobian>)>,
    _frame: Option<(ReceivedMessage<Frame>, Subscriber<Frame>)>,
    _volume: Option<(ReceivedMessage<Volume>, Subscriber<Volume>)>,
    _command: Box<Command>,
}

/// Replaces the held message with a new one. The old one is only released now: the caller may still be
/// reading it, and the memory of a departed sender is unmapped with its last message.
///
/// Returns false and skips the message if it has another sender. A session has one sender per held kind, and
/// another sender must not cause the caller's data to be unmapped.
pub(crate) fn put<M: Message>(held: &mut Option<ReceivedMessage<M>>, new: ReceivedMessage<M>) -> bool {
    let is_foreign = held.as_ref().is_some_and(|held| held.sender() != new.sender());
    if !is_foreign {
        *held = Some(new);
    }
    !is_foreign
}

/// Returns a request id unique among the session's clients, in all processes.
pub(crate) fn new_request_id() -> u64 {
    static COUNT: AtomicU64 = AtomicU64::new(1);
    let count = COUNT.fetch_add(1, Ordering::Relaxed) & u64::from(u32::MAX);
    (u64::from(std::process::id()) << 32) | count
}

/// Polls, sleeping in between.
pub(crate) fn poll_until(deadline: Instant, mut ready: impl FnMut() -> bool) {
    while !ready() && Instant::now() < deadline {
        std::thread::sleep(OBSERVER_POLL_PERIOD);
    }
}
