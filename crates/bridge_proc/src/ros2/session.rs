//! The bridge's side of the session.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use ipc_types::messages::{ControlAction, Phase, Severity};
use ros_interface::commander::{Commander, OperatingState};
use ros_interface::image::{self, ImageForm};
use ros_interface::incoming::{self, CommandedJoints, Request, RequestError, StateCommand};
use ros_interface::outgoing;
use ros_interface::robot::Robot;
use ros_interface::topics::{INPUTS, Input, Names};
use ros_interface::urdf;
use rustdds::GUID;
use trabecula_client::{Client, ClientError, Connection};

use super::node::{Incoming, Node};
use super::notices::Notices;
use super::{Ros2Error, Ros2Options};
use crate::own_controller;

/// How long one turn of the loop waits for a state.
const TURN: Duration = Duration::from_millis(5);
/// Shortest interval between two polls of the subscriptions.
const LOOK_PERIOD: Duration = Duration::from_millis(1);
/// Timeout for a reply of run control.
const CONTROL_LIMIT: Duration = Duration::from_secs(2);
/// How often an unchanged state, as in a pause, is sent again.
const REPEAT_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of publishers whose disconnection is monitored.
const MOST_COMMANDING: usize = 64;

#[derive(Debug)]
pub(crate) struct Ros2Session {
    client: Client,
    names: Names,
    form: ImageForm,
    robot: Option<Robot>,
    commander: Commander,
    /// Publishers whose motion commands were executed.
    commanding: BTreeSet<GUID>,
    start: Instant,
    looked: Instant,
    /// Tick of the newest state that was sent, and when.
    sent: Option<(u64, Instant)>,
    /// The operating state and whether it was busy, as last sent.
    told: Option<(OperatingState, bool)>,
    /// Velocities that timed out, to be reported.
    ran_out: Option<&'static str>,
}

impl Ros2Session {
    pub(crate) fn connect(options: &Ros2Options) -> Result<Ros2Session, Ros2Error> {
        let connection = Connection {
            session: options.session.clone(),
            controller: Some(options.controller.clone().unwrap_or_default()),
            ..Connection::default()
        };
        let now = Instant::now();
        Ok(Ros2Session {
            client: Client::connect(&connection)?,
            names: options.names.clone(),
            form: options.image,
            robot: None,
            commander: Commander::default(),
            commanding: BTreeSet::new(),
            start: now,
            looked: now,
            sent: None,
            told: None,
            ran_out: None,
        })
    }

    /// Returns whether a state has been received, so that the robot is known.
    pub(crate) fn has_begun(&self) -> bool {
        self.client.state().is_some()
    }

    /// Returns the topics that can command this controller; empty for an observer.
    pub(crate) fn inputs(&self) -> Vec<Input> {
        let Some(controller) = own_controller(&self.client) else { return Vec::new() };
        let may = |input: Input| input.needs().is_none_or(|part| controller.drives.contains(&part));
        INPUTS.iter().map(|row| row.topic).filter(|input| may(*input)).collect()
    }

    /// Publishes the messages that do not change during the session.
    pub(crate) fn introduce(&mut self, node: &mut Node) -> Result<(), Ros2Error> {
        let (scene, Some(state)) = (self.client.scene(), self.client.state()) else { return Ok(()) };
        let robot = Robot::new(scene, state, self.names.clone());
        let urdf =
            urdf::describe(scene, &robot).map_err(|cause| Ros2Error::Description(cause.to_string()))?;
        node.publish(outgoing::of_session(&robot, urdf));
        self.robot = Some(robot);
        Ok(())
    }

    /// Receives the newest state and, as a controller, answers it. Returns whether the run continues.
    pub(crate) fn advance(&mut self) -> Result<bool, Ros2Error> {
        self.advance_until(Instant::now() + TURN)
    }

    /// Like `advance`; an observer sleeps until `due` if that is soon, since it needs no state in between.
    pub(crate) fn advance_until(&mut self, due: Instant) -> Result<bool, Ros2Error> {
        let outcome = if self.client.info().controller.is_some() {
            let (commander, ran_out) = (&mut self.commander, &mut self.ran_out);
            let now_s = self.start.elapsed().as_secs_f64();
            self.client.answer(TURN, |_, command| {
                let over = commander.fill(now_s, command);
                *ran_out = over.or(*ran_out);
            })
        } else {
            std::thread::sleep(due.saturating_duration_since(Instant::now()).min(TURN));
            self.client.poll_state().map(|_| ())
        };
        match outcome {
            Ok(()) | Err(ClientError::TimedOut(_)) => Ok(true),
            Err(ClientError::Ended) => Ok(false),
            Err(other) => Err(other.into()),
        }
    }

    fn phase(&mut self) -> Phase {
        let status = self.client.status().ok().flatten();
        status.and_then(|status| status.phase().ok()).unwrap_or(Phase::Running)
    }

    /// Publishes what has changed since the last call.
    pub(crate) fn publish(&mut self, node: &mut Node) {
        let phase = self.phase();
        let (Some(robot), Some(state)) = (&self.robot, self.client.state()) else { return };
        let is_new =
            self.sent.is_none_or(|(tick, when)| tick != state.tick || when.elapsed() >= REPEAT_PERIOD);
        if is_new {
            node.publish(outgoing::of_state(robot, state));
            self.sent = Some((state.tick, Instant::now()));
        }
        let operating = outgoing::operating_state(phase, self.commander.is_disabled(), state);
        let told = (operating, outgoing::is_busy(state));
        if self.told != Some(told) {
            self.told = Some(told);
            node.publish(outgoing::of_operating_state(told.0, told.1, state));
        }
        if is_new && let Ok(Some(jacobian)) = self.client.tip_jacobian() {
            node.publish(outgoing::of_tip_jacobian(robot, jacobian));
        }
        let mut newest = Vec::new();
        // Older queued frames are of no use to a subscriber.
        while let Ok(view) = self.client.wait_frame(0, Duration::ZERO) {
            newest = image::of_frame(view.frame, view.pixels, self.form);
        }
        node.publish(newest);
    }

    /// Executes the received commands, or reports why not.
    pub(crate) fn obey(&mut self, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        if let Some(over) = self.ran_out.take() {
            let line = format!(
                "{over} timed out: not repeated within {} s; stopped",
                ros_interface::commander::VELOCITY_HOLDS_S
            );
            self.tell(&line, notices);
        }
        if self.looked.elapsed() < LOOK_PERIOD {
            return;
        }
        self.looked = Instant::now();
        for came in node.take() {
            match came {
                Incoming::Message { topic, cdr, order, from } => {
                    let commanded = CommandedJoints {
                        arm: self.robot.as_ref().map_or(&[], Robot::arm_joints),
                        tendons: self.robot.as_ref().map_or(0, Robot::tendons),
                    };
                    let done = incoming::read(topic, &cdr, order, commanded)
                        .map_err(|refused| refused.to_string())
                        .and_then(|request| self.act(request, from));
                    if let Err(why) = done {
                        self.refuse(topic, &why, node, notices);
                    }
                }
                Incoming::Broken { topic, why } => self.refuse(topic, &why, node, notices),
                Incoming::Unfit { topic } => {
                    let why = "a publisher offers best effort, but commands must be reliable: it is ignored";
                    self.tell(&format!("{}: {why}", self.name(topic)), notices);
                }
                Incoming::Gone { from } => self.part_with(from, notices),
            }
        }
    }

    fn act(&mut self, request: Request, from: GUID) -> Result<(), String> {
        match request {
            Request::Move(motion) => {
                if self.commander.is_disabled() {
                    return Err(RequestError::Disabled.to_string());
                }
                if self.phase() == Phase::Paused {
                    return Err(RequestError::Paused.to_string());
                }
                self.commander.take(motion, self.start.elapsed().as_secs_f64());
                if self.commanding.len() < MOST_COMMANDING {
                    self.commanding.insert(from);
                }
                Ok(())
            }
            Request::State(StateCommand::Enable) => {
                let drives_arm = self.inputs().contains(&Input::ArmMoveJp);
                self.commander.enable(drives_arm);
                Ok(())
            }
            Request::State(StateCommand::Disable) => {
                self.commander.disable();
                Ok(())
            }
            Request::State(StateCommand::Pause) => self.control(ControlAction::Pause),
            Request::State(StateCommand::Resume) => self.control(ControlAction::Resume),
            Request::State(StateCommand::Home) => Ok(()),
        }
    }

    fn control(&mut self, action: ControlAction) -> Result<(), String> {
        let asked = self.client.run_control(action.code(), 0, CONTROL_LIMIT);
        asked.map(|_| ()).map_err(|error| error.to_string())
    }

    /// Handles a publisher's disconnection. Once the last publisher whose motion commands were executed is
    /// gone, all motion stops.
    fn part_with(&mut self, from: GUID, notices: &mut Notices<impl FnMut(&str)>) {
        if self.commanding.remove(&from) && self.commanding.is_empty() {
            self.commander.release();
            self.tell(
                "the last publisher of commands has disconnected: arm and burr stopped, tension \
                       kept",
                notices,
            );
        }
    }

    fn name(&self, topic: Input) -> String {
        INPUTS.iter().find(|row| row.topic == topic).map_or(String::new(), |row| row.name(&self.names))
    }

    fn refuse(&mut self, topic: Input, why: &str, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        node.refuse();
        let line = format!("{}: refused: {why}", self.name(topic));
        self.tell(&line, notices);
    }

    /// Prints a line and records it in the session's events.
    fn tell(&mut self, line: &str, notices: &mut Notices<impl FnMut(&str)>) {
        if let Some(line) = notices.say(line) {
            // An observer cannot send events; then the line is only printed.
            let _ = self.client.remark(Severity::Warning.code(), &line);
        }
    }
}
