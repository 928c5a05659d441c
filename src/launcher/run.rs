//! One run, from the scene to the finished logs.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use foreign_text::foreign_line;
use ipc_types::clock::now_ns;
use ipc_types::messages::{Blame, EventCode, RunStatus, State, TickTiming};
use ipc_types::ports::PortError;
use ipc_types::process::{EXIT_GAP, EndRequest, ProcessorTime};
use ipc_types::scene::Scene;
use ipc_types::session::SessionError;
use recorder_proc::process::OUTPUT_FILE;
use voxel_grid::Ct;

use super::ending::Ending;
use super::hub::{DRR, Hub, HubError, LAUNCHER, PHYSICS, RECORDER, Recording, View};
use super::part::{Memory, PartProcess};
use super::replacements::Replacements;
use super::running::Running;
use super::subscriptions::Subscriptions;
use super::volume_source::{self, VolumeFiles};
use crate::failure::Failure;
use crate::report::anatomy::Anatomy;
use crate::report::{NOT_SHARED, RunFacts};

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
    /// The bone before the run; `None` without a volume or a report.
    pub anatomy: Option<Anatomy>,
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
            anatomy: self.anatomy.clone(),
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
    // For the report, while the parts start.
    let reported = ct.as_ref().filter(|_| plan.output.is_some());
    let anatomy = Anatomy::of(&plan.scene, reported.map(|ct| &ct.volume));
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
        anatomy,
        viewer,
    })
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
