//! A program's connection to a session.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ipc_types::layout::Message;
use ipc_types::messages::{
    CONTROL_REFUSED, Command, DrrReply, DrrRequest, EVENT_CONTROLLER, Event, Frame, PHASE_ENDED, Removed,
    RunControl, RunControlReply, RunStatus, SENDER_CONTROLLER, State, Volume,
};
use ipc_types::own::Own;
use ipc_types::ports::{Publisher, Received, Subscriber};
use ipc_types::process::{EventSender, session_scene};
use ipc_types::scene::{Mode, Scene};
use ipc_types::services;
use ipc_types::session::{
    CONTROLLER_VARIABLE, Reader, SESSION_VARIABLE, Searched, Session, SessionId, host_is_alive,
    newest_session, running_sessions,
};
use ipc_types::wake::{Waiter, Waker};

use crate::error::ClientError;

/// How often a waiting client checks that the hub is alive.
const HUB_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Poll interval of an observer, which nobody wakes.
const OBSERVER_POLL_PERIOD: Duration = Duration::from_micros(200);
const RETRY_TIME: Duration = Duration::from_millis(10);
/// Longest wait a caller may request; longer ones overflow clocks.
const LONGEST_WAIT_S: f64 = 1e9;

/// Which session to join, and as which controller.
#[derive(Debug, Clone)]
pub struct Connection {
    /// The session's folder or name. `None` uses the folder in `TRABECULA_SESSION`, or else this user's session that was announced last.
    pub session: Option<String>,
    /// The controller's name in the scene, or empty for an observer, which sends no commands. `None` uses the name in
    /// `TRABECULA_CONTROLLER`, or else the scene's only external controller.
    pub controller: Option<String>,
    /// How long to wait for the session.
    pub limit: Duration,
}

impl Default for Connection {
    fn default() -> Self {
        Connection { session: None, controller: None, limit: Duration::from_secs(10) }
    }
}

impl Connection {
    /// An observer of the same session.
    pub fn observer() -> Connection {
        Connection { controller: Some(String::new()), ..Connection::default() }
    }
}

/// Facts that stay constant during a session.
#[derive(Debug, Clone, PartialEq)]
pub struct Info {
    /// Folder of the session.
    pub folder: PathBuf,
    /// Name and index of this client's controller; `None` for an observer.
    pub controller: Option<(String, usize)>,
    /// Number of controllers in the scene.
    pub controller_count: usize,
    /// Whether a tick waits for every controller.
    pub lockstep: bool,
    /// Simulated time of a tick.
    pub dt_s: f64,
    /// Ticks of the whole run.
    pub tick_count: u64,
    /// Ticks between two scheduled frames; 0 if there are none.
    pub frame_period_ticks: u64,
    /// Pixel columns of a frame; 0 without X-ray.
    pub frame_columns: u32,
    /// Pixel rows of a frame.
    pub frame_rows: u32,
    /// Whether there is a CT volume.
    pub has_volume: bool,
}

/// A connection. It belongs to the thread and process that made it: in a `fork` child every call fails with [`ClientError::Forked`], and
/// dropping it there disconnects nobody.
#[derive(Debug)]
pub struct Client {
    pub(crate) session: Own<Session>,
    pub(crate) scene: Scene,
    pub(crate) info: Info,
    states: Subscriber<State>,
    status: Subscriber<RunStatus>,
    waiter: Option<Waiter>,
    physics: Waker,
    commands: Option<Publisher<Command>>,
    state: Option<Received<State>>,
    /// Filled in by the caller and copied when sent, so later writes have no effect. Boxed, because callers of the C interface hold its
    /// address.
    command: Box<Command>,
    /// Whether a command has been requested and not yet sent.
    is_begun: bool,
    sequence: u64,
    newest_tick: Option<u64>,
    states_missed: u64,
    newest_status: Option<RunStatus>,
    hub_seen: Instant,
    /// When this client learned that the run is over.
    pub(crate) ended: Option<Instant>,
    control: Option<Control>,
    events: Option<Subscriber<Event>>,
    pub(crate) event: Option<Received<Event>>,
    remarks: Option<EventSender>,
    removed: Option<Subscriber<Removed>>,
    pub(crate) removal: Option<Received<Removed>>,
    pub(crate) frames: Option<Subscriber<Frame>>,
    pub(crate) frame: Option<Received<Frame>>,
    pub(crate) requests: Option<Requests>,
    pub(crate) volumes: Option<Subscriber<Volume>>,
    pub(crate) volume: Option<Received<Volume>>,
}

#[derive(Debug)]
struct Control {
    publisher: Publisher<RunControl>,
    replies: Subscriber<RunControlReply>,
    /// The newest request: its number and its action.
    asked: Option<(u64, u32)>,
    /// A request held back until the physics has been heard.
    unsent: Option<RunControl>,
}

#[derive(Debug)]
pub(crate) struct Requests {
    pub(crate) publisher: Publisher<DrrRequest>,
    pub(crate) replies: Subscriber<DrrReply>,
    pub(crate) drr: Waker,
    /// The newest request that the DRR process has accepted for rendering.
    pub(crate) accepted: u64,
}

/// A duration from a foreign caller's seconds.
pub(crate) fn limit_of(seconds: f64) -> Result<Duration, ClientError> {
    // Written so that NaN fails.
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
    /// No session within the limit, another layout or transport version (by name), a controller that the scene does not name or that is
    /// already connected.
    pub fn connect(connection: &Connection) -> Result<Client, ClientError> {
        let folder = await_folder(connection)?;
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
            // Last, because from here on the name is taken.
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
            frames: None,
            frame: None,
            requests: None,
            volumes: None,
            volume: None,
            session: Own::new(session),
            scene,
            info,
        })
    }

    /// Whether this process made the connection, rather than a parent that forked it.
    pub(crate) fn is_ours(&self) -> bool {
        self.session.is_ours()
    }

    /// Fails in a child of the process that made the connection.
    pub(crate) fn check_process(&self) -> Result<(), ClientError> {
        if self.is_ours() { Ok(()) } else { Err(ClientError::Forked) }
    }

    /// Facts that stay constant during the session.
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The newest state, if one has arrived since the last call. Skips older ones and counts them ([`Client::states_missed`]). The state
    /// stays in shared memory, unchanged, until the next one is taken.
    ///
    /// # Errors
    /// [`ClientError::Ended`] after the last state; the transport's.
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
        Ok(self.state.as_ref().filter(|_| came).map(Received::message))
    }

    /// Waits for the newest state, as [`Client::poll_state`] returns it: yields for 20 µs, then sleeps until woken.
    ///
    /// # Errors
    /// [`ClientError::TimedOut`], [`ClientError::Ended`] after the last state, [`ClientError::HubGone`]; the transport's.
    pub fn wait_state(&mut self, limit: Duration) -> Result<&State, ClientError> {
        self.await_state(limit)?;
        while self.take_state()? {}
        self.count_missed();
        self.state.as_ref().map(Received::message).ok_or(ClientError::Ended)
    }

    /// Waits for the oldest state not yet taken, for clients that need every state. The queue holds 512.
    ///
    /// # Errors
    /// As [`Client::wait_state`].
    pub fn next_state(&mut self, limit: Duration) -> Result<&State, ClientError> {
        self.await_state(limit)?;
        self.count_missed();
        self.state.as_ref().map(Received::message).ok_or(ClientError::Ended)
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

    /// The last state taken.
    pub fn state(&self) -> Option<&State> {
        self.state.as_ref().filter(|_| self.is_ours()).map(Received::message)
    }

    /// States that were skipped or overwritten before this client took them.
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

    /// Fails if no more states will come.
    fn check_end(&mut self) -> Result<(), ClientError> {
        // The last state is published before the status; it may have arrived since the queue was polled.
        if self.has_ended()? && !self.states.has_message() { Err(ClientError::Ended) } else { Ok(()) }
    }

    /// Whether the run is over. Fails if the hub is gone without announcing the end.
    pub(crate) fn has_ended(&mut self) -> Result<bool, ClientError> {
        if self.ended.is_some() {
            return Ok(true);
        }
        if self.status()?.is_some_and(|status| status.phase == PHASE_ENDED) {
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

    /// The run's newest status, if one has arrived.
    ///
    /// # Errors
    /// The transport's.
    pub fn status(&mut self) -> Result<Option<RunStatus>, ClientError> {
        self.check_process()?;
        if let Some(status) = self.status.receive_newest()? {
            self.newest_status = Some(*status.message());
        }
        Ok(self.newest_status)
    }

    /// The next command to send: every mode at "none", `sequence` and `state_tick` filled in. Returns the same one until it is sent or
    /// discarded.
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

    /// Sends the command from [`Client::command`] as it is now, and wakes the physics. After an error it can be sent again.
    ///
    /// # Errors
    /// [`ClientError::Misuse`] without a command, [`ClientError::Forked`]; the transport's.
    pub fn send(&mut self) -> Result<(), ClientError> {
        self.check_process()?;
        let publisher = self.commands.as_ref().filter(|_| self.is_begun);
        publisher.ok_or(ClientError::Misuse("no command to send; ask for one first"))?.send(&self.command)?;
        self.is_begun = false;
        self.sequence = self.command.sequence;
        self.physics.wake();
        Ok(())
    }

    /// Discards the command being filled in, if any.
    pub fn discard_command(&mut self) {
        self.is_begun = false;
    }

    /// Waits for the newest state, lets the callback answer it, and sends the answer.
    ///
    /// # Errors
    /// As [`Client::wait_state`] and [`Client::send`].
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

    /// Sends a run-control request (one of the `CONTROL_` constants; `ticks` is for a step) and waits for the reply.
    ///
    /// # Errors
    /// [`ClientError::ControlRefused`], [`ClientError::TimedOut`], [`ClientError::Ended`]; the transport's.
    pub fn run_control(
        &mut self,
        action: u32,
        ticks: u64,
        limit: Duration,
    ) -> Result<RunControlReply, ClientError> {
        self.check_process()?;
        let control = match &mut self.control {
            Some(control) => control,
            none => none.insert(Control {
                publisher: self.session.publisher(&services::RUN_CONTROL)?,
                // Replies to other clients must not push out the one to this client.
                replies: self.session.lossless_subscriber(&services::RUN_CONTROL_REPLY)?,
                asked: None,
                unsent: None,
            }),
        };
        let request_id = new_request_id();
        control.unsent = Some(RunControl { request_id, ticks, action, reserved: 0 });
        control.asked = Some((request_id, action));
        self.await_control(limit)
    }

    /// Continues to wait for the reply to the last request, after a timeout.
    ///
    /// # Errors
    /// [`ClientError::Misuse`] if no reply is due; otherwise as [`Client::run_control`].
    pub fn await_control(&mut self, limit: Duration) -> Result<RunControlReply, ClientError> {
        let deadline = Instant::now() + limit;
        loop {
            // The reply is published before the end: if it is not here by then, it never will be.
            let ended = self.has_ended()?;
            let control =
                self.control.as_mut().and_then(|control| control.asked.map(|asked| (control, asked)));
            let Some((control, (request_id, action))) = control else {
                return Err(ClientError::Misuse("no action has been asked for whose answer is due"));
            };
            // The physics announces itself first; a request sent before that is lost.
            if self.newest_status.is_some()
                && let Some(request) = control.unsent.take()
            {
                control.publisher.send(&request)?;
                self.physics.wake();
            }
            while let Some(reply) = control.replies.receive()? {
                let reply = *reply.message();
                if reply.request_id == request_id {
                    control.asked = None;
                    let refused = reply.status == CONTROL_REFUSED;
                    return if refused { Err(ClientError::ControlRefused { action }) } else { Ok(reply) };
                }
            }
            if ended {
                return Err(ClientError::Ended);
            }
            if Instant::now() >= deadline {
                return Err(ClientError::TimedOut(limit));
            }
            std::thread::sleep(OBSERVER_POLL_PERIOD);
        }
    }

    /// The oldest event not yet taken. Events are queued from this client's first call on. The event stays in shared memory until the next
    /// one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; the transport's.
    pub fn next_event(&mut self) -> Result<Option<(&Event, &str)>, ClientError> {
        self.check_process()?;
        if self.events.is_none() {
            self.events = Some(self.session.subscriber(&services::EVENT)?);
        }
        let Some(event) = self.events.as_ref().map_or(Ok(None), |events| events.receive_valid(|_| {}))?
        else {
            return Ok(None);
        };
        let event = &*self.event.insert(event);
        Ok(Some((event.message(), event_text(event))))
    }

    /// Adds a line to the session's events, which the log records.
    ///
    /// # Errors
    /// [`ClientError::Observer`]; the transport's.
    pub fn remark(&mut self, severity: u32, text: &str) -> Result<(), ClientError> {
        self.check_process()?;
        let (_, index) = self.info.controller.as_ref().ok_or(ClientError::Observer)?;
        if self.remarks.is_none() {
            self.remarks = Some(EventSender::new(&self.session, SENDER_CONTROLLER + *index as u32)?);
        }
        let tick = self.newest_tick.unwrap_or(0);
        if let Some(remarks) = &mut self.remarks {
            remarks.send(tick, severity, EVENT_CONTROLLER, text)?;
        }
        Ok(())
    }

    /// The oldest message about removed voxels not yet taken, with the voxels' indices in place. Messages are queued from this client's
    /// first call on. The message stays in shared memory until the next one is returned.
    ///
    /// # Errors
    /// [`ClientError::Forked`]; the transport's.
    pub fn next_removed(&mut self) -> Result<Option<&Received<Removed>>, ClientError> {
        self.check_process()?;
        if self.removed.is_none() {
            self.removed = Some(self.session.subscriber(&services::REMOVED)?);
        }
        while let Some(removal) = self.removed.as_ref().map_or(Ok(None), Subscriber::receive)? {
            if put(&mut self.removal, removal) {
                return Ok(self.removal.as_ref());
            }
        }
        Ok(None)
    }

    /// Leaves the session, but keeps what the caller has been given.
    pub(crate) fn leave(self) -> Kept {
        Kept {
            _state: self.state.map(|state| (state, self.states)),
            _event: self.event.zip(self.events),
            _removal: self.removal.zip(self.removed),
            _frame: self.frame.zip(self.frames),
            _volume: self.volume.zip(self.volumes),
            _command: self.command,
        }
    }
}

/// The last message of each kind given to the caller, and its port: the memory is not reused before these are dropped.
#[derive(Debug)]
pub(crate) struct Kept {
    _state: Option<(Received<State>, Subscriber<State>)>,
    _event: Option<(Received<Event>, Subscriber<Event>)>,
    _removal: Option<(Received<Removed>, Subscriber<Removed>)>,
    _frame: Option<(Received<Frame>, Subscriber<Frame>)>,
    _volume: Option<(Received<Volume>, Subscriber<Volume>)>,
    _command: Box<Command>,
}

/// Replaces the held message with a new one. Only now is the old one released: the caller may still be reading it, and the memory of a
/// departed sender is unmapped with its last message.
///
/// Returns false and skips the message if it has another sender. A session has one sender of each held kind, and a stranger in its place
/// must not unmap what the caller is reading.
pub(crate) fn put<M: Message>(held: &mut Option<Received<M>>, new: Received<M>) -> bool {
    let is_foreign = held.as_ref().is_some_and(|held| held.sender() != new.sender());
    if !is_foreign {
        *held = Some(new);
    }
    !is_foreign
}

/// The text of an event, in place. Its sender is another process, so invalid UTF-8 is shown as empty.
pub(crate) fn event_text(event: &Received<Event>) -> &str {
    let bytes = event.tail();
    std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).unwrap_or("")
}

/// A request number unique among the session's clients, in all processes.
pub(crate) fn new_request_id() -> u64 {
    static COUNT: AtomicU64 = AtomicU64::new(1);
    let count = COUNT.fetch_add(1, Ordering::Relaxed) & u64::from(u32::MAX);
    (u64::from(std::process::id()) << 32) | count
}

/// Polls with sleeps in between.
pub(crate) fn poll_until(deadline: Instant, mut ready: impl FnMut() -> bool) {
    while !ready() && Instant::now() < deadline {
        std::thread::sleep(OBSERVER_POLL_PERIOD);
    }
}

fn await_folder(connection: &Connection) -> Result<PathBuf, ClientError> {
    let given = connection.session.clone().filter(|text| !text.is_empty());
    let from_environment = || std::env::var(SESSION_VARIABLE).ok().filter(|text| !text.is_empty());
    let named = given.or_else(from_environment);
    if let Some(given) = &named {
        SessionId::can_be(Path::new(given))?;
    }
    // A path is one folder; a name may be in any of this user's places.
    let look = || match &named {
        Some(path) if path.contains('/') => Some(PathBuf::from(path)).filter(|folder| host_is_alive(folder)),
        Some(name) => running_sessions(Some(name)).pop(),
        None => newest_session(),
    };
    let end = Instant::now() + connection.limit;
    loop {
        if let Some(folder) = look() {
            return Ok(folder);
        }
        if Instant::now() >= end {
            let searched = match &named {
                Some(path) if path.contains('/') => Searched::folder(Path::new(path)),
                named => Searched::places(named.as_deref()),
            };
            return Err(ClientError::NoSession { searched });
        }
        std::thread::sleep(RETRY_TIME);
    }
}

fn controller_of(
    connection: &Connection,
    session: &Session,
    scene: &Scene,
) -> Result<Option<(String, usize)>, ClientError> {
    let from_environment = || std::env::var(CONTROLLER_VARIABLE).ok();
    let name = match connection.controller.clone().or_else(from_environment) {
        Some(name) if name.is_empty() => return Ok(None),
        Some(name) => name,
        None => {
            let mut external = scene.controller.iter().filter(|controller| controller.external);
            match (external.next(), external.count()) {
                (Some(only), 0) => only.name.clone(),
                (first, more) => {
                    let external = usize::from(first.is_some()) + more;
                    let known = scene.controller_names().join(", ");
                    return Err(ClientError::WhichController { external, known });
                }
            }
        }
    };
    let index = session.controller_index(&name)?;
    Ok(Some((name, index)))
}
