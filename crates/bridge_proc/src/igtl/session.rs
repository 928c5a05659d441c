//! The bridge's side of the session.

use std::time::{Duration, Instant};

use ipc_types::messages::ControlAction;
use ipc_types::scene::ToolRadii;
use openigtlink::{Message, StatusCode, Timestamp};
use trabecula_client::{Client, ClientError, Connection};

use super::connection::PeerRequest;
use super::incoming::Request;
use super::outgoing;
use super::plan::{Follower, Speeds};
use super::{IgtlError, IgtlOptions, Permission};

/// How long one turn of the loop waits for a state.
const TURN: Duration = Duration::from_millis(5);
/// Timeout for a reply of run control.
const CONTROL_LIMIT: Duration = Duration::from_secs(2);
/// Interval between two surfaces of the tool, and between two lines of figures.
const SLOW_PERIOD: Duration = Duration::from_millis(200);

#[derive(Debug)]
pub(crate) struct IgtlSession {
    client: Client,
    follower: Follower,
    radii: ToolRadii,
    slow_due: Instant,
    /// Tick of the newest state that was sent.
    sent_tick: Option<u64>,
}

impl IgtlSession {
    pub(crate) fn connect(options: &IgtlOptions, speeds: Speeds) -> Result<IgtlSession, IgtlError> {
        let connection = Connection {
            session: options.session.clone(),
            controller: Some(options.controller.clone().unwrap_or_default()),
            ..Connection::default()
        };
        let client = Client::connect(&connection)?;
        let radii = client.scene().manipulator.radii();
        Ok(IgtlSession {
            client,
            follower: Follower::new(speeds),
            radii,
            slow_due: Instant::now(),
            sent_tick: None,
        })
    }

    /// Receives the newest state and, as a controller, answers it. Returns whether the run continues.
    pub(crate) fn advance(&mut self) -> Result<bool, IgtlError> {
        let follower = &mut self.follower;
        let outcome = if self.client.info().controller.is_some() {
            self.client.answer(TURN, |state, command| follower.fill(state, command))
        } else {
            self.client.wait_state(TURN).map(|_| ())
        };
        match outcome {
            Ok(()) | Err(ClientError::TimedOut(_)) => Ok(true),
            Err(ClientError::Ended) => Ok(false),
            Err(other) => Err(other.into()),
        }
    }

    /// Returns the scene's points and planned path, for a peer that has just connected.
    pub(crate) fn introduction(&self, now: Timestamp) -> impl Iterator<Item = Message> + use<> {
        let scene = self.client.scene();
        [Some(outgoing::scene_points(scene, now)), outgoing::planned_path(scene, now)].into_iter().flatten()
    }

    /// Returns the messages for everything that has changed since the last call.
    pub(crate) fn outgoing(&mut self, now: Timestamp) -> Vec<Message> {
        let mut messages = Vec::new();
        let status = self.client.status().ok().flatten();
        let slow = Instant::now() >= self.slow_due;
        if slow {
            self.slow_due = Instant::now() + SLOW_PERIOD;
        }
        if let Some(state) = self.client.state() {
            if self.sent_tick != Some(state.tick) {
                self.sent_tick = Some(state.tick);
                messages = outgoing::poses(state, now);
                if slow {
                    messages.push(outgoing::tool(state, &self.radii, now));
                }
            }
            if slow {
                messages.push(outgoing::figures(state, status.as_ref(), now));
            }
        }
        messages.extend(self.frames(now));
        messages
    }

    /// Returns the newest scheduled frame and the newest requested one. A scheduled frame never replaces a
    /// requested one: it shows another pose.
    fn frames(&mut self, now: Timestamp) -> impl Iterator<Item = Message> + use<> {
        let (mut scheduled, mut asked_for) = (None, None);
        // Older queued frames are of no use to a peer.
        while let Ok(view) = self.client.wait_frame(0, Duration::ZERO) {
            let newest = if view.frame.request_id == 0 { &mut scheduled } else { &mut asked_for };
            *newest = outgoing::x_ray(view.frame, view.pixels, now);
        }
        scheduled.into_iter().chain(asked_for)
    }

    /// Returns the messages that announce the end of the run to all peers.
    pub(crate) fn last_words(&mut self, now: Timestamp) -> Vec<Message> {
        let mut messages = self.outgoing(now);
        let status = self.client.status().ok().flatten();
        messages.extend(self.client.state().map(|state| outgoing::figures(state, status.as_ref(), now)));
        messages
    }

    /// Executes a peer's request, if permitted, and answers it.
    pub(crate) fn obey(&mut self, asked: &PeerRequest, permission: &Permission) {
        let peer = &asked.peer;
        if let Request::Token(given) = &asked.request {
            return match permission {
                Permission::Token(token) if is_same(token, given) => {
                    let _ = peer.may_control.set(());
                    peer.answer("Token", StatusCode::Ok, "control granted to this connection");
                }
                Permission::Anyone => peer.answer("Token", StatusCode::Ok, "no token required"),
                _ => peer.refuse(StatusCode::AccessDenied, "Token: wrong token"),
            };
        }
        if peer.may_control.get().is_none() {
            let why = match permission {
                Permission::WatchOnly => {
                    "this bridge is read-only; start it with --control-token-file or --control-by-anyone"
                }
                _ => "send the control token first, as a STRING named Token",
            };
            return peer.refuse(StatusCode::AccessDenied, why);
        }
        match self.act(&asked.request) {
            Ok(done) => peer.answer("Trabecula", StatusCode::Ok, done),
            Err((code, why)) => peer.refuse(code, &why),
        }
    }

    fn act(&mut self, request: &Request) -> Result<&'static str, (StatusCode, String)> {
        let failed = |error: ClientError| (StatusCode::NotReady, error.to_string());
        match request {
            Request::Token(_) => return Ok("token"),
            Request::Pause => self.control(ControlAction::Pause).map_err(failed)?,
            Request::Resume => self.control(ControlAction::Resume).map_err(failed)?,
            Request::Stop => self.control(ControlAction::Stop).map_err(failed)?,
            Request::Frame(pose) => {
                self.client.request_frame(Some(pose), 0).map_err(failed)?;
                return Ok("X-ray requested");
            }
            Request::Halt => {
                self.drives()?;
                self.follower.halt();
                return Ok("arm held, burr off");
            }
            Request::BaseGoal(goal) => {
                self.drives()?;
                self.follower.go(*goal);
                return Ok("goal accepted");
            }
            Request::Plan { entry_m, target_m } => {
                self.drives()?;
                let not_ready = || (StatusCode::NotReady, "no state received yet".to_owned());
                let state = self.client.state().ok_or_else(not_ready)?;
                let refuse = |why| (StatusCode::Unknown, why);
                self.follower.plan(*entry_m, *target_m, state).map_err(refuse)?;
                return Ok("plan accepted");
            }
        }
        Ok("done")
    }

    fn control(&mut self, action: ControlAction) -> Result<(), ClientError> {
        self.client.run_control(action.code(), 0, CONTROL_LIMIT).map(|_| ())
    }

    fn drives(&self) -> Result<(), (StatusCode, String)> {
        if self.client.info().controller.is_some() {
            return Ok(());
        }
        let why = "this bridge does not drive the arm; start it with --controller and a controller of the \
                   scene";
        Err((StatusCode::ManualMode, why.into()))
    }
}

/// Compares in constant time, so that the duration does not reveal where the tokens differ.
fn is_same(token: &str, given: &str) -> bool {
    let differ = token.bytes().zip(given.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
    token.len() == given.len() && differ == 0
}
