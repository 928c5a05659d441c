//! The state machine.

mod commands;
mod connecting;
mod control;
mod ticking;
mod waiting;

use messages::{MAX_CONTROLLERS, Part, Plant, TickTiming};
use scene::{Mode, Scene};
use thiserror::Error;

use crate::consumers::{Consumers, Whom};
use crate::environment::Environment;
use crate::latch::Latch;
use crate::late_notes::LateNotes;
use crate::lead::recorder_lead_ticks;
use crate::pacing::Schedule;
use crate::patience::Patience;
use crate::rate_limit::{RateLimit, WarningLimit};
use crate::run_lane::{LaneError, RunLane};
use commands::Controller;

const MS: u64 = 1_000_000;
const NS_PER_S: u64 = 1000 * MS;

/// In lockstep the hub runs no further ahead of a consumer than this; half of the state's queue.
const LEAD_TICKS: u64 = 256;
/// How long every part may take to connect: a DRR process reads the whole volume first.
const CONNECT_LIMIT_NS: u64 = 60_000 * MS;
/// How long a consumer may stand still in lockstep: a full frame of a large CT takes seconds.
const CONSUMER_LIMIT_NS: u64 = 120_000 * MS;
/// The same at the end of a run that a signal has ended; what the consumers have not taken yet stays in their queues.
const ABANDONED_LIMIT_NS: u64 = 500 * MS;
const STATUS_PERIOD_NS: u64 = 100 * MS;
/// Between two looks while the run rests, while parts connect, and while a consumer is behind.
const REST_LOOK_NS: u64 = 20 * MS;
const CONNECT_LOOK_NS: u64 = MS;
const REPORT_LOOK_NS: u64 = 2 * MS;

const _: () = assert!(2 * LEAD_TICKS <= messages::services::STATE.queue_length as u64);
const _: () = assert!(ABANDONED_LIMIT_NS < CONSUMER_LIMIT_NS && REPORT_LOOK_NS < STATUS_PERIOD_NS);

/// What of a scene and of its session the hub must know.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Lockstep or real time.
    pub mode: Mode,
    /// Period of the tick.
    pub period_ns: u64,
    /// Ticks of the whole run.
    pub tick_count: u64,
    /// Ticks between two keyframes; none without a recorder.
    pub keyframe_period_ticks: Option<u64>,
    /// How far in front of its consumers the hub may run in lockstep.
    pub lead_ticks: u64,
    /// How far in front of the recorder the hub may run in real time; none: as far as it gets.
    pub recorder_lead_ticks: Option<u64>,
    /// How long lockstep waits for an answer.
    pub controller_limit_ns: u64,
    /// The parts that take every state.
    pub consumers: Vec<Part>,
}

impl Settings {
    /// Of a scene in a session with these consumers.
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
}

/// Why a run ends early.
#[derive(Debug, Error)]
pub enum HubError<E, P> {
    /// A message cannot be sent or taken.
    #[error("{0}")]
    Environment(E),
    /// The plant refuses a tick.
    #[error("tick {tick}: {cause}")]
    Plant {
        /// Tick.
        tick: u64,
        /// Its reason.
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
    /// A controller never commanded.
    #[error("controller `{name}` did not connect within {limit_s} s")]
    ControllerNotConnected {
        /// Its name.
        name: String,
        /// Time waited.
        limit_s: u64,
    },
    /// A controller did not answer in lockstep.
    #[error(
        "controller `{name}` did not answer tick {tick} within {limit_ms} ms (`run.controller_limit_ms`)"
    )]
    ControllerSilent {
        /// Its name.
        name: String,
        /// Tick.
        tick: u64,
        /// Limit.
        limit_ms: f64,
    },
    /// A consumer stopped taking states.
    #[error("{part} has taken no state for {limit_s} s at tick {tick}")]
    ConsumerStuck {
        /// The part.
        part: Part,
        /// Tick.
        tick: u64,
        /// Limit.
        limit_s: u64,
    },
}

impl<E, P> From<E> for HubError<E, P> {
    fn from(cause: E) -> HubError<E, P> {
        HubError::Environment(cause)
    }
}

/// The outcome of a part of the machine.
type Outcome<T, P, E> = Result<T, HubError<<E as crate::Outputs>::Error, <P as Plant>::Error>>;

/// What is to be done before the hub is advanced again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// Wait.
    Wait(Wait),
    /// Everybody has connected: get ready for the ticks (priorities, memory), then advance.
    GetReady,
    /// The run is over.
    Ended,
}

/// A wait. To advance early is allowed, and only costs a look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wait {
    /// When it ends at the latest, on the environment's clock.
    pub until_ns: u64,
    /// What else ends it.
    pub on: Awaited,
}

/// What ends a wait before its time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Awaited {
    /// Nothing; a moment is let pass.
    Nothing,
    /// Nothing: it is the deadline of a tick, to be met exactly.
    Deadline,
    /// A request to run control.
    Control,
    /// A report of a consumer.
    Report,
    /// A command of this controller.
    Command(usize),
}

/// Where the machine stands between two advances.
#[derive(Debug, Clone)]
enum Stage {
    /// Until every part and every controller that the run does not begin without is there.
    Connecting {
        consumers: Patience,
        /// Of each controller, from when there is a state to answer.
        controllers: Vec<Patience>,
    },
    /// Connected; the first deadline is now.
    Ready,
    /// A tick is to be prepared, unless the run ends or rests.
    TickDue,
    /// Paused: a moment has been let pass.
    Rested,
    /// Some consumers must have taken the state of a tick first, so that their queues do not overflow.
    ConsumersBehind { tick: u64, whom: Whom, patience: Patience, began_ns: u64 },
    /// Real time.
    AwaitDeadline,
    /// Lockstep; it was waited for the answer of the controller `silent`.
    AwaitAnswers { patience: Patience, silent: Option<usize> },
    /// The last tick has been made.
    Ending { patience: Patience, abandoned: Patience },
    /// Over, or failed.
    Over,
}

/// What a stage comes to: the next stage, and whether to return from the advance first.
type Step = (Stage, Option<Next>);

/// The tick.
#[derive(Debug)]
pub struct Hub<P> {
    plant: P,
    settings: Settings,
    stage: Stage,
    lane: RunLane,
    latch: Latch,
    controllers: Vec<Controller>,
    consumers: Consumers,
    schedule: Schedule,
    tick: u64,
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
    /// A state that does not fit into a keyframe has been mentioned.
    keyframe_refused: bool,
    /// Facts of the tick that comes or is being made.
    timing: TickTiming,
    sources: [u32; MAX_CONTROLLERS],
    /// Of commands that begin to be held, and of safe commands.
    late_notes: [[LateNotes; 2]; MAX_CONTROLLERS],
}

impl<P: Plant> Hub<P> {
    /// A hub whose run has not begun.
    pub fn new(scene: &Scene, plant: P, settings: Settings, now_ns: u64) -> Hub<P> {
        Hub {
            plant,
            stage: Stage::Connecting {
                consumers: Patience::new(CONNECT_LIMIT_NS, now_ns),
                controllers: Vec::new(),
            },
            lane: RunLane::new(settings.keyframe_period_ticks),
            latch: Latch::new(scene),
            controllers: scene.controller.iter().map(Controller::new).collect(),
            consumers: Consumers::new(&settings.consumers),
            schedule: Schedule::new(settings.period_ns, now_ns),
            settings,
            tick: 0,
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
            timing: TickTiming::zeroed(),
            sources: [0; MAX_CONTROLLERS],
            late_notes: Default::default(),
        }
    }

    /// Ticks made.
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// What is controlled.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Does what can be done now, up to the next wait.
    ///
    /// # Errors
    /// Any [`HubError`]; the run is over then.
    pub fn advance<E: Environment>(&mut self, env: &mut E) -> Outcome<Next, P, E> {
        loop {
            let (stage, next) = match std::mem::replace(&mut self.stage, Stage::Over) {
                Stage::Connecting { consumers, controllers } => self.connect(env, consumers, controllers)?,
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
                Stage::AwaitAnswers { patience, silent } => self.await_answers(env, patience, silent)?,
                Stage::Ending { patience, abandoned } => self.await_last(env, patience, abandoned)?,
                Stage::Over => (Stage::Over, Some(Next::Ended)),
            };
            self.stage = stage;
            if let Some(next) = next {
                return Ok(next);
            }
        }
    }

    /// Between two ticks: obeys run control, and says what the next tick waits for.
    fn prepare<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        if self.tick >= self.settings.tick_count || self.ends(env) {
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

    /// Paused, with no step left to make.
    fn rests(&self) -> bool {
        self.paused && self.steps_left == 0
    }
}

/// A wait for something, at most until a time.
fn wait(on: Awaited, until_ns: u64) -> Option<Next> {
    Some(Next::Wait(Wait { until_ns, on }))
}

/// What a tick of the run lane failed by, as the run's error.
fn lane_failed<E, P>(tick: u64) -> impl Fn(LaneError<E, P>) -> HubError<E, P> {
    move |cause| match cause {
        LaneError::Output(cause) => HubError::Environment(cause),
        LaneError::Plant(cause) => HubError::Plant { tick, cause },
    }
}
