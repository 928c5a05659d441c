//! One run, from the scene to the finished logs.

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use foreign_text::foreign_line;
use ipc_types::clock::now_ns;
use ipc_types::messages::{Blame, EventCode, Phase, RunStatus, State, Tick, TickTiming};
use ipc_types::ports::PortError;
use ipc_types::process::{EXIT_GAP, EndRequest, ProcessorTime};
use ipc_types::scene::{Controller, Scene};
use ipc_types::session::SessionError;
use recorder_proc::process::OUTPUT_FILE;
use rustix::process::Signal;
use structures::Regions;
use voxel_grid::Ct;

use super::ending::Ending;
use super::hub::{DRR, Hub, HubError, LAUNCHER, PHYSICS, RECORDER, Recording, View};
use super::log_watch::LogWatch;
use super::part::{Memory, PartProcess};
use super::replacements::Replacements;
use super::subscriptions::Subscriptions;
use super::volume_source::{self, VolumeFiles};
use crate::failure::Failure;
use crate::report::{NOT_SHARED, RunFacts};

const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Time that the physics takes at most from closing its ports to its exit, on a loaded machine.
const PHYSICS_EXIT_TIME: Duration = Duration::from_secs(1);

/// Configuration of a run.
#[derive(Debug, Clone)]
pub struct RunPlan {
    /// Scene.
    pub scene: Scene,
    /// Folder for the logs; `None` to record nothing.
    pub output: Option<PathBuf>,
    /// The viewer to start, if any.
    pub view: Option<View>,
    /// Which files the volume can refer to.
    pub volume_files: VolumeFiles,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// All ticks were run.
    Completed,
    /// Run control stopped the run before its last tick.
    Stopped,
    /// Ctrl-C, SIGTERM or SIGHUP.
    Interrupted,
    /// The log was removed or moved; holds what happened to it.
    LogGone(String),
    /// A controller did not join in time or, in lockstep, did not reply in time; holds the code and the
    /// message from the physics.
    ControllerFailed(Blame),
    /// The simulation could not compute a tick; holds the message from the physics.
    SimulationFailed(String),
    /// A part died or ended too early.
    PartDied {
        /// Name of the part.
        name: String,
        /// How it ended.
        how: String,
        /// Its last output lines.
        last_words: Vec<String>,
    },
}

impl Outcome {
    /// Returns whether the physics ended the run without a failure.
    pub(super) fn is_regular(&self) -> bool {
        matches!(self, Outcome::Completed | Outcome::Stopped)
    }

    /// Returns the outcome's name and details, as in the table and `summary.json`.
    pub fn text(&self) -> String {
        match self {
            Outcome::Completed => "completed".to_owned(),
            Outcome::Stopped => "stopped".to_owned(),
            Outcome::Interrupted => "interrupted".to_owned(),
            Outcome::ControllerFailed(blame) => format!("{}: {}", blame.code.word(), blame.text),
            Outcome::SimulationFailed(text) => format!("{}: {text}", EventCode::SimulationFailed.word()),
            Outcome::PartDied { name, how, .. } => format!("part `{name}` died ({how})"),
            Outcome::LogGone(how) => how.clone(),
        }
    }

    /// Returns what failed: which part died, how, and its last output.
    pub(super) fn death(&self) -> Option<String> {
        match self {
            Outcome::Completed | Outcome::Stopped | Outcome::Interrupted => None,
            Outcome::ControllerFailed(blame) => Some(blame.text.clone()),
            Outcome::SimulationFailed(text) => Some(format!("the simulation failed: {text}")),
            Outcome::LogGone(how) => Some(how.clone()),
            Outcome::PartDied { name, how, last_words } => {
                let lines: Vec<String> =
                    last_words.iter().map(|line| foreign_line(line).to_string()).collect();
                let words = if lines.is_empty() { "nothing".to_owned() } else { lines.join("\n  ") };
                Some(format!("part `{name}` died ({how}); its last output:\n  {words}"))
            }
        }
    }
}

/// The result of a run.
#[derive(Debug)]
pub struct RunResult {
    /// How it ended.
    pub outcome: Outcome,
    /// Folder of its session, removed by now.
    pub session: PathBuf,
    /// Whether a tick was run or due.
    pub has_started: bool,
    /// Whether the log lacks messages because the recorder could not keep up.
    pub has_gap: bool,
    /// Wall time from the first tick to the end of the physics.
    pub running: Duration,
    /// Wall time from the start of the launcher to the first tick.
    pub starting: Duration,
    /// Start of the launcher on the monotonic clock, ns.
    pub began_ns: u64,
    /// Wall time of each phase, by name, in order.
    pub phases: [(&'static str, Duration); 5],
    /// Peak memory of each process, by name.
    pub memory: Vec<(String, Memory)>,
    /// Processor time of each process from its start to its end, by name.
    pub processor: Vec<(String, Duration)>,
    /// Distance between the volume's voxels along i, j, k; `None` without a volume.
    pub volume_spacing_m: Option<[f64; 3]>,
    /// Where the critical structures are in the volume; `None` without a volume or a structure.
    pub regions: Option<Regions>,
    /// The viewer, if it is now showing the run's log; it ends with the page.
    pub viewer: Option<PartProcess>,
}

impl RunResult {
    /// The facts that the run's report needs.
    pub fn facts(&self, replay_command: String) -> RunFacts {
        let outcome = self.outcome.text() + if self.has_gap { ", with a gap in the log" } else { "" };
        let both = |(name, memory): &(String, Memory)| {
            [(name.clone(), memory.peak_resident), (format!("{name}{NOT_SHARED}"), memory.peak_private)]
        };
        RunFacts {
            wall_s: self.running.as_secs_f64(),
            startup_s: self.starting.as_secs_f64(),
            phases_s: self
                .phases
                .iter()
                .map(|(name, time)| ((*name).to_owned(), time.as_secs_f64()))
                .collect(),
            outcome,
            peak_memory_bytes: self.memory.iter().flat_map(both).collect(),
            processor_s: self
                .processor
                .iter()
                .map(|(name, time)| (name.clone(), time.as_secs_f64()))
                .collect(),
            volume_spacing_m: self.volume_spacing_m,
            regions: self.regions.clone(),
            replay_command,
        }
    }
}

/// Why a run could not start.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The volume cannot be loaded.
    #[error(transparent)]
    Volume(#[from] volume_io::VolumeError),
    /// The session or a part cannot be started.
    #[error(transparent)]
    Hub(#[from] HubError),
    /// A port of the launcher cannot be opened.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A message cannot be sent or received.
    #[error(transparent)]
    Port(#[from] PortError),
}

impl From<RunError> for Failure {
    fn from(error: RunError) -> Failure {
        match error {
            RunError::Hub(error) => error.into(),
            other => Failure::failed(other),
        }
    }
}

/// Input of the progress display at every update.
#[derive(Debug)]
pub struct RunSnapshot<'a> {
    /// Folder of the session, needed to start external controllers.
    pub session: &'a Path,
    /// Controllers that the user must start before the run continues: see `awaited`.
    pub awaited: &'a [String],
    /// Newest state, if any.
    pub state: Option<&'a State>,
    /// Newest status, if any.
    pub status: Option<&'a RunStatus>,
    /// Timings of the ticks since the last update.
    pub timings: &'a [TickTiming],
    /// Frames so far.
    pub frames: u64,
    /// What the run has been waiting for, reported once.
    pub waiting: Option<&'a str>,
    /// Limits of this machine that affect the run, and refused commands, each reported once.
    pub cautions: &'a [String],
    /// Running parts, with their resource use.
    pub parts: &'a [PartProcess],
}

/// Runs a scene with its own volume; calls `show` at every update.
///
/// # Errors
/// Any [`RunError`]: the run did not start. Later failures are part of the [`Outcome`].
pub fn run(plan: &RunPlan, end: &EndRequest, show: impl FnMut(&RunSnapshot)) -> Result<RunResult, RunError> {
    let began = Instant::now();
    let ct = volume_source::load(&plan.scene, plan.volume_files)?;
    run_with(plan, ct, began, end, show)
}

/// Runs a scene with a volume that has been loading since `began`.
pub fn run_with(
    plan: &RunPlan,
    ct: Option<Ct>,
    began: Instant,
    end: &EndRequest,
    mut show: impl FnMut(&RunSnapshot),
) -> Result<RunResult, RunError> {
    let loaded = Instant::now();
    let recording = if plan.output.is_some() { Recording::On } else { Recording::Off };
    let hub = Hub::create(&plan.scene, ct.as_ref(), recording)?;
    let mut own_memory = Memory::default();
    own_memory.measure("self");
    let volume_spacing_m = ct.as_ref().map(|ct| ct.volume.grid.spacing_m());
    let subscriptions = Subscriptions::open(&hub.host.session)?;
    let parts = start_parts(plan, &hub)?;
    // While the parts start.
    let regions = Regions::of(&plan.scene, ct.as_ref().map(|ct| &ct.volume));
    // Keep only the copy in shared memory.
    drop(ct);
    let replacements = Replacements::new(&hub.host.session)?;
    // The viewer is not a part of the run: if it fails, the run continues.
    let viewer = plan.view.map(|view| hub.start_viewer(view)).transpose()?;
    let begun = Instant::now();
    let mut running = Running { plan, end, hub: &hub, subscriptions, parts, replacements, first_tick: None };
    let outcome = running.watch(&mut show)?;
    let Running { mut subscriptions, mut parts, replacements, first_tick, .. } = running;
    if let Some(death) = outcome.death() {
        // Report at once: the other parts may take a while to end.
        tell!("trabecula: {death}");
    }
    let has_started = first_tick.is_some();
    let first_tick = first_tick.unwrap_or_else(Instant::now);
    let ending = Ending { plan, end, host: &hub.host, has_begun: subscriptions.status.is_some() };
    let (over, outcome) = ending.end_parts(outcome, &mut parts);
    let running = over.duration_since(first_tick);
    let phases = [
        ("volume", loaded.duration_since(began)),
        ("session", begun.duration_since(loaded)),
        ("connect", first_tick.saturating_duration_since(begun)),
        ("ticks", running),
        ("parts_end", over.elapsed()),
    ];
    let began_ns = now_ns().saturating_sub(began.elapsed().as_nanos() as u64);
    let viewer = viewer.and_then(|viewer| ending.end_viewer(viewer, &outcome));
    subscriptions.poll()?;
    if !end.is_set() {
        show(&subscriptions.snapshot(hub.folder(), &[], &[]));
    }
    own_memory.measure("self");
    let all = || parts.iter().chain(&replacements.gone);
    let mut memory: Vec<(String, Memory)> = all().map(|part| (part.name.clone(), part.memory)).collect();
    memory.push((LAUNCHER.to_owned(), own_memory));
    let mut processor: Vec<(String, Duration)> =
        all().map(|part| (part.name.clone(), part.processor)).collect();
    processor.push((LAUNCHER.to_owned(), ProcessorTime::of("self").unwrap_or_default().own));
    let has_gap = parts.iter_mut().any(has_gap);
    let (session, starting) = (hub.folder().to_owned(), first_tick.duration_since(began));
    Ok(RunResult {
        outcome,
        session,
        has_started,
        has_gap,
        running,
        starting,
        began_ns,
        phases,
        memory,
        processor,
        volume_spacing_m,
        regions,
        viewer,
    })
}

/// A run in progress.
struct Running<'a> {
    plan: &'a RunPlan,
    end: &'a EndRequest,
    hub: &'a Hub,
    subscriptions: Subscriptions,
    parts: Vec<PartProcess>,
    replacements: Replacements,
    first_tick: Option<Instant>,
}

impl Running<'_> {
    /// Watches the parts until something ends the run.
    fn watch(&mut self, show: &mut impl FnMut(&RunSnapshot)) -> Result<Outcome, RunError> {
        let awaited = awaited(&self.plan.scene, self.hub);
        let has_ring = self.plan.scene.recording.ring_s > 0.0;
        let mut log = self.plan.output.as_deref().map(|folder| LogWatch::new(folder, has_ring));
        loop {
            self.hub.serve_late_joiners()?;
            self.subscriptions.poll()?;
            show(&self.subscriptions.snapshot(self.hub.folder(), &awaited, &self.parts));
            if self.first_tick.is_none() && self.subscriptions.status.is_some_and(has_started) {
                self.first_tick = Some(self.subscriptions.first_start().unwrap_or_else(Instant::now));
            }
            self.subscriptions.forget_shown();
            self.parts.iter_mut().for_each(PartProcess::measure);
            if self.end.is_set() {
                return Ok(Outcome::Interrupted);
            }
            if let Some(index) = self.parts.iter_mut().position(|part| part.ended().is_some()) {
                match self.part_ended(index)? {
                    Some(outcome) => return Ok(outcome),
                    None => continue,
                }
            }
            if let Some(how) = log.as_mut().and_then(LogWatch::check) {
                return Ok(Outcome::LogGone(how));
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Handles a part that has ended; returns the outcome if that ends the run.
    fn part_ended(&mut self, index: usize) -> Result<Option<Outcome>, RunError> {
        // The physics publishes the end before any part can exit because of it.
        self.subscriptions.poll()?;
        let succeeded = self.parts[index].ended().is_some_and(|status| status.success());
        let run_has_ended = self.subscriptions.has_ended() || (succeeded && self.physics_ends()?);
        // Other parts exit cleanly when the physics fails; its report may have been dropped with its ports.
        let failed = |part: &mut PartProcess| part.name == PHYSICS && part.ended().is_some();
        let physics = self.parts.iter_mut().position(failed).filter(|_| succeeded && !run_has_ended);
        let index = physics.unwrap_or(index);
        let tick = self.subscriptions.state.as_ref().map_or(Tick::START, |state| Tick(state.tick));
        let run = if run_has_ended { RunState::Ended } else { RunState::Open };
        let goes_on = match run {
            RunState::Ended => self.replacements.dismiss(self.plan, &mut self.parts, index),
            RunState::Open => self.replacements.replace(self.plan, self.hub, &mut self.parts, index, tick)?,
        };
        if goes_on {
            return Ok(None);
        }
        let outcome = judge(&mut self.parts[index], run);
        Ok(Some(self.blamed(&outcome).unwrap_or_else(|| self.told_apart(outcome))))
    }

    /// Returns whether the physics reports the end of the run or exits successfully within
    /// [`PHYSICS_EXIT_TIME`]; false as soon as it has failed. The transport drops unread messages with their
    /// sender, so the report is lost if the physics closes its ports before the next poll: the end of a short
    /// run was then taken for the early end of a controller.
    fn physics_ends(&mut self) -> Result<bool, RunError> {
        let limit = Instant::now() + PHYSICS_EXIT_TIME;
        loop {
            let mut physics = self.parts.iter_mut().filter(|part| part.name == PHYSICS);
            let status = physics.find_map(PartProcess::ended);
            if self.subscriptions.has_ended() || status.is_some_and(|status| status.success()) {
                return Ok(true);
            }
            if status.is_some() || Instant::now() >= limit || self.end.is_set() {
                return Ok(false);
            }
            std::thread::sleep(POLL_PERIOD);
            self.subscriptions.poll()?;
        }
    }

    /// Returns the outcome if the physics ended the run because of a controller or the simulation.
    fn blamed(&self, outcome: &Outcome) -> Option<Outcome> {
        let is_end = match outcome {
            Outcome::PartDied { name, .. } => name == PHYSICS || self.subscriptions.has_ended(),
            _ => true,
        };
        let mut blame = self.hub.host.session.blame().filter(|_| is_end)?;
        let Some(name) = &blame.controller else { return Some(Outcome::SimulationFailed(blame.text)) };
        let mut controllers = self.plan.scene.controller.iter();
        let controller = controllers.find(|controller| controller.name == *name)?;
        if controller.external && blame.code == EventCode::ControllerMissing {
            let how = self.hub.host.session.how_to_connect(&controller.name);
            blame.text += &format!("; it is external: start it with {how}");
        }
        Some(Outcome::ControllerFailed(blame))
    }

    /// Distinguishes a stopped run, which ended before its last tick, from a completed one.
    fn told_apart(&self, outcome: Outcome) -> Outcome {
        let cut = |status: RunStatus| self.subscriptions.has_ended() && status.tick < status.tick_count;
        match outcome {
            Outcome::Completed if self.subscriptions.status.is_some_and(cut) => Outcome::Stopped,
            other => other,
        }
    }
}

/// Returns whether every part had connected; a run that ends before that has run no tick.
fn has_started(status: RunStatus) -> bool {
    match status.phase() {
        Ok(Phase::Running | Phase::Paused) => true,
        Ok(Phase::Ended) => status.tick > 0,
        Ok(Phase::Connecting) | Err(_) => false,
    }
}

/// Whether the physics has published the end of the run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum RunState {
    Open,
    Ended,
}

/// Judges how a part ended. Once the run is over, DRR and controllers may exit shortly before the physics
/// does. The physics exits cleanly only after the run is over, and no part may exit before that.
pub(super) fn judge(part: &mut PartProcess, run: RunState) -> Outcome {
    let status = part.ended();
    let succeeded = status.is_some_and(|status| status.success());
    if succeeded && (part.name == PHYSICS || (run == RunState::Ended && part.name != RECORDER)) {
        return Outcome::Completed;
    }
    let how = match status {
        Some(status) if status.signal() == Some(Signal::KILL.as_raw()) && part.may_have_lacked_memory() => {
            format!("{status}, probably by the kernel because memory ran out")
        }
        Some(status) if !status.success() => status.to_string(),
        _ => "ended before the run".to_owned(),
    };
    Outcome::PartDied { name: part.name.clone(), how, last_words: part.last_words() }
}

fn start_parts(plan: &RunPlan, hub: &Hub) -> Result<Vec<PartProcess>, HubError> {
    let mut parts = Vec::new();
    if let Some(output) = &plan.output {
        // A viewer that joins late needs this to show the bone that is already drilled.
        let place = std::path::absolute(output).unwrap_or_else(|_| output.clone());
        let _ = hub.host.write(OUTPUT_FILE, place.as_os_str().as_encoded_bytes());
        parts.push(hub.start(RECORDER, &[RECORDER], Some(output))?);
    }
    if plan.scene.drr.is_some() {
        parts.push(hub.start(DRR, &[DRR], None)?);
    }
    parts.push(hub.start(PHYSICS, &[PHYSICS], None)?);
    for controller in &plan.scene.controller {
        match &Hub::program_of(controller)? {
            Some(words) => parts.push(hub.start_program(&controller.name, words)?),
            None if controller.external => {}
            None => {
                parts.push(hub.start(&controller.name, &["controller", "--name", &controller.name], None)?)
            }
        }
    }
    Ok(parts)
}

/// Returns one line per external controller: how long the run waits for it, and how to connect it.
fn awaited(scene: &Scene, hub: &Hub) -> Vec<String> {
    let line = |controller: &Controller| {
        let Controller { name, connect_limit_s, optional, .. } = controller;
        let wait = match optional {
            true => "may join at any time".to_owned(),
            false => format!("has {connect_limit_s} s to connect"),
        };
        let how = hub.host.session.how_to_connect(name);
        format!("controller `{name}` {wait}; start it with {how}")
    };
    scene.controller.iter().filter(|controller| controller.external).map(line).collect()
}

/// Whether the recorder has finished its log with messages missing.
pub(super) fn has_gap(part: &mut PartProcess) -> bool {
    part.name == RECORDER && part.ended().and_then(|status| status.code()) == Some(i32::from(EXIT_GAP))
}

/// Creates a fresh folder `<scene>-<date-time>` below `parent`.
pub fn output_folder(parent: &Path, scene: &Scene) -> std::io::Result<PathBuf> {
    let stamp = jiff::Zoned::now().strftime("%Y%m%d-%H%M%S").to_string();
    output_file::create_folder(parent)?;
    for attempt in 0.. {
        let suffix = if attempt == 0 { String::new() } else { format!("-{attempt}") };
        let folder = parent.join(format!("{}-{stamp}{suffix}", scene.name));
        match std::fs::create_dir(&folder) {
            // Sync the folder to disk before anything is written into it.
            Ok(()) => return output_file::sync_folder(parent).map(|()| folder),
            Err(cause) if cause.kind() == std::io::ErrorKind::AlreadyExists && attempt < 1000 => {}
            Err(cause) => return Err(cause),
        }
    }
    Err(std::io::Error::other("no free folder name"))
}
