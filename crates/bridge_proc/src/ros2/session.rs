//! The bridge's side of the session.

mod publish;

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use ipc_types::messages::{ControlAction, MAX_ARM_JOINTS, Phase, SensorReading, Severity};
use ipc_types::scene::{Controller, Drives};
use ros_interface::commander::{Commander, OperatingState};
use ros_interface::image::ImageForm;
use ros_interface::incoming::{self, CommandedJoints, Request, RequestError, StateCommand};
use ros_interface::lockstep::{Answer, Lockstep};
use ros_interface::msg::Time;
use ros_interface::outgoing::{self, Outgoing};
use ros_interface::robot::Robot;
use ros_interface::round_trip::RoundTrips;
use ros_interface::topics::{INPUTS, Input, Names};
use ros_interface::urdf;
use rustdds::GUID;
use trabecula_client::{Client, ClientError, Connection};

use super::bone::Bone;
use super::node::{Incoming, Node};
use super::notices::Notices;
use super::{Ros2Error, Ros2Options};
use crate::own_controller;

/// How long one turn of the loop waits for a state.
const TURN: Duration = Duration::from_millis(5);
/// Shortest interval between two polls of the subscriptions.
const LOOK_PERIOD: Duration = Duration::from_millis(1);
/// Interval between two polls while a state waits for its answer in lockstep.
const ANSWER_LOOK_PERIOD: Duration = Duration::from_micros(50);
/// Timeout for a reply of run control.
const CONTROL_LIMIT: Duration = Duration::from_secs(2);
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
    /// In exact runs: the answers to the newest state.
    exchange: Option<Exchange>,
    round_trips: RoundTrips,
    /// Newest clearances from critical structures.
    clearances: Option<SensorReading>,
    /// `None` without a volume.
    bone: Option<Bone>,
    /// A cloud for which there was no room.
    unsent: Option<Outgoing>,
}

/// A state and its answers.
#[derive(Debug)]
struct Exchange {
    lockstep: Lockstep,
    /// When the state was received; `None` once it is answered.
    begun: Option<Instant>,
}

impl Ros2Session {
    pub(crate) fn connect(options: &Ros2Options) -> Result<Ros2Session, Ros2Error> {
        let connection = Connection {
            session: options.session.clone(),
            controller: Some(options.controller.clone().unwrap_or_default()),
            ..Connection::default()
        };
        let now = Instant::now();
        let client = Client::connect(&connection)?;
        let exchange = if options.lockstep { Some(Exchange::of(&client)?) } else { None };
        let scene = client.scene();
        let bone = match &scene.volume {
            Some(volume) => Some(Bone::start(&client.info().folder, scene, volume.bone_threshold_hu)?),
            None => None,
        };
        Ok(Ros2Session {
            client,
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
            exchange,
            round_trips: RoundTrips::default(),
            clearances: None,
            bone,
            unsent: None,
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
        if self.exchange.is_some() {
            return self.advance_exchange();
        }
        let outcome = if self.client.info().controller.is_some() {
            let now_s = self.now_s();
            let (commander, ran_out) = (&mut self.commander, &mut self.ran_out);
            self.client.answer(TURN, |state, command| {
                let over = commander.fill(now_s, state.sim_time_s, command);
                *ran_out = over.or(*ran_out);
            })
        } else {
            std::thread::sleep(due.saturating_duration_since(Instant::now()).min(TURN));
            self.client.poll_state().map(|_| ())
        };
        goes_on(outcome)
    }

    /// Answers the newest state if every part has its command, and receives the next one.
    fn advance_exchange(&mut self) -> Result<bool, Ros2Error> {
        let now_s = self.now_s();
        let Some(exchange) = &mut self.exchange else { return Ok(true) };
        if let Some(begun) = exchange.begun {
            if !exchange.lockstep.is_complete() {
                std::thread::sleep(ANSWER_LOOK_PERIOD);
                // No next state is expected; but the end is.
                return match self.client.next_state(Duration::ZERO) {
                    Ok(state) => {
                        exchange.begin(state.sim_time_s);
                        Ok(true)
                    }
                    Err(other) => goes_on(Err(other)),
                };
            }
            exchange.begun = None;
            self.round_trips.add(begun.elapsed().as_secs_f64());
            // In an exact run this is simulated time.
            self.commander.fill(now_s, now_s, self.client.command()?);
            self.client.send()?;
        }
        let next = self.client.next_state(TURN).map(|state| exchange.begin(state.sim_time_s));
        goes_on(next)
    }

    /// Time by which velocities expire, s: simulated time in exact runs.
    fn now_s(&self) -> f64 {
        match (&self.exchange, self.client.state()) {
            (Some(_), Some(state)) => state.sim_time_s,
            _ => self.start.elapsed().as_secs_f64(),
        }
    }

    /// Times from states to the commands that answer them.
    pub(crate) fn round_trips(&self) -> RoundTrips {
        self.round_trips.clone()
    }

    fn phase(&mut self) -> Phase {
        let status = self.client.status().ok().flatten();
        status.and_then(|status| status.phase().ok()).unwrap_or(Phase::Running)
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
        if self.exchange.is_none() && self.looked.elapsed() < LOOK_PERIOD {
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
                    let stamp = incoming::stamp(&cdr, order).unwrap_or_default();
                    let done = incoming::read(topic, &cdr, order, commanded)
                        .map_err(|refused| refused.to_string())
                        .and_then(|request| self.act_at(request, topic, stamp, from));
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

    /// Executes a request that carries a stamp; in exact runs, only the first motion of each part for the
    /// newest state.
    fn act_at(&mut self, request: Request, topic: Input, stamp: Time, from: GUID) -> Result<(), String> {
        if let Request::Move(_) = request {
            match (&mut self.exchange, self.client.state()) {
                (Some(exchange), _) => {
                    let answer =
                        exchange.lockstep.answer(topic, stamp).map_err(|refused| refused.to_string())?;
                    if answer == Answer::Repeated {
                        return Ok(());
                    }
                }
                (None, Some(state)) if stamp != Time::default() => {
                    self.round_trips.add(state.sim_time_s - stamp.seconds());
                }
                _ => {}
            }
        }
        self.act(request, from)
    }

    fn act(&mut self, request: Request, from: GUID) -> Result<(), String> {
        match request {
            Request::Move(motion) => {
                self.check_moves()?;
                self.commander.take(motion, self.now_s());
                self.remember(from);
                Ok(())
            }
            Request::Follow(trajectory) => {
                if self.exchange.is_some() {
                    return Err(RequestError::NotStepwise.to_string());
                }
                self.check_moves()?;
                let state = self.client.state();
                let start_rad = state.map_or([0.0; MAX_ARM_JOINTS], |state| {
                    let (joints, bent) = (&state.arm_joint_position_rad, &state.arm_joint_deflection_rad);
                    core::array::from_fn(|joint| joints[joint] - bent[joint])
                });
                let begins_s = state.map_or(0.0, |state| state.sim_time_s);
                self.commander.follow(trajectory, start_rad, begins_s);
                self.remember(from);
                Ok(())
            }
            Request::Take(t_world_c_arm) => {
                let own = own_controller(&self.client).map(|it| it.name.as_str());
                let drives_c_arm = |it: &&Controller| it.drives.contains(&Drives::CArm);
                let driver = self.client.scene().controller.iter().find(drives_c_arm);
                if let Some(other) = driver.filter(|driver| Some(driver.name.as_str()) != own) {
                    return Err(format!("controller `{}` drives the C-arm", other.name));
                }
                let tick = self.client.state().map_or(0, |state| state.tick);
                let asked = self.client.request_frame(Some(&t_world_c_arm), tick);
                asked.map(|_| ()).map_err(|error| error.to_string())
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
            Request::State(StateCommand::Reset) => {
                // In exact runs every part has a new command for each state, before or after the reset.
                if self.exchange.is_none() {
                    self.commander.forget();
                    // Replaces the last command, which the first tick after the reset would apply again.
                    let replaced = self.client.command().map(|_| ()).and_then(|()| self.client.send());
                    replaced.map_err(|error| error.to_string())?;
                }
                self.control(ControlAction::Reset)
            }
        }
    }

    /// Fails while motion is refused.
    fn check_moves(&mut self) -> Result<(), String> {
        if self.commander.is_disabled() {
            return Err(RequestError::Disabled.to_string());
        }
        // In exact runs a command answers the state that was published before the pause.
        if self.exchange.is_none() && self.phase() == Phase::Paused {
            return Err(RequestError::Paused.to_string());
        }
        Ok(())
    }

    /// Remembers a publisher whose motion was executed.
    fn remember(&mut self, from: GUID) {
        if self.commanding.len() < MOST_COMMANDING {
            self.commanding.insert(from);
        }
    }

    fn control(&mut self, action: ControlAction) -> Result<(), String> {
        let asked = self.client.run_control(action.code(), 0, CONTROL_LIMIT);
        asked.map(|_| ()).map_err(|error| error.to_string())
    }

    /// Handles a publisher's disconnection. Once the last publisher whose motion commands were executed is
    /// gone, all motion stops.
    fn part_with(&mut self, from: GUID, notices: &mut Notices<impl FnMut(&str)>) {
        // An exact run waits for the next controller; when this one is missed must change nothing.
        if self.commanding.remove(&from) && self.commanding.is_empty() && self.exchange.is_none() {
            self.commander.release();
            self.tell(
                "the last publisher of commands has disconnected: arm, burr and tendon rates stopped, \
                 tension kept",
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

impl Exchange {
    /// Returns the exchange of a client, which waits for its first state.
    fn of(client: &Client) -> Result<Exchange, Ros2Error> {
        if !client.info().lockstep {
            return Err(Ros2Error::RealTime(client.session_name()));
        }
        let (name, drives) = own_controller(client).map_or(("", &[][..]), |it| (&it.name, &it.drives));
        let dt_ns = (client.info().dt_s * 1e9).round() as u64;
        let lockstep =
            Lockstep::new(drives, dt_ns).ok_or_else(|| Ros2Error::NothingToDrive(name.to_owned()))?;
        Ok(Exchange { lockstep, begun: None })
    }

    fn begin(&mut self, sim_time_s: f64) {
        self.lockstep.begin(Time::of_simulated(sim_time_s));
        self.begun = Some(Instant::now());
    }
}

/// Returns whether the run continues after an attempt to receive a state.
fn goes_on(outcome: Result<(), ClientError>) -> Result<bool, Ros2Error> {
    match outcome {
        Ok(()) | Err(ClientError::TimedOut(_)) => Ok(true),
        Err(ClientError::Ended) => Ok(false),
        Err(other) => Err(other.into()),
    }
}
