//! The programs that talk to the hub: controllers and consumers, each with its queue.

use std::collections::VecDeque;

use delivery::x_ray::{ControllerFrames, FrameMark, FrameStep};
use hub::IncomingMessage;
use hub::rate_limit::Connection;
use messages::services::COMMAND;
use messages::{ArmMode, BurrMode, Command, ControllerIndex, Part, TendonMode, Tick, TubeMode};
use scene::{Drives, Mode};

use crate::oracle::seen_frames::SeenFrames;
use crate::plan::{CommandDefect, ControllerPlan, SchedulePlan};

/// Number of states that a controller's queue holds.
const STATE_QUEUE: usize = 16;

/// An alarm that can be reset before it goes off: only the last setting counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Alarm(pub u64);

/// A controller's view of the X-ray frames: decides with [`ControllerFrames`] as `controller_proc` does.
#[derive(Debug)]
pub struct FrameViewer {
    mode: Mode,
    decide: ControllerFrames,
    length: usize,
    queue: VecDeque<FrameMark>,
    kept: Option<FrameMark>,
    /// It has connected and is due to receive the newest frame.
    pub wants_history: bool,
    /// The state that it answers once it has seen the frames that are due.
    pub waits_at: Option<u64>,
}

impl FrameViewer {
    fn new(plan: &SchedulePlan) -> FrameViewer {
        FrameViewer {
            mode: plan.mode,
            decide: ControllerFrames::new(plan.mode),
            length: plan.x_ray.frame_queue,
            queue: VecDeque::new(),
            kept: None,
            wants_history: true,
            waits_at: None,
        }
    }

    fn join(&mut self) {
        self.decide = ControllerFrames::new(self.mode);
        self.queue.clear();
        (self.kept, self.wants_history, self.waits_at) = (None, true, None);
    }

    /// Puts a frame into its queue; returns the one that the queue drops.
    pub fn receive(&mut self, frame: FrameMark) -> Option<FrameMark> {
        let dropped = if self.queue.len() == self.length { self.queue.pop_front() } else { None };
        self.queue.push_back(frame);
        dropped
    }

    /// Returns whether every received frame has been processed.
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty() && self.kept.is_none()
    }

    /// Processes the frames before the controller answers the state of this tick; returns whether it waits
    /// for another.
    pub fn look(&mut self, index: ControllerIndex, tick: u64, now_ns: u64, account: &mut SeenFrames) -> bool {
        if self.waits_at != Some(tick) {
            self.decide.begin(account.due_at(tick).map(Tick), now_ns);
        }
        self.waits_at = None;
        loop {
            let next = self.kept.take().or_else(|| self.queue.pop_front());
            match (self.decide.step(next, now_ns), next) {
                (Ok(FrameStep::Show), Some(frame)) => account.showed(index, tick, frame),
                (Ok(FrameStep::Skip), Some(_)) => {}
                (Ok(FrameStep::Wait), None) => {
                    self.waits_at = Some(tick);
                    return true;
                }
                (Ok(FrameStep::Keep), Some(_)) => self.kept = next,
                (Ok(FrameStep::Answer), None) => {}
                (step, next) => account.failure = Some(format!("tick {tick}: {step:?} with {next:?}")),
            }
            if self.kept.is_some() || next.is_none() || account.failure.is_some() {
                account.answers(index, tick, self.decide.take_lost());
                return false;
            }
        }
    }
}

/// A controller's process.
#[derive(Debug)]
pub struct Controller {
    pub plan: ControllerPlan,
    pub drives: Vec<Drives>,
    pub alive: bool,
    pub asleep: bool,
    pub stalled_until_ns: u64,
    pub alarm: Alarm,
    /// It has connected and is due to receive the newest state.
    pub wants_history: bool,
    /// Its states, oldest first.
    pub states: VecDeque<u64>,
    /// Its commands on their way to the hub, and whether each is well formed.
    pub commands: VecDeque<(IncomingMessage<Command>, Form)>,
    /// `None` if it does not look at X-ray frames.
    pub sight: Option<FrameViewer>,
    connection: Connection,
    sequence: u64,
    last_answered: u64,
}

impl Controller {
    /// Creates a controller that is not connected yet.
    pub fn new(plan: &SchedulePlan, index: ControllerIndex, drives: &[Drives]) -> Controller {
        let looks = plan.x_ray.watching.get(index.slot()) == Some(&true);
        Controller {
            sight: looks.then(|| FrameViewer::new(plan)),
            plan: plan.controllers[index.slot()].clone(),
            drives: drives.to_vec(),
            alive: false,
            asleep: false,
            stalled_until_ns: 0,
            alarm: Alarm::default(),
            wants_history: false,
            states: VecDeque::new(),
            commands: VecDeque::new(),
            connection: Connection(1000 * (u128::from(index.0) + 1)),
            sequence: 0,
            last_answered: 0,
        }
    }

    /// Connects or reconnects it.
    pub fn join(&mut self) {
        self.connection.0 += 1;
        (self.alive, self.asleep, self.wants_history) = (true, false, true);
        (self.sequence, self.last_answered) = (0, 0);
        self.states.clear();
        self.sight.iter_mut().for_each(FrameViewer::join);
    }

    /// Puts a state into its queue, which drops its oldest when full.
    pub fn see(&mut self, tick: u64) {
        if !self.alive {
            return;
        }
        self.wants_history = false;
        if self.states.len() == STATE_QUEUE {
            self.states.pop_front();
        }
        self.states.push_back(tick);
    }

    /// Takes the state that it answers next.
    pub fn take_state(&mut self) -> Option<u64> {
        if self.plan.newest_only {
            let newest = self.states.pop_back();
            self.states.clear();
            return newest;
        }
        self.states.pop_front()
    }

    /// Sends an answer to a state.
    pub fn answer(&mut self, state_tick: u64) {
        self.sequence += 1;
        self.last_answered = self.last_answered.max(state_tick);
        let command = self.command(state_tick);
        self.push(IncomingMessage::Message(command, self.connection), Form::Whole);
    }

    fn command(&self, state_tick: u64) -> Command {
        let mut command = Command { sequence: self.sequence, state_tick, ..Command::zeroed() };
        if self.drives.contains(&Drives::Tendon) {
            command.tendon_mode = TendonMode::ServoJf.code();
            command.tendon_force_n[0] = (self.sequence % 50) as f64;
        }
        if self.drives.contains(&Drives::Arm) {
            command.arm_mode = ArmMode::Hold.code();
        }
        if self.drives.contains(&Drives::Burr) {
            command.burr_mode = BurrMode::Speed.code();
            command.burr_speed_rad_per_s = (self.sequence % 900) as f64;
        }
        if self.drives.contains(&Drives::Tube) {
            command.tube_mode = TubeMode::MoveJp.code();
            command.tube_deployed_m = (self.sequence % 40) as f64 * 1e-3;
        }
        command
    }

    /// Sends something that must be refused.
    pub fn misbehave(&mut self, bad: CommandDefect) {
        let mut command = self.command(self.last_answered);
        command.sequence += 1;
        let mut form = Form::Whole;
        match bad {
            CommandDefect::NotANumber => (command.burr_speed_rad_per_s, form) = (f64::NAN, Form::Malformed),
            CommandDefect::OthersPart => {
                form = Form::Malformed;
                if self.drives.contains(&Drives::Arm) {
                    command.arm_mode = 99;
                } else {
                    command.arm_mode = ArmMode::Hold.code();
                }
            }
            CommandDefect::Future => command.state_tick = u64::MAX,
            CommandDefect::OldSequence => command.sequence = self.sequence,
            CommandDefect::OldState if self.last_answered > 0 => command.state_tick = self.last_answered - 1,
            CommandDefect::OldState => command.state_tick = u64::MAX,
            CommandDefect::Malformed => {
                return self
                    .push(IncomingMessage::Malformed("a message of 3 bytes".to_owned()), Form::Malformed);
            }
        }
        self.sequence = command.sequence;
        self.push(IncomingMessage::Message(command, self.connection), form);
    }

    /// Puts a command into the hub's queue, which drops its oldest when full.
    fn push(&mut self, incoming: IncomingMessage<Command>, form: Form) {
        if self.commands.len() == COMMAND.queue_length {
            self.commands.pop_front();
        }
        self.commands.push_back((incoming, form));
    }
}

/// Whether a command is well formed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    Whole,
    /// The hub must refuse it because of its content.
    Malformed,
}

/// A consumer's process.
#[derive(Debug)]
pub struct Consumer {
    pub part: Part,
    pub look_ns: u64,
    pub alive: bool,
    pub asleep: bool,
    pub stalled_until_ns: u64,
    pub alarm: Alarm,
    /// States that it has not taken.
    pub waiting: u64,
    taken: Option<u64>,
}

impl Consumer {
    /// Creates a consumer that is not connected yet.
    pub fn new(part: Part, look_ns: u64) -> Consumer {
        Consumer {
            part,
            look_ns,
            alive: true,
            asleep: false,
            stalled_until_ns: 0,
            alarm: Alarm::default(),
            waiting: 0,
            taken: None,
        }
    }

    /// Takes what waits, up to the state of this tick; returns the tick to report if it is new.
    pub fn take(&mut self, newest_tick: u64) -> Option<u64> {
        let news = self.waiting > 0 || self.taken.is_none();
        self.waiting = 0;
        self.taken = Some(newest_tick);
        news.then_some(newest_tick)
    }
}
