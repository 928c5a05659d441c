//! One run, from the scene to the finished logs.
//!
//! Order of the end: the physics says "ended" and leaves when its consumers have everything; the DRR process and the
//! controllers leave on that; the recorder is asked last, when nobody writes any more.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ipc_types::messages::{
    CONTROL_STOP, Frame, PHASE_ENDED, PHASE_RUNNING, RunControl, RunStatus, State, TickTiming,
};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::process::{EndRequest, ProcessorTime};
use ipc_types::scene::{Controller, Scene};
use ipc_types::services;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::Waker;

use recorder_proc::process::OUTPUT_FILE;

use super::hub::{DRR, Hub, HubError, PHYSICS, RECORDER};
use super::part::{Memory, Part};
use super::understudy::Understudies;
use super::volume_source;
use crate::report::{NOT_SHARED, RunFacts};

const LOOK_TIME: Duration = Duration::from_millis(20);
/// How long a part may take to end after it has been asked.
const END_LIMIT: Duration = Duration::from_secs(130);
/// The same after something has failed.
const FAILED_END_LIMIT: Duration = Duration::from_secs(10);
/// How long a controller may go on after the run's end before it is asked to end, for one that does not watch the run.
const CONTROLLER_END_TIME: Duration = Duration::from_secs(3);

/// How long the viewer may take to tell its clients that the run has ended.
const VIEWER_END_LIMIT: Duration = Duration::from_secs(3);

/// How a run is to be made.
#[derive(Debug, Clone)]
pub struct RunPlan {
    /// Scene.
    pub scene: Scene,
    /// Folder for logs; none records nothing.
    pub output: Option<PathBuf>,
    /// Port of the viewer; none starts none.
    pub view: Option<u16>,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// All ticks were made, or the run was stopped by run control.
    Completed,
    /// Ctrl-C, or SIGTERM.
    Interrupted,
    /// A part died or ended before its time.
    PartDied {
        /// Its name.
        name: String,
        /// How it ended.
        how: String,
        /// The last lines it said.
        last_words: Vec<String>,
    },
}

impl Outcome {
    /// Which part died, how, and what it said last.
    fn death(&self) -> Option<String> {
        let Outcome::PartDied { name, how, last_words } = self else { return None };
        let words = if last_words.is_empty() { "nothing".to_owned() } else { last_words.join("\n  ") };
        Some(format!("part `{name}` died ({how}); its last words:\n  {words}"))
    }
}

/// What a run tells its caller when it is over.
#[derive(Debug, Clone)]
pub struct RunResult {
    /// How it ended.
    pub outcome: Outcome,
    /// Wall time from the first tick to the end of the physics.
    pub running: Duration,
    /// Wall time from the start of the launcher to the first tick.
    pub starting: Duration,
    /// Most memory of each process, by name.
    pub memory: Vec<(String, Memory)>,
    /// Processor time of each process from its start to its end, by name.
    pub processor: Vec<(String, Duration)>,
}

impl RunResult {
    /// What the report of the run takes from it.
    pub fn facts(&self, replay_command: String) -> RunFacts {
        let outcome = match &self.outcome {
            Outcome::Completed => "completed".to_owned(),
            Outcome::Interrupted => "interrupted".to_owned(),
            Outcome::PartDied { name, how, .. } => format!("part `{name}` died ({how})"),
        };
        let both = |(name, memory): &(String, Memory)| {
            [(name.clone(), memory.peak_resident), (format!("{name}{NOT_SHARED}"), memory.peak_private)]
        };
        RunFacts {
            wall_s: self.running.as_secs_f64(),
            startup_s: self.starting.as_secs_f64(),
            outcome,
            peak_memory_bytes: self.memory.iter().flat_map(both).collect(),
            processor_s: self
                .processor
                .iter()
                .map(|(name, time)| (name.clone(), time.as_secs_f64()))
                .collect(),
            replay_command,
        }
    }
}

/// Why a run could not be made.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The volume.
    #[error(transparent)]
    Volume(#[from] volume_io::VolumeError),
    /// The session or a part.
    #[error(transparent)]
    Hub(#[from] HubError),
    /// A port of the launcher.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A message.
    #[error(transparent)]
    Port(#[from] PortError),
}

/// What the progress display sees at every look.
#[derive(Debug)]
pub struct Glance<'a> {
    /// Folder of the session, for controllers that somebody else starts.
    pub session: &'a Path,
    /// What the run waits for that somebody else must start: see [`awaited`].
    pub awaited: &'a [String],
    /// Newest state, if there is one.
    pub state: Option<&'a State>,
    /// Newest status.
    pub status: Option<&'a RunStatus>,
    /// Timings of the ticks since the last look.
    pub timings: &'a [TickTiming],
    /// Frames so far.
    pub frames: u64,
    /// Running parts with what they use.
    pub parts: &'a [Part],
}

/// Makes a run; `show` is called at every look.
///
/// # Errors
/// Any [`RunError`]: the run did not begin. What goes wrong later is the [`Outcome`].
pub fn run(plan: &RunPlan, end: &EndRequest, mut show: impl FnMut(&Glance)) -> Result<RunResult, RunError> {
    let began = Instant::now();
    let volume = volume_source::load(&plan.scene)?;
    let hub = Hub::create(&plan.scene, volume.as_ref(), plan.output.is_some())?;
    let mut own_memory = Memory::default();
    own_memory.measure("self");
    // The one copy that stays is the one in shared memory.
    drop(volume);
    let mut eyes = Eyes::open(&hub.host.session)?;
    let mut parts = start_parts(plan, &hub)?;
    let mut understudies = Understudies::new(&hub.host.session)?;
    // No part of the run: whatever becomes of it, the run goes on.
    let mut viewer = plan.view.map(|port| hub.start_viewer(port)).transpose()?;
    let awaited = awaited(&plan.scene, &hub);
    let mut first_tick = None;
    let outcome = loop {
        hub.serve_late_joiners()?;
        eyes.look()?;
        show(&eyes.glance(hub.folder(), &awaited, &parts));
        if first_tick.is_none() && eyes.status.is_some_and(|status| status.phase >= PHASE_RUNNING) {
            first_tick = Some(Instant::now());
        }
        parts.iter_mut().for_each(Part::measure);
        if end.is_set() {
            break Outcome::Interrupted;
        }
        if let Some(index) = parts.iter_mut().position(|part| part.ended().is_some()) {
            // What the physics said before is on its way or here.
            eyes.look()?;
            let run_has_ended = eyes.status.is_some_and(|status| status.phase == PHASE_ENDED);
            let tick = eyes.state.as_ref().map_or(0, |state| state.tick);
            if !run_has_ended && understudies.replace(plan, &hub, &mut parts, index, tick)? {
                continue;
            }
            break judge(&mut parts[index], run_has_ended);
        }
        std::thread::sleep(LOOK_TIME);
    };
    if let Some(death) = outcome.death() {
        // At once: the others may take a while to end.
        tell!("trabecula: {death}");
    }
    let first_tick = first_tick.unwrap_or_else(Instant::now);
    let (over, outcome) = end_parts(plan, outcome, &mut eyes, &mut parts);
    let running = over.duration_since(first_tick);
    if let Some(viewer) = &mut viewer {
        viewer.wait(VIEWER_END_LIMIT);
    }
    eyes.look()?;
    show(&eyes.glance(hub.folder(), &awaited, &[]));
    let mut memory: Vec<(String, Memory)> =
        parts.iter().chain(&understudies.gone).map(|part| (part.name.clone(), part.memory)).collect();
    own_memory.measure("self");
    memory.push(("launcher".to_owned(), own_memory));
    let mut processor: Vec<(String, Duration)> =
        parts.iter().chain(&understudies.gone).map(|part| (part.name.clone(), part.processor)).collect();
    processor.push(("launcher".to_owned(), ProcessorTime::of("self").unwrap_or_default().own));
    Ok(RunResult { outcome, running, starting: first_tick.duration_since(began), memory, processor })
}

/// A part has ended. When the run is over, DRR and controllers may leave a moment before the physics does; the physics
/// ends well only when it is over, and nobody may leave before.
fn judge(part: &mut Part, run_has_ended: bool) -> Outcome {
    let status = part.ended();
    let succeeded = status.is_some_and(|status| status.success());
    if succeeded && (part.name == PHYSICS || (run_has_ended && part.name != RECORDER)) {
        return Outcome::Completed;
    }
    let how = match status {
        Some(status) if !status.success() => status.to_string(),
        _ => "ended before the run did".to_owned(),
    };
    Outcome::PartDied { name: part.name.clone(), how, last_words: part.last_words() }
}

fn start_parts(plan: &RunPlan, hub: &Hub) -> Result<Vec<Part>, HubError> {
    let mut parts = Vec::new();
    if let Some(output) = &plan.output {
        // For a viewer that joins later; without it that one shows the bone whole.
        let place = std::path::absolute(output).unwrap_or_else(|_| output.clone());
        let _ = std::fs::write(hub.folder().join(OUTPUT_FILE), place.as_os_str().as_encoded_bytes());
        parts.push(hub.start(RECORDER, &["recorder"], Some(output))?);
    }
    if plan.scene.drr.is_some() {
        parts.push(hub.start(DRR, &["drr"], None)?);
    }
    parts.push(hub.start(PHYSICS, &["physics"], None)?);
    for controller in &plan.scene.controller {
        match &controller.command {
            Some(words) => parts.push(hub.start_program(&controller.name, words)?),
            None if controller.external => {}
            None => {
                parts.push(hub.start(&controller.name, &["controller", "--name", &controller.name], None)?)
            }
        }
    }
    Ok(parts)
}

/// One line an external controller: how long the run waits for it, and how it connects.
fn awaited(scene: &Scene, hub: &Hub) -> Vec<String> {
    let line = |controller: &Controller| {
        let Controller { name, connect_limit_s, optional, .. } = controller;
        let wait = match optional {
            true => "may join at any time".to_owned(),
            false => format!("is waited for, {connect_limit_s} s at most"),
        };
        let how = hub.host.session.how_to_connect(name);
        format!("controller `{name}` {wait}; start it with {how}")
    };
    scene.controller.iter().filter(|controller| controller.external).map(line).collect()
}

/// Ends all parts in order; returns when the physics was over, and the outcome with how the others ended.
fn end_parts(plan: &RunPlan, outcome: Outcome, eyes: &mut Eyes, parts: &mut [Part]) -> (Instant, Outcome) {
    write_reason(plan, &outcome);
    let mut outcome = outcome;
    let (failed, stop) = match outcome {
        Outcome::Completed => (false, false),
        Outcome::Interrupted => (false, true),
        Outcome::PartDied { .. } => (true, true),
    };
    if stop {
        eyes.ask_to_stop();
    }
    // A physics that has not been heard of does not listen to run control yet, and may end without a word to the others.
    let is_deaf = stop && eyes.status.is_none();
    // Of a run that did not begin nobody has anything to finish.
    let judged = |name: &str, outcome: Outcome, parts: &mut [Part]| {
        if is_deaf { outcome } else { with_end_of(name, outcome, parts) }
    };
    let limit = if failed { FAILED_END_LIMIT } else { END_LIMIT };
    if !failed {
        spare_physics_the_dead(parts, limit);
    }
    let mut over = Instant::now();
    let order = |part: &Part| match part.name.as_str() {
        PHYSICS => 0,
        RECORDER => 2,
        _ => 1,
    };
    for turn in 0..3 {
        if turn == 2 {
            outcome = judged(DRR, outcome, parts);
            write_reason(plan, &outcome);
        }
        for part in parts.iter_mut().filter(|part| order(part) == turn) {
            // Only the physics ends by run control; when it has, DRR and controllers have heard so, unless it died.
            let goes_on = !failed && turn == 1 && part.name != DRR && !part.ends_within(CONTROLLER_END_TIME);
            if turn == 2 || failed || goes_on || is_deaf {
                part.ask_to_end();
            }
            // The recorder is never cut short: what was published is to be in the log.
            if !part.wait(if turn == 2 { END_LIMIT } else { limit }) {
                tell!("trabecula: {} did not end within {} s and was killed", part.name, limit.as_secs());
            }
            if turn == 0 {
                over = Instant::now();
            }
        }
    }
    if let Some(output) = &plan.output {
        // A recorder that died has not taken it.
        let _ = std::fs::remove_file(output.join(recorder_proc::process::REASON_FILE));
    }
    (over, judged(RECORDER, outcome, parts))
}

/// Waits for the physics' end. It stays until DRR process and recorder have everything: should one of them die, it is told to wait no
/// longer.
fn spare_physics_the_dead(parts: &mut [Part], limit: Duration) {
    let began = Instant::now();
    while began.elapsed() < limit {
        let mut has_died = |name: &str| {
            let part = parts.iter_mut().find(|part| part.name == name);
            part.and_then(Part::ended).is_some_and(|status| !status.success())
        };
        let nobody_comes = has_died(DRR) || has_died(RECORDER);
        let Some(physics) = parts.iter_mut().find(|part| part.name == PHYSICS) else { return };
        if nobody_comes {
            physics.ask_to_end();
        }
        if nobody_comes || physics.ends_within(LOOK_TIME) {
            return;
        }
    }
}

/// A run whose log could not be finished, or whose last frames are missing, has not succeeded, though all its ticks were made.
fn with_end_of(name: &str, outcome: Outcome, parts: &mut [Part]) -> Outcome {
    let found = parts.iter_mut().find(|part| part.name == name);
    let Some(part) = found.filter(|_| outcome.death().is_none()) else { return outcome };
    if part.ended().is_none_or(|status| status.success()) {
        return outcome;
    }
    let died = judge(part, false);
    died.death().iter().for_each(|death| tell!("trabecula: {death}"));
    died
}

/// Tells the recorder what to write into the log's end.
fn write_reason(plan: &RunPlan, outcome: &Outcome) {
    let reason = match outcome {
        Outcome::Completed => "completed",
        Outcome::Interrupted => "interrupted",
        Outcome::PartDied { name, .. } => name,
    };
    if let Some(output) = &plan.output {
        // Without it the log's end blames the launcher; the exit code and the message still tell.
        let _ = std::fs::write(output.join(recorder_proc::process::REASON_FILE), reason);
    }
}

/// The launcher's subscriptions.
struct Eyes {
    states: Subscriber<State>,
    statuses: Subscriber<RunStatus>,
    tick_timings: Subscriber<TickTiming>,
    frame_messages: Option<Subscriber<Frame>>,
    control: Publisher<RunControl>,
    physics: Waker,
    state: Option<Box<State>>,
    status: Option<RunStatus>,
    timings: Vec<TickTiming>,
    frames: u64,
}

impl Eyes {
    fn open(session: &Session) -> Result<Eyes, SessionError> {
        let has_frames = session.announcement().frame_bytes > 0;
        Ok(Eyes {
            states: session.newest_subscriber(&services::STATE)?,
            statuses: session.subscriber(&services::RUN_STATUS)?,
            tick_timings: session.subscriber(&services::TICK_TIMING)?,
            frame_messages: has_frames.then(|| session.subscriber(&services::FRAME)).transpose()?,
            control: session.publisher(&services::RUN_CONTROL)?,
            physics: session.waker(Reader::Physics)?,
            state: None,
            status: None,
            timings: Vec::new(),
            frames: 0,
        })
    }

    fn look(&mut self) -> Result<(), PortError> {
        if let Some(state) = self.states.receive_newest()? {
            self.state = Some(Box::new(*state.message()));
        }
        if let Some(status) = self.statuses.receive_newest()? {
            self.status = Some(*status.message());
        }
        self.timings.clear();
        while let Some(timing) = self.tick_timings.receive()? {
            self.timings.push(*timing.message());
        }
        if let Some(frames) = &self.frame_messages {
            while let Some(frame) = frames.receive()? {
                self.frames = frame.message().sequence;
            }
        }
        Ok(())
    }

    fn glance<'a>(&'a self, session: &'a Path, awaited: &'a [String], parts: &'a [Part]) -> Glance<'a> {
        Glance {
            session,
            awaited,
            state: self.state.as_deref(),
            status: self.status.as_ref(),
            timings: &self.timings,
            frames: self.frames,
            parts,
        }
    }

    fn ask_to_stop(&self) {
        // If the physics is gone, there is nobody to stop.
        let request = RunControl { request_id: 1, action: CONTROL_STOP, ..RunControl::zeroed() };
        let _ = self.control.send(&request);
        self.physics.wake();
    }
}

/// A fresh folder `<scene>-<date-time>` below `parent`.
///
/// # Errors
/// The system's.
pub fn output_folder(parent: &Path, scene: &Scene) -> std::io::Result<PathBuf> {
    let stamp = jiff::Zoned::now().strftime("%Y%m%d-%H%M%S").to_string();
    std::fs::create_dir_all(parent)?;
    for attempt in 0.. {
        let suffix = if attempt == 0 { String::new() } else { format!("-{attempt}") };
        let folder = parent.join(format!("{}-{stamp}{suffix}", scene.name));
        match std::fs::create_dir(&folder) {
            Ok(()) => return Ok(folder),
            Err(cause) if cause.kind() == std::io::ErrorKind::AlreadyExists && attempt < 1000 => {}
            Err(cause) => return Err(cause),
        }
    }
    Err(std::io::Error::other("no free folder name"))
}
