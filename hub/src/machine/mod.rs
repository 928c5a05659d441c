//! The state machine.

mod commands;
mod connecting;
mod control;
mod ticking;
mod waiting;

use std::fmt::Display;

use messages::{
    CommandSource, ControllerIndex, EventCode, MAX_CONTROLLERS, Part, Phase, Plant, Severity, Tick,
    TickTiming,
};
use scene::{Mode, Scene};
use thiserror::Error;

use crate::consumers::{Consumers, Whom};
use crate::environment::{Environment, Note};
use crate::latch::Latch;
use crate::late_notes::LateNotes;
use crate::lead::recorder_lead_ticks;
use crate::pacing::Schedule;
use crate::patience::Patience;
use crate::rate_limit::{RateLimit, WarningLimit};
use crate::run_lane::{LaneError, RunLane};
use commands::Controller;
use control::When;

const MS: u64 = 1_000_000;
const NS_PER_S: u64 = 1000 * MS;

/// How far the hub may run ahead of a consumer in lockstep: half of the state queue.
const LEAD_TICKS: u64 = 256;
/// How long a part may take to connect; a DRR process first reads the whole volume.
const CONNECT_LIMIT_NS: u64 = 60_000 * MS;
/// How long a consumer may make no progress in lockstep; a full frame of a large CT takes seconds.
const CONSUMER_LIMIT_NS: u64 = 120_000 * MS;
/// As above, when a signal has ended the run; whatever the consumers have not taken stays in their queues.
const ABANDONED_LIMIT_NS: u64 = 500 * MS;
/// How long a run that has failed waits for its recorder, which reads nothing more of a publisher that it has not seen alive.
const FAILED_LIMIT_NS: u64 = 2_000 * MS;
const STATUS_PERIOD_NS: u64 = 100 * MS;
/// How long the run waits for a controller before it says so.
const SILENT_WAIT_NS: u64 = NS_PER_S;
/// Poll interval while the run is paused, while parts connect, and while a consumer is behind.
const POLL_NS: u64 = 20 * MS;
const CONNECT_LOOK_NS: u64 = MS;
const REPORT_LOOK_NS: u64 = 2 * MS;

const _: () = assert!(2 * LEAD_TICKS <= messages::services::STATE.queue_length as u64);
const _: () = assert!(ABANDONED_LIMIT_NS < CONSUMER_LIMIT_NS && REPORT_LOOK_NS < STATUS_PERIOD_NS);

/// What the hub needs to know of a scene and its session.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Lockstep or real time.
    pub mode: Mode,
    /// Tick period, ns.
    pub period_ns: u64,
    /// Length of the run in ticks.
    pub tick_count: u64,
    /// Ticks between two keyframes; `None` without a recorder.
    pub keyframe_period_ticks: Option<u64>,
    /// How many ticks the hub may run ahead of its consumers in lockstep.
    pub lead_ticks: u64,
    /// How many ticks the hub may run ahead of the recorder in real time; `None` for no limit.
    pub recorder_lead_ticks: Option<u64>,
    /// How long lockstep waits for an answer.
    pub controller_limit_ns: u64,
    /// The parts that must take every state.
    pub consumers: Vec<Part>,
}

impl Settings {
    /// The settings of a scene in a session with these consumers.
    pub fn new(scene: &Scene, consumers: &[Part]) -> Settings {
        let recorded = consumers.contains(&Part::Recorder);
        Settings {
            mode: scene.run.mode,
            period_ns: scene.dt_ns(),
            tick_count: scene.tick_count(),
            keyframe_period_ticks: scene.keyframe_period_ticks().filter(|_| recorded),
            lead_ticks: LEAD_TICKS,
            recorder_lead_ticks: recorder_lead_ticks(scene),
            controller_limit_ns: (scene.run.controller_limit_ms * 1e6) as u64,
            consumers: consumers.to_vec(),
        }
    }

    /// The run's last state.
    fn end(&self) -> Tick {
        Tick(self.tick_count)
    }
}

/// Why a run ends early.
#[derive(Debug, Error)]
pub enum HubError<E, P> {
    /// A message could not be sent or received.
    #[error("{0}")]
    Environment(E),
    /// The plant could not compute a tick; its commands have been published, a state has not.
    #[error("tick {tick}: {cause}")]
    Plant {
        /// Tick.
        tick: Tick,
        /// Reason from the plant.
        cause: P,
    },
    /// A consumer never connected.
    #[error("{part} did not connect within {limit_s} s")]
    NotConnected {
        /// The part.
        part: Part,
        /// Time waited.
        limit_s: u64,
    },
    /// A controller is to blame.
    #[error("{0}")]
    Controller(ControllerFault),
    /// A consumer stopped taking states.
    #[error("{part} has taken no state for {limit_s} s at tick {tick}")]
    ConsumerStuck {
        /// The part.
        part: Part,
        /// Tick.
        tick: Tick,
        /// Limit.
        limit_s: u64,
    },
}

/// How a controller ends the run.
#[derive(Debug, Error)]
pub enum ControllerFault {
    /// It never sent a command.
    #[error("controller `{name}` did not connect within {limit_s} s")]
    NotConnected {
        /// Its name.
        name: String,
        /// Time waited.
        limit_s: u64,
    },
    /// It did not answer in lockstep.
    #[error(
        "controller `{name}` did not answer tick {tick} within {limit_ms} ms (`run.controller_limit_ms`)"
    )]
    Silent {
        /// Its name.
        name: String,
        /// Tick.
        tick: Tick,
        /// Limit.
        limit_ms: f64,
    },
}

impl ControllerFault {
    /// Name of the controller.
    pub fn controller(&self) -> &str {
        match self {
            ControllerFault::NotConnected { name, .. } | ControllerFault::Silent { name, .. } => name,
        }
    }

    /// The kind of event that tells it.
    pub fn event(&self) -> EventCode {
        match self {
            ControllerFault::NotConnected { .. } => EventCode::ControllerMissing,
            ControllerFault::Silent { .. } => EventCode::ControllerLate,
        }
    }
}

/// Whom or what clients blame for the end of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Blame {
    /// The kind of event that tells it.
    pub code: EventCode,
    /// The controller's name; `None`: the simulation.
    pub controller: Option<String>,
    /// What happened, in words.
    pub text: String,
}

impl<E, P: Display> HubError<E, P> {
    /// Whom to blame, if it is not a part or the transport: those fail by themselves, and the launcher sees it.
    fn blame(&self) -> Option<Blame> {
        match self {
            HubError::Controller(fault) => Some(Blame {
                code: fault.event(),
                controller: Some(fault.controller().to_owned()),
                text: fault.to_string(),
            }),
            HubError::Plant { tick, cause } => Some(Blame {
                code: EventCode::SimulationFailed,
                controller: None,
                text: format!("tick {tick}: {cause}"),
            }),
            HubError::Environment(_) | HubError::NotConnected { .. } | HubError::ConsumerStuck { .. } => None,
        }
    }
}

impl<E, P> From<E> for HubError<E, P> {
    fn from(cause: E) -> HubError<E, P> {
        HubError::Environment(cause)
    }
}

/// The outcome of a part of the machine.
type Outcome<T, P, E> = Result<T, HubError<<E as crate::Outputs>::Error, <P as Plant>::Error>>;

/// What to do before the next [`Hub::advance`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// Wait.
    Wait(Wait),
    /// Every part has connected: prepare the thread for the ticks (priorities, memory), then advance.
    GetReady,
    /// The run is over.
    Ended,
}

/// A wait. Advancing early is allowed and costs only a poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wait {
    /// Latest end of the wait, on the environment's clock, ns.
    pub until_ns: u64,
    /// What else ends it.
    pub on: Awaited,
}

/// What ends a wait early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Awaited {
    /// Nothing; a short sleep between polls.
    Nothing,
    /// Nothing: this is a tick's deadline and must be met exactly.
    Deadline,
    /// A run-control request.
    Control,
    /// A consumer's report.
    Report,
    /// A command of this controller.
    Command(ControllerIndex),
}

/// Where the machine is between two advances.
#[derive(Debug, Clone)]
enum Stage {
    /// Waits until every part and every required controller has connected.
    Connecting {
        consumers: Patience,
        /// One timeout per controller, running from the time when there is a state to answer.
        controllers: Vec<Patience>,
        /// Until the user is told for whom the run waits.
        notice: Option<Patience>,
    },
    /// All connected; the first deadline is now.
    Ready,
    /// A tick is due, unless the run ends or is paused.
    TickDue,
    /// Paused; the poll interval has passed.
    Rested,
    /// Waits until these consumers have taken the state of `tick`, so that their queues do not overflow.
    ConsumersBehind { tick: Tick, whom: Whom, patience: Patience, began_ns: u64 },
    /// Waits for the deadline (real time).
    AwaitDeadline,
    /// Waits for answers (lockstep); `silent` is the controller last waited for, `notice` as in `Connecting`.
    AwaitAnswers { patience: Patience, silent: Option<ControllerIndex>, notice: Option<Patience> },
    /// The last tick is done.
    Ending { patience: Patience, abandoned: Patience },
    /// A controller or the plant has failed, and everybody has been told: waits until the recorder has taken the last state.
    Failing { patience: Patience },
    /// Ended or failed.
    Over,
}

/// The result of a stage: the next stage, and what to return from the advance first, if anything.
type Step = (Stage, Option<Next>);

/// What ticks had no room for, and when it was told.
#[derive(Debug, Default)]
struct Shortfall {
    /// Counted once in every tick.
    total: u64,
    notes: LateNotes,
}

/// A failure that has been told.
#[derive(Debug)]
enum Failure<C> {
    Plant { tick: Tick, cause: C },
    Controller(ControllerFault),
}

impl<C> Failure<C> {
    /// The failure of a controller or of the plant; any other error ends the run at once.
    fn of<E>(error: HubError<E, C>) -> Result<Self, HubError<E, C>> {
        match error {
            HubError::Plant { tick, cause } => Ok(Failure::Plant { tick, cause }),
            HubError::Controller(fault) => Ok(Failure::Controller(fault)),
            other => Err(other),
        }
    }

    fn error<E>(self) -> HubError<E, C> {
        match self {
            Failure::Plant { tick, cause } => HubError::Plant { tick, cause },
            Failure::Controller(fault) => HubError::Controller(fault),
        }
    }
}

/// The tick as a state machine.
#[derive(Debug)]
pub struct Hub<P: Plant> {
    plant: P,
    /// Why the run is ending.
    failure: Option<Failure<P::Error>>,
    is_told: bool,
    settings: Settings,
    stage: Stage,
    lane: RunLane,
    latch: Latch,
    controllers: Vec<Controller>,
    consumers: Consumers,
    schedule: Schedule,
    tick: Tick,
    /// Whether the initial state has been published.
    shown: bool,
    connected: bool,
    /// When the newest state was published.
    published_ns: u64,
    paused: bool,
    steps_left: u64,
    reset_asked: bool,
    stopped: bool,
    refused_commands: u64,
    control_limit: RateLimit,
    control_warnings: WarningLimit,
    status_sent_ns: Option<u64>,
    /// Whether the event "state does not fit into a keyframe" has been sent.
    keyframe_refused: bool,
    /// Voxels that could not be cut for want of memory.
    uncut_voxels: Shortfall,
    /// Contacts that there was no room for.
    left_out_contacts: Shortfall,
    /// Timing of the coming or current tick.
    timing: TickTiming,
    sources: [CommandSource; MAX_CONTROLLERS],
    /// Notes per controller: one for commands that start being held, one for safe commands.
    late_notes: [[LateNotes; 2]; MAX_CONTROLLERS],
}

impl<P: Plant> Hub<P> {
    /// A hub before the start of its run.
    pub fn new(scene: &Scene, plant: P, settings: Settings, now_ns: u64) -> Hub<P> {
        Hub {
            plant,
            failure: None,
            is_told: false,
            stage: Stage::Connecting {
                consumers: Patience::new(CONNECT_LIMIT_NS, now_ns),
                controllers: Vec::new(),
                notice: None,
            },
            lane: RunLane::new(settings.keyframe_period_ticks),
            latch: Latch::new(scene),
            controllers: scene.controller.iter().map(Controller::new).collect(),
            consumers: Consumers::new(&settings.consumers),
            schedule: Schedule::new(settings.period_ns, now_ns),
            settings,
            tick: Tick::START,
            shown: false,
            connected: false,
            published_ns: now_ns,
            paused: false,
            steps_left: 0,
            reset_asked: false,
            stopped: false,
            refused_commands: 0,
            control_limit: RateLimit::default(),
            control_warnings: WarningLimit::default(),
            status_sent_ns: None,
            keyframe_refused: false,
            uncut_voxels: Shortfall::default(),
            left_out_contacts: Shortfall::default(),
            timing: TickTiming::zeroed(),
            sources: [CommandSource::None; MAX_CONTROLLERS],
            late_notes: Default::default(),
        }
    }

    /// Ticks made so far.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// The plant.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Does everything that can be done now, up to the next wait.
    ///
    /// # Errors
    /// Any [`HubError`]; the run is over then. If a controller or the plant is to blame, every client has been told.
    pub fn advance<E: Environment>(&mut self, env: &mut E) -> Outcome<Next, P, E> {
        match self.advance_stages(env) {
            Err(error) => {
                self.tell(env, error)?;
                self.stage = Stage::Failing { patience: Patience::new(FAILED_LIMIT_NS, env.now_ns()) };
                self.advance_stages(env)
            }
            advanced => advanced,
        }
    }

    /// Tells every client of a failure. An error that is nobody's fault, or has been told, is returned.
    fn tell<E: Environment>(
        &mut self,
        env: &mut E,
        error: HubError<E::Error, P::Error>,
    ) -> Outcome<(), P, E> {
        let Some(blame) = error.blame().filter(|_| !self.is_told) else { return Err(error) };
        self.is_told = true;
        env.leave_blame(&blame);
        let Blame { code, text, .. } = &blame;
        env.send_event(&Note { tick: self.tick, severity: Severity::Error, code: *code, text })?;
        self.send_status(env, Phase::Ended, When::Now)?;
        env.wake_controllers();
        self.failure = Some(Failure::of(error)?);
        Ok(())
    }

    fn advance_stages<E: Environment>(&mut self, env: &mut E) -> Outcome<Next, P, E> {
        loop {
            let (stage, next) = match std::mem::replace(&mut self.stage, Stage::Over) {
                Stage::Connecting { consumers, controllers, notice } => {
                    self.connect(env, consumers, controllers, notice)?
                }
                Stage::Ready => {
                    self.schedule = Schedule::new(self.settings.period_ns, env.now_ns());
                    (Stage::TickDue, None)
                }
                Stage::TickDue => self.prepare(env)?,
                Stage::Rested => {
                    self.schedule.go_on(env.now_ns());
                    (Stage::TickDue, None)
                }
                Stage::AwaitDeadline => self.await_deadline(env)?,
                Stage::ConsumersBehind { tick, whom, patience, began_ns } => {
                    self.await_consumers(env, tick, whom, patience, began_ns)?
                }
                Stage::AwaitAnswers { patience, silent, notice } => {
                    self.await_answers(env, patience, silent, notice)?
                }
                Stage::Ending { patience, abandoned } => self.await_last(env, patience, abandoned)?,
                Stage::Failing { patience } => self.await_recorder(env, patience)?,
                Stage::Over => (Stage::Over, Some(Next::Ended)),
            };
            self.stage = stage;
            if let Some(next) = next {
                return Ok(next);
            }
        }
    }

    /// Between two ticks: executes run control and decides what the next tick waits for.
    fn prepare<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        if self.tick >= self.settings.end() || self.ends(env) {
            return self.finish(env);
        }
        self.obey(env)?;
        if self.ends(env) {
            return self.finish(env);
        }
        if self.rests() {
            return self.rest(env);
        }
        let now_ns = env.now_ns();
        let behind = |whom, tick, began_ns| Stage::ConsumersBehind {
            tick,
            whom,
            patience: Patience::new(CONSUMER_LIMIT_NS, now_ns),
            began_ns,
        };
        let stage = match self.settings.mode {
            Mode::Realtime => {
                env.work_ends();
                self.timing.recorder_wait_ns = 0;
                let lead = self.settings.recorder_lead_ticks.map(|lead| self.tick.saturating_sub(lead));
                match lead.filter(|tick| self.consumers.behind(*tick, Whom::Recorder).is_some()) {
                    None => Stage::AwaitDeadline,
                    Some(tick) => behind(Whom::Recorder, tick, now_ns.max(self.schedule.deadline_ns())),
                }
            }
            Mode::Lockstep => {
                behind(Whom::Everybody, self.tick.saturating_sub(self.settings.lead_ticks), now_ns)
            }
        };
        Ok((stage, None))
    }

    fn ends<E: Environment>(&self, env: &E) -> bool {
        self.stopped || env.end_requested()
    }

    /// Whether the run is paused with no step left to make.
    fn rests(&self) -> bool {
        self.paused && self.steps_left == 0
    }
}

/// A wait for `on`, until `until_ns` at the latest.
fn wait(on: Awaited, until_ns: u64) -> Option<Next> {
    Some(Next::Wait(Wait { until_ns, on }))
}

/// Turns an error of the run lane into the run's error.
fn lane_failed<E, P>(tick: Tick) -> impl Fn(LaneError<E, P>) -> HubError<E, P> {
    move |cause| match cause {
        LaneError::Output(cause) => HubError::Environment(cause),
        LaneError::Plant(cause) => HubError::Plant { tick, cause },
    }
}
