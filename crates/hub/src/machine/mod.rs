//! The state machine.

mod commands;
mod connecting;
mod control;
mod failure;
mod ticking;
mod waiting;

use messages::{
    Blame, CommandSource, ControllerIndex, MAX_CONTROLLERS, Part, Phase, Plant, Severity, Tick, TickTiming,
};
use scene::{MAX_STRUCTURES, Mode, Scene};

use crate::consumers::{ConsumerSet, Consumers};
use crate::environment::{Environment, Note};
use crate::latch::Latch;
use crate::late_notes::LateNotes;
use crate::lead::recorder_lead_ticks;
use crate::pacing::Schedule;
use crate::patience::ProcessTimeout;
use crate::rate_limit::{RateLimit, WarningLimit};
use crate::run_lane::RunLane;
use commands::Controller;
use control::StatusTiming;
use failure::{Failure, lane_failed};

pub use failure::{ControllerFault, HubError};

const MS: u64 = 1_000_000;
const NS_PER_S: u64 = 1000 * MS;

/// How far the hub may run ahead of a consumer in lockstep: half of the state queue.
const LEAD_TICKS: u64 = 256;
/// How long a part may take to connect; a DRR process first reads the whole volume.
const CONNECT_LIMIT_NS: u64 = 60_000 * MS;
/// How long a consumer may make no progress in lockstep; a full frame of a large CT takes seconds.
const CONSUMER_LIMIT_NS: u64 = 120_000 * MS;
/// As above, after a signal has ended the run; whatever the consumers have not taken stays in their queues.
const ABANDONED_LIMIT_NS: u64 = 500 * MS;
/// How long a failed run waits for its recorder, which reads nothing more from a publisher that it has not
/// seen alive.
const FAILED_LIMIT_NS: u64 = 2_000 * MS;
const STATUS_PERIOD_NS: u64 = 100 * MS;
/// How long the run waits for a controller before it reports the wait.
const SILENT_WAIT_NS: u64 = NS_PER_S;
/// Poll interval while the run is paused, while parts connect, and while a consumer is behind.
const POLL_NS: u64 = 20 * MS;
const CONNECT_LOOK_NS: u64 = MS;
const REPORT_LOOK_NS: u64 = 2 * MS;

const _: () = assert!(2 * LEAD_TICKS <= messages::services::STATE.queue_length as u64);
const _: () = assert!(ABANDONED_LIMIT_NS < CONSUMER_LIMIT_NS && REPORT_LOOK_NS < STATUS_PERIOD_NS);

/// The settings that the hub takes from a scene and its session.
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
    /// Whether a recorder keeps only the last seconds, which a client can have saved.
    pub keeps_ring: bool,
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
    /// Derives the settings from a scene and the session's consumers.
    pub fn new(scene: &Scene, consumers: &[Part]) -> Settings {
        let recorded = consumers.contains(&Part::Recorder);
        Settings {
            mode: scene.run.mode,
            period_ns: scene.dt_ns(),
            tick_count: scene.tick_count(),
            keyframe_period_ticks: scene.keyframe_period_ticks().filter(|_| recorded),
            keeps_ring: recorded && scene.recording.ring_s > 0.0,
            lead_ticks: LEAD_TICKS,
            recorder_lead_ticks: recorder_lead_ticks(scene),
            controller_limit_ns: (scene.run.controller_limit_ms * 1e6) as u64,
            consumers: consumers.to_vec(),
        }
    }

    /// Returns the tick of the run's last state.
    fn end(&self) -> Tick {
        Tick(self.tick_count)
    }
}

/// The result of a part of the machine.
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
    /// What else can end it.
    pub on: WakeCondition,
}

/// What ends a wait early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WakeCondition {
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

/// The machine's stage between two advances.
#[derive(Debug, Clone)]
enum Stage {
    /// Waits until every part and every required controller has connected.
    Connecting {
        consumers: ProcessTimeout,
        /// One timeout per controller, starting when there is a state to answer.
        controllers: Vec<ProcessTimeout>,
        /// Time until the wait is reported to the user.
        notice: Option<ProcessTimeout>,
    },
    /// All connected; the first deadline is now.
    Ready,
    /// A tick is due, unless the run ends or is paused.
    TickDue,
    /// Paused; the poll interval has passed.
    Rested,
    /// Waits until these consumers have taken the state of `tick`, so that their queues do not overflow.
    ConsumersBehind { tick: Tick, whom: ConsumerSet, patience: ProcessTimeout, began_ns: u64 },
    /// Waits for the deadline (real time).
    AwaitDeadline,
    /// Waits for answers (lockstep); `silent` is the controller last waited for, `notice` as in `Connecting`.
    AwaitAnswers { patience: ProcessTimeout, silent: Option<ControllerIndex>, notice: Option<ProcessTimeout> },
    /// The last tick is done.
    Ending { patience: ProcessTimeout, abandoned: ProcessTimeout },
    /// Ended or failed.
    Over,
}

/// The result of a stage: the next stage, and what to return from the advance first, if anything.
type Step = (Stage, Option<Next>);

/// Items that ticks could not handle because a capacity was reached, and when they were reported.
#[derive(Debug, Default)]
struct Shortfall {
    /// Counted once in every tick.
    total: u64,
    notes: LateNotes,
}

/// The tick as a state machine.
#[derive(Debug)]
pub struct Hub<P: Plant> {
    plant: P,
    /// A reported failure, and how long it still waits for the recorder.
    failing: Option<(Failure<P::Error>, ProcessTimeout)>,
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
    /// Whether the event "the model is not valid" has been sent since the start, or since the last reset.
    invalid_told: bool,
    /// Whether the arm is in a protective stop.
    is_stopped: bool,
    creation_told: bool,
    /// Voxels that could not be cut because memory ran out.
    uncut_voxels: Shortfall,
    /// Contacts beyond the contact capacity.
    left_out_contacts: Shortfall,
    /// Timing of the next or current tick.
    timing: TickTiming,
    sources: [CommandSource; MAX_CONTROLLERS],
    /// Notes per controller: one for commands that start being held, one for safe commands.
    late_notes: [[LateNotes; 2]; MAX_CONTROLLERS],
    /// Notes about each critical structure: margin, breach.
    approach_notes: [[LateNotes; 2]; MAX_STRUCTURES],
}

impl<P: Plant> Hub<P> {
    /// Creates a hub before the start of its run.
    pub fn new(scene: &Scene, plant: P, settings: Settings, now_ns: u64) -> Hub<P> {
        Hub {
            plant,
            failing: None,
            stage: Stage::Connecting {
                consumers: ProcessTimeout::new(CONNECT_LIMIT_NS, now_ns),
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
            invalid_told: false,
            is_stopped: false,
            creation_told: false,
            uncut_voxels: Shortfall::default(),
            left_out_contacts: Shortfall::default(),
            timing: TickTiming::zeroed(),
            sources: [CommandSource::None; MAX_CONTROLLERS],
            late_notes: Default::default(),
            approach_notes: Default::default(),
        }
    }

    /// Returns the number of ticks so far.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// Returns the plant.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Does everything that can be done now, up to the next wait.
    ///
    /// # Errors
    /// Any [`HubError`]; the run is then over. If a controller or the plant is the cause, every client has
    /// been notified.
    pub fn advance<E: Environment>(&mut self, env: &mut E) -> Outcome<Next, P, E> {
        if let Some((failure, patience)) = self.failing.take() {
            return self.fail(env, failure, patience);
        }
        let error = match self.advance_stages(env) {
            Err(error) => error,
            advanced => return advanced,
        };
        let failure = Failure::of(error)?;
        let blame = failure.blame();
        env.leave_blame(&blame);
        let Blame { code, text, .. } = &blame;
        env.send_event(&Note { tick: self.tick, severity: Severity::Error, code: *code, text })?;
        self.send_status(env, Phase::Ended, StatusTiming::Now)?;
        env.wake_controllers();
        let patience = ProcessTimeout::new(FAILED_LIMIT_NS, env.now_ns());
        self.fail(env, failure, patience)
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
                Stage::Over => (Stage::Over, Some(Next::Ended)),
            };
            self.stage = stage;
            if let Some(next) = next {
                return Ok(next);
            }
        }
    }

    /// Runs between two ticks: executes run control and decides what the next tick waits for.
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
            patience: ProcessTimeout::new(CONSUMER_LIMIT_NS, now_ns),
            began_ns,
        };
        let stage = match self.settings.mode {
            Mode::Realtime => {
                env.work_ends();
                self.timing.recorder_wait_ns = 0;
                let lead = self.settings.recorder_lead_ticks.map(|lead| self.tick.saturating_sub(lead));
                match lead.filter(|tick| self.consumers.behind(*tick, ConsumerSet::Recorder).is_some()) {
                    None => Stage::AwaitDeadline,
                    Some(tick) => {
                        behind(ConsumerSet::Recorder, tick, now_ns.max(self.schedule.deadline_ns()))
                    }
                }
            }
            Mode::Lockstep => {
                let tick = self.tick.saturating_sub(self.settings.lead_ticks);
                match self.consumers.behind(tick, ConsumerSet::Everybody) {
                    None => self.after_consumers(now_ns, now_ns),
                    Some(_) => behind(ConsumerSet::Everybody, tick, now_ns),
                }
            }
        };
        Ok((stage, None))
    }

    fn ends<E: Environment>(&self, env: &E) -> bool {
        self.stopped || env.end_requested()
    }

    /// Returns whether the run is paused with no pending step.
    fn rests(&self) -> bool {
        self.paused && self.steps_left == 0
    }
}

/// Returns a wait for `on`, until `until_ns` at the latest.
fn wait(on: WakeCondition, until_ns: u64) -> Option<Next> {
    Some(Next::Wait(Wait { until_ns, on }))
}
