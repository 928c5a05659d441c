//! A client of a running session, like a user's own program.

use std::path::Path;
use std::time::{Duration, Instant};

use ipc_types::messages::services;
use ipc_types::messages::{CONTROL_STOP, Command, Event, RunControl, RunControlReply, RunStatus, State};
use ipc_types::ports::{Publisher, Subscriber};
use ipc_types::session::{Reader, Session};
use ipc_types::wake::Waker;

use super::program::{Ended, LIMIT, Run, wait_for};

/// Observes and steers a run.
pub struct Client {
    pub session: Session,
    pub states: Subscriber<State>,
    pub status: Subscriber<RunStatus>,
    events: Subscriber<Event>,
    control: Publisher<RunControl>,
    replies: Subscriber<RunControlReply>,
    physics: Waker,
    requests: std::cell::Cell<u64>,
}

impl Client {
    pub fn join(folder: &Path) -> Client {
        let session = Session::join(folder).unwrap();
        Client {
            states: session.subscriber(&services::STATE).unwrap(),
            status: session.subscriber(&services::RUN_STATUS).unwrap(),
            events: session.subscriber(&services::EVENT).unwrap(),
            control: session.publisher(&services::RUN_CONTROL).unwrap(),
            replies: session.lossless_subscriber(&services::RUN_CONTROL_REPLY).unwrap(),
            physics: session.waker(Reader::Physics).unwrap(),
            requests: std::cell::Cell::new(1000),
            session,
        }
    }

    /// Joins a run and waits for a tick.
    pub fn at(run: &Run, tick: u64) -> Client {
        let client = Client::join(&run.session());
        client.wait_for_state(|state| state.tick >= tick);
        client
    }

    /// Stops the run, which must succeed.
    pub fn stop(self, run: Run) -> Ended {
        self.ask(CONTROL_STOP, 0);
        drop(self);
        run.end_well()
    }

    /// Waits for a state that satisfies a condition, and returns it.
    pub fn wait_for_state(&self, wanted: impl Fn(&State) -> bool) -> State {
        wait_for("a state", || {
            let mut found = None;
            while let Some(state) = self.states.receive().unwrap() {
                if wanted(state.message()) {
                    found = Some(*state.message());
                    break;
                }
            }
            found
        })
    }

    /// Returns the next state, if one arrives within the limit.
    pub fn next_state_within(&self, limit: Duration) -> Option<State> {
        let end = Instant::now() + limit;
        loop {
            if let Some(state) = self.states.receive().unwrap() {
                return Some(*state.message());
            }
            if Instant::now() >= end {
                return None;
            }
            std::thread::yield_now();
        }
    }

    /// Requests an action and waits for the reply.
    pub fn ask(&self, action: u32, ticks: u64) -> RunControlReply {
        // Polling connects this client to a physics that started after it. Otherwise the physics may answer
        // and end before the first poll.
        while self.replies.receive().unwrap().is_some() {}
        let request_id = self.requests.get();
        self.requests.set(request_id + 1);
        self.control.send(&RunControl { request_id, ticks, action, reserved: 0 }).unwrap();
        self.physics.wake();
        wait_for("a reply to run control", || {
            // All replies queued: a program that floods run control is answered, too.
            let replies =
                std::iter::from_fn(|| self.replies.receive().unwrap().map(|reply| *reply.message()));
            replies.into_iter().find(|reply| reply.request_id == request_id)
        })
    }

    /// Returns all events since the last call: code and text.
    pub fn events(&self) -> Vec<(u32, String)> {
        let mut all = Vec::new();
        while let Some(event) = self.events.receive().unwrap() {
            let text = event.tail().strip_suffix(&[0]).unwrap();
            all.push((event.message().code, String::from_utf8(text.to_vec()).unwrap()));
        }
        all
    }
}

/// Opens a port of the transport itself, bypassing our library, which does not open a part's port.
pub fn bare_port(session: &Session, service: &str, bytes: usize) -> BarePort {
    let service = session.node().service_builder(&service.try_into().unwrap()).publish_subscribe::<[u8]>();
    service.open().unwrap().publisher_builder().initial_max_slice_len(bytes).create().unwrap()
}

pub type BarePort = iceoryx2::port::publisher::Publisher<iceoryx2::prelude::ipc::Service, [u8], ()>;

/// Sends bytes over the port.
pub fn send_bare(port: &BarePort, bytes: &[u8]) {
    port.loan_slice_uninit(bytes.len()).unwrap().write_from_slice(bytes).send().unwrap();
}

/// A controller driven by the test itself.
pub struct Pilot {
    pub client: Client,
    pub commands: Publisher<Command>,
    pub sequence: u64,
}

impl Pilot {
    pub fn join(folder: &Path, name: &str) -> Pilot {
        let client = Client::join(folder);
        let commands = client.session.command_publisher(name).unwrap();
        Pilot { client, commands, sequence: 0 }
    }

    /// Returns the next state.
    pub fn next_state(&self) -> State {
        self.client.next_state_within(LIMIT).expect("a state")
    }

    /// Sends a command unchanged.
    pub fn send(&self, command: &Command) {
        self.commands.send(command).unwrap();
        self.client.physics.wake();
    }

    /// Answers a state with the next sequence number.
    pub fn answer(&mut self, state: &State, command: Command) {
        self.sequence += 1;
        self.send(&Command { sequence: self.sequence, state_tick: state.tick, ..command });
    }

    /// Answers every state before that of `tick`, which it returns unanswered.
    pub fn drive_to(&mut self, tick: u64, command: impl Fn(&State) -> Command) -> State {
        loop {
            let state = self.next_state();
            if state.tick == tick {
                return state;
            }
            let command = command(&state);
            self.answer(&state, command);
        }
    }
}
