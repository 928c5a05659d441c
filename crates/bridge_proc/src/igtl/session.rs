//! The bridge's side of the session.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use ipc_types::messages::{ControlAction, RunStatus, SensorReading, State};
use ipc_types::scene::{Drives, ToolRadii};
use openigtlink::{Message, StatusCode, Timestamp};
use trabecula_client::{Client, ClientError, Connection};

use super::incoming::Request;
use super::outgoing;
use super::peer::Peer;
use super::peers::PeerRequest;
use super::plan::{Follower, Speeds};
use super::{IgtlError, IgtlOptions};
use crate::{newest_clearances, own_controller};

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
    /// The peer whose goal or plan the arm follows.
    planner: Weak<Peer>,
    radii: ToolRadii,
    slow_due: Instant,
    /// Tick of the newest state that was sent.
    sent_tick: Option<u64>,
    /// Newest clearances from critical structures.
    clearances: Option<SensorReading>,
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
        let drives = own_controller(&client).map_or(Vec::new(), |controller| controller.drives.clone());
        Ok(IgtlSession {
            client,
            follower: Follower::new(speeds, drives),
            planner: Weak::new(),
            radii,
            slow_due: Instant::now(),
            sent_tick: None,
            clearances: None,
        })
    }

    /// Receives the newest state and, as a controller, answers it. Returns whether the run continues.
    pub(crate) fn advance(&mut self) -> Result<bool, IgtlError> {
        let (follower, mut gave_up) = (&mut self.follower, false);
        let outcome = if self.client.info().controller.is_some() {
            self.client.answer(TURN, |state, command| gave_up |= follower.fill(state, command))
        } else {
            self.client.wait_state(TURN).map(|_| ())
        };
        if gave_up && let Some(peer) = self.planner.upgrade() {
            let why = "the arm cannot reach the goal: it is abandoned; arm held, burr off";
            peer.answer("Trabecula", StatusCode::Unknown, why);
        }
        match outcome {
            Ok(()) | Err(ClientError::TimedOut(_)) => Ok(true),
            Err(ClientError::Ended) => Ok(false),
            Err(other) => Err(other.into()),
        }
    }

    /// Returns the scene's points, the planned path and the present pose, for a peer that has just connected:
    /// while the run is paused, nothing else follows.
    pub(crate) fn introduction(&self, now: Timestamp) -> Vec<Message> {
        let scene = self.client.scene();
        let mut messages = vec![outgoing::scene_points(scene, now)];
        messages.extend(outgoing::planned_path(scene, now));
        if let Some(state) = self.client.state() {
            messages.extend(outgoing::poses(state, now));
            messages.push(outgoing::tool(state, &self.radii, now));
        }
        messages
    }

    /// Returns the messages for everything that has changed since the last call.
    pub(crate) fn outgoing(&mut self, now: Timestamp) -> Vec<Message> {
        let mut messages = Vec::new();
        let status = self.client.status().ok().flatten();
        self.clearances = newest_clearances(&mut self.client).or(self.clearances);
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
                messages.push(self.figures(state, status.as_ref(), now));
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
        messages.extend(self.client.state().map(|state| self.figures(state, status.as_ref(), now)));
        messages
    }

    fn figures(&self, state: &State, status: Option<&RunStatus>, now: Timestamp) -> Message {
        let clearances = self.clearances.as_ref();
        let least = clearances.and_then(|reading| outgoing::least_clearance(self.client.scene(), reading));
        outgoing::figures(state, status, least, now)
    }

    /// Executes a permitted request and answers it.
    pub(crate) fn obey(&mut self, asked: &PeerRequest) {
        match self.act(asked) {
            Ok(done) => asked.peer.answer("Trabecula", StatusCode::Ok, done),
            Err((code, why)) => asked.peer.refuse(code, &why),
        }
    }

    fn act(&mut self, asked: &PeerRequest) -> Result<&'static str, (StatusCode, String)> {
        let failed = |error: ClientError| (StatusCode::NotReady, error.to_string());
        match &asked.request {
            Request::Token(_) => return Ok("token"),
            Request::Pause => self.control(ControlAction::Pause).map_err(failed)?,
            Request::Resume => self.control(ControlAction::Resume).map_err(failed)?,
            Request::Stop => self.control(ControlAction::Stop).map_err(failed)?,
            Request::Frame(pose) => {
                self.client.request_frame(Some(pose), 0).map_err(failed)?;
                return Ok("X-ray requested");
            }
            Request::Halt => {
                self.drives(&[Drives::Arm, Drives::Burr])?;
                self.follower.halt();
                return Ok("arm held, burr off");
            }
            Request::BaseGoal(goal) => {
                self.drives(&[Drives::Arm])?;
                self.follower.go(*goal);
                self.planner = Arc::downgrade(&asked.peer);
                return Ok("goal accepted");
            }
            Request::Plan { entry_m, target_m } => {
                self.drives(&[Drives::Arm])?;
                let not_ready = || (StatusCode::NotReady, "no state received yet".to_owned());
                let state = self.client.state().ok_or_else(not_ready)?;
                let refuse = |why| (StatusCode::Unknown, why);
                self.follower.plan(*entry_m, *target_m, state).map_err(refuse)?;
                self.planner = Arc::downgrade(&asked.peer);
                return Ok("plan accepted");
            }
        }
        Ok("done")
    }

    fn control(&mut self, action: ControlAction) -> Result<(), ClientError> {
        self.client.run_control(action.code(), 0, CONTROL_LIMIT).map(|_| ())
    }

    /// Checks that the bridge drives one of these parts of the tool.
    fn drives(&self, parts: &[Drives]) -> Result<(), (StatusCode, String)> {
        if parts.iter().any(|part| self.follower.drives(*part)) {
            return Ok(());
        }
        let why = match &self.client.info().controller {
            Some((name, _)) => {
                let name = foreign_text::foreign(name);
                format!("controller {name} does not drive the arm; add \"arm\" to its `drives` in the scene")
            }
            None => "this bridge does not drive the arm; start it with --controller and a controller of the \
                     scene"
                .to_owned(),
        };
        Err((StatusCode::ManualMode, why))
    }
}
