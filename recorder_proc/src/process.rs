//! The recorder process: takes every message of every service and writes the two logs.
//!
//! It polls: nobody wakes it, so it costs the physics nothing. Its queues hold [`RECORDER_QUEUE_TICKS`]; one thread takes
//! from them and puts the log together, another writes the files ([`background`](crate::background)). The physics in lockstep, and
//! with `recording.on_full = "wait"` in real time, waits for its `Progress`; else a recorder that is later than its queues
//! leaves a gap: said at once in an event, counted in the log's end, and told by the exit code ([`RecorderError::Gap`]).

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use hub::rate_limit::WarningLimit;
use ipc_types::clock::now_ns;
use ipc_types::layout::Message;
use ipc_types::messages::{
    Command, DrrReply, DrrRequest, EVENT_MESSAGES_LOST, EVENT_REQUEST_REFUSED, Event, Frame, FrameTiming,
    Keyframe, Latched, PHASE_ENDED, Part, Progress, Removed, RunControl, RunControlReply, RunStatus,
    SENDER_RECORDER, SEVERITY_WARNING, State, TickTiming, Volume,
};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::process::{
    EXIT_FAILED, EXIT_GAP, EndRequest, EventSender, Role, VOLUME_LIMIT, await_volume, prioritise,
    session_scene,
};
use ipc_types::scene::{Images, Mode, Recording, Scene, SceneError};
use ipc_types::services::{self, RECORDER_QUEUE_TICKS};
use ipc_types::session::{Reader, Session, SessionError, host_is_alive};
use ipc_types::wake::{Waiter, Waker};
use thiserror::Error;

use crate::background::{BackgroundFile, BackgroundOptions};
use crate::gaps::Gaps;
use crate::header::CALIBRATION_ATTACHMENT;
use crate::{
    BuildInfo, EndMarker, EndReason, LogError, LogHeader, RunLog, RunMode, TimingLog, reason_file, topics,
};

/// Longest time between two looks at the queues: a small part of what they hold.
const LOOK_TIME: Duration = Duration::from_millis(2);
/// States after which progress is reported in between.
const PROGRESS_TICKS: u64 = 64;
/// States that are taken before the other queues are looked at again.
const TICKS_PER_ROUND: usize = 16;
/// Messages of one service that clients write which are taken before the other queues are looked at again: a client that never
/// stops would keep the recorder from the ticks.
const CLIENT_MESSAGES_PER_ROUND: usize = 256;
/// Rounds after the run's end, in which the longest queue of clients' messages (2048 events) is emptied.
const LAST_ROUNDS: usize = 8;
/// How long a physics may take to end whose launcher has been killed.
const ORPHANED_LIMIT: Duration = Duration::from_secs(5);
/// Time without a state after which the timing lane is handed to the file.
const QUIET_TIME: Duration = Duration::from_millis(100);
/// Why the recorder ends early.
#[derive(Debug, Error)]
pub enum RecorderError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be taken.
    #[error(transparent)]
    Port(#[from] PortError),
    /// A log cannot be written.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The scene's text cannot be read back.
    #[error("{path}: {cause}")]
    SceneText {
        /// Scene in the session's folder.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// The volume did not come.
    #[error("the volume did not arrive within {} s; is the launcher running?", VOLUME_LIMIT.as_secs())]
    NoVolume,
    /// Signals cannot be handled.
    #[error("signals cannot be handled: {0}")]
    Signals(std::io::Error),
    /// The folder of the logs cannot be brought to the disk.
    #[error("{}: cannot be brought to the disk: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The log is finished, but something that belongs into `run.mcap` never came.
    #[error(
        "the log has a gap ({lost}): the recorder was held up for longer than the {RECORDER_QUEUE_TICKS} ticks that its queues hold; \
         `recording.on_full = \"wait\"` makes the physics wait for it"
    )]
    Gap {
        /// What is missing, by topic.
        lost: String,
    },
}

impl RecorderError {
    /// Exit code of the recorder process.
    pub fn exit_code(&self) -> u8 {
        if matches!(self, RecorderError::Gap { .. }) { EXIT_GAP } else { EXIT_FAILED }
    }
}

/// Name of the file in the session's folder that says where the run is recorded.
pub const OUTPUT_FILE: &str = "output";

/// Records a session into `run.mcap` and `timing.mcap` of a folder until it is asked to end (SIGTERM); then takes what
/// still waits and finishes both logs.
///
/// # Errors
/// Any [`RecorderError`].
pub fn run(session_folder: &Path, output: &Path) -> Result<(), RecorderError> {
    let end = EndRequest::install().map_err(RecorderError::Signals)?;
    let scene = session_scene(session_folder)?;
    if scene.run.mode == Mode::Realtime {
        // Before the writing threads start, which are to have it too.
        prioritise(Role::Recorder, scene.run.policy);
    }
    let session = Session::join(session_folder)?;
    session.claim(Part::Recorder)?;
    let header = header(&session, &scene, &end)?;
    let ports = Ports::open(&session, &scene)?;
    let (run, timing) = (output.join("run.mcap"), output.join("timing.mcap"));
    let mut recorder = Recorder {
        run: RunLog::create_named(create(&run, BackgroundOptions::RUN)?, &run, &header)?,
        timing: TimingLog::create_named(create(&timing, BackgroundOptions::TIMING)?, &timing, &header)?,
        recording: scene.recording.clone(),
        newest_tick: 0,
        reported_tick: 0,
        gaps: Gaps::default(),
        run_has_ended: false,
        session_folder: session_folder.to_owned(),
        strangers: 0,
        stranger_warnings: WarningLimit::default(),
        gap_warnings: WarningLimit::default(),
        ports,
    };
    // From here on a machine that loses its power leaves files that say what they are.
    sync_folder(output)?;
    let recorded = recorder.record(&end);
    // Whatever went wrong, what has been taken is kept.
    let finished = recorder.finish(output, recorded.is_err());
    recorded.and(finished)
}

fn create(path: &Path, options: BackgroundOptions) -> Result<BackgroundFile, LogError> {
    BackgroundFile::create(path, options).map_err(|source| match source.kind() {
        ErrorKind::AlreadyExists => LogError::Exists { path: path.into() },
        _ => LogError::Create { path: path.into(), source },
    })
}

fn sync_folder(folder: &Path) -> Result<(), RecorderError> {
    output_file::sync_folder(folder).map_err(|source| RecorderError::Folder { path: folder.into(), source })
}

/// What the logs say about the run.
fn header(session: &Session, scene: &Scene, end: &EndRequest) -> Result<LogHeader, RecorderError> {
    let (volume_sha256, volume_dimensions) = match &scene.volume {
        Some(_) => {
            let (sha256, dimensions) = volume_identity(session, end)?;
            (Some(sha256), dimensions)
        }
        None => (None, [0; 3]),
    };
    let path = session.folder().join("scene.toml");
    let scene_toml =
        std::fs::read_to_string(&path).map_err(|cause| RecorderError::SceneText { path, cause })?;
    Ok(LogHeader {
        scene_toml,
        // The launcher lays it there if the scene has an X-ray.
        calibration_json: std::fs::read_to_string(session.folder().join(CALIBRATION_ATTACHMENT)).ok(),
        scene_name: scene.name.clone(),
        volume_sha256,
        volume_dimensions,
        dt_ns: scene.dt_ns(),
        mode: if scene.run.mode == Mode::Lockstep { RunMode::Lockstep } else { RunMode::RealTime },
        controllers: scene.controller_names(),
        build: BuildInfo::current(),
    })
}

fn volume_identity(session: &Session, end: &EndRequest) -> Result<([u8; 32], [u32; 3]), RecorderError> {
    let subscriber: Subscriber<Volume> = session.subscriber(&services::VOLUME)?;
    let volume = await_volume(&subscriber, end)?.ok_or(RecorderError::NoVolume)?;
    Ok((volume.message().sha256, volume.message().dimensions))
}

struct Ports {
    states: Subscriber<State>,
    latched: Subscriber<Latched>,
    removed: Subscriber<Removed>,
    keyframes: Subscriber<Keyframe>,
    frames: Option<Subscriber<Frame>>,
    replies: Subscriber<DrrReply>,
    requests: Subscriber<DrrRequest>,
    commands: Vec<(String, Subscriber<Command>)>,
    controls: Subscriber<RunControl>,
    control_replies: Subscriber<RunControlReply>,
    status: Subscriber<RunStatus>,
    events: Subscriber<Event>,
    tick_timing: Subscriber<TickTiming>,
    frame_timing: Subscriber<FrameTiming>,
    progress: Publisher<Progress>,
    events_sent: EventSender,
    waiter: Waiter,
    physics: Waker,
}

impl Ports {
    fn open(session: &Session, scene: &Scene) -> Result<Ports, SessionError> {
        let command =
            |name: String| Ok((topics::command(&name), session.lossless_command_subscriber(&name)?));
        Ok(Ports {
            states: session.lossless_subscriber(&services::STATE)?,
            latched: session.lossless_subscriber(&services::LATCHED)?,
            removed: session.lossless_subscriber(&services::REMOVED)?,
            keyframes: session.lossless_subscriber(&services::KEYFRAME)?,
            frames: scene.drr.as_ref().map(|_| session.lossless_subscriber(&services::FRAME)).transpose()?,
            replies: session.lossless_subscriber(&services::DRR_REPLY)?,
            requests: session.lossless_subscriber(&services::DRR_REQUEST)?,
            commands: scene
                .controller_names()
                .into_iter()
                .map(command)
                .collect::<Result<_, SessionError>>()?,
            controls: session.lossless_subscriber(&services::RUN_CONTROL)?,
            control_replies: session.lossless_subscriber(&services::RUN_CONTROL_REPLY)?,
            status: session.lossless_subscriber(&services::RUN_STATUS)?,
            events: session.lossless_subscriber(&services::EVENT)?,
            tick_timing: session.lossless_subscriber(&services::TICK_TIMING)?,
            frame_timing: session.lossless_subscriber(&services::FRAME_TIMING)?,
            progress: session.publisher(&services::PROGRESS)?,
            events_sent: EventSender::new(session, SENDER_RECORDER)?,
            waiter: session.waiter(Reader::Recorder)?,
            physics: session.waker(Reader::Physics)?,
        })
    }
}

impl Ports {
    /// Messages so far that did not come from the part whose service it is.
    fn strangers(&self) -> u64 {
        self.states.strangers()
            + self.latched.strangers()
            + self.removed.strangers()
            + self.keyframes.strangers()
            + self.frames.as_ref().map_or(0, Subscriber::strangers)
            + self.replies.strangers()
            + self.control_replies.strangers()
            + self.status.strangers()
            + self.tick_timing.strangers()
            + self.frame_timing.strangers()
    }
}

struct Recorder {
    /// Messages of strangers that have been said.
    strangers: u64,
    stranger_warnings: WarningLimit,
    run: RunLog<BackgroundFile>,
    timing: TimingLog<BackgroundFile>,
    recording: Recording,
    newest_tick: u64,
    reported_tick: u64,
    /// Of the timing lane.
    gaps: Gaps,
    /// Whether the physics has said so.
    run_has_ended: bool,
    session_folder: PathBuf,
    gap_warnings: WarningLimit,
    ports: Ports,
}

impl Recorder {
    /// Takes messages until the recorder is asked to end, and then what still waits.
    fn record(&mut self, end: &EndRequest) -> Result<(), RecorderError> {
        self.report_progress(0)?;
        let mut quiet_since = Instant::now();
        while !end.is_set() {
            self.ports.waiter.wait_until(Instant::now() + LOOK_TIME, || self.ports.states.has_message());
            // A physics process that joins later must hear of this one.
            self.ports.progress.deliver_history()?;
            if self.take_round()? {
                quiet_since = Instant::now();
            } else if quiet_since.elapsed() >= QUIET_TIME {
                // In a pause no tick closes a chunk, and what people do then is to be in the file too.
                self.timing.flush()?;
                quiet_since = Instant::now();
            }
            self.report_strangers()?;
        }
        // The launcher says why the run ends before it asks. Its lock alone may outlive it for a moment.
        if self.reason_path().is_none() || !host_is_alive(&self.session_folder) {
            self.outlast_physics()?;
        }
        for _ in 0..LAST_ROUNDS {
            self.take_round()?;
        }
        while self.ports.states.has_message() {
            self.take_round()?;
        }
        Ok(())
    }

    /// A launcher asks when nobody writes any more; one that was killed asks all at the same moment. What the physics
    /// publishes up to its end is to be in the log.
    fn outlast_physics(&mut self) -> Result<(), RecorderError> {
        let limit = Instant::now() + ORPHANED_LIMIT;
        while !self.run_has_ended && Instant::now() < limit {
            self.ports.waiter.wait_until(Instant::now() + LOOK_TIME, || self.ports.states.has_message());
            self.take_round()?;
        }
        Ok(())
    }

    /// Takes some ticks, and everything else that waits. In lockstep the physics goes on as fast as states are taken:
    /// a recorder that took states as long as there are any would never come to the other queues, which overflow.
    /// Returns whether a state came.
    fn take_round(&mut self) -> Result<bool, RecorderError> {
        let came = self.take_ticks()?;
        self.take_frames()?;
        self.take_timing()?;
        Ok(came)
    }

    fn take_ticks(&mut self) -> Result<bool, RecorderError> {
        let mut came = false;
        for _ in 0..TICKS_PER_ROUND {
            let Some(state) = self.ports.states.receive()? else { break };
            came = true;
            // Latched and Removed of a tick are published before its state.
            self.take_inputs()?;
            self.run.state(state.message())?;
            let tick = state.message().tick;
            drop(state);
            let missing = self.newest_tick + 1..tick;
            self.newest_tick = tick;
            if !missing.is_empty() {
                self.tell_of_gap(&missing)?;
            }
            if self.newest_tick >= self.reported_tick + PROGRESS_TICKS {
                self.report_progress(self.newest_tick)?;
            }
        }
        self.take_inputs()?;
        if let Some(more) = self.gap_warnings.take_suppressed(now_ns()) {
            let text = format!("{more} more gaps in the log");
            self.ports.events_sent.send(self.newest_tick, SEVERITY_WARNING, EVENT_MESSAGES_LOST, &text)?;
        }
        if self.newest_tick > self.reported_tick {
            self.report_progress(self.newest_tick)?;
        }
        Ok(came)
    }

    fn take_inputs(&mut self) -> Result<(), RecorderError> {
        while let Some(latched) = self.ports.latched.receive()? {
            self.run.latched(latched.message())?;
        }
        while let Some(keyframe) = self.ports.keyframes.receive()? {
            self.run.keyframe(keyframe.bytes())?;
        }
        while let Some(removed) = self.ports.removed.receive()? {
            self.run.removed(removed.bytes())?;
        }
        Ok(())
    }

    fn take_frames(&mut self) -> Result<(), RecorderError> {
        while let Some(reply) = self.ports.replies.receive()? {
            self.run.drr_reply(reply.message())?;
        }
        let Some(frames) = &self.ports.frames else { return Ok(()) };
        while let Some(frame) = frames.receive()? {
            let sequence = frame.message().sequence;
            match self.recording.images {
                Images::Full if self.recording.keeps_image(sequence) => self.run.frame(frame.bytes())?,
                Images::Full | Images::HashOnly => self.run.frame_without_image(frame.message())?,
                Images::None => self.gaps.see(topics::DRR_FRAME, 0, sequence),
            }
        }
        Ok(())
    }

    fn take_timing(&mut self) -> Result<(), RecorderError> {
        let (ports, timing, tick) = (&self.ports, &mut self.timing, self.newest_tick);
        while let Some(message) = ports.tick_timing.receive()? {
            let of_tick = message.message().tick;
            self.gaps.see(topics::TICK_TIMING, 0, of_tick + 1);
            timing.message(topics::TICK_TIMING, TickTiming::DESCRIPTION, of_tick, message.bytes())?;
        }
        for (topic, commands) in &ports.commands {
            copy_all(commands, timing, topic, tick)?;
        }
        while let Some(message) = ports.frame_timing.receive()? {
            self.gaps.see(topics::FRAME_TIMING, 0, message.message().frame_sequence);
            timing.message(topics::FRAME_TIMING, FrameTiming::DESCRIPTION, tick, message.bytes())?;
        }
        for _ in 0..CLIENT_MESSAGES_PER_ROUND {
            let Some(message) = ports.events.receive_valid(|_| {})? else { break };
            self.gaps.see(topics::EVENT, message.message().sender, message.message().sequence);
            timing.message(topics::EVENT, Event::DESCRIPTION, tick, message.bytes())?;
        }
        copy_all(&ports.controls, timing, topics::RUN_CONTROL, tick)?;
        copy_all(&ports.control_replies, timing, topics::RUN_CONTROL_REPLY, tick)?;
        while let Some(status) = ports.status.receive()? {
            self.run_has_ended |= status.message().phase == PHASE_ENDED;
            timing.message(topics::RUN_STATUS, RunStatus::DESCRIPTION, tick, status.bytes())?;
        }
        copy_all(&ports.requests, timing, topics::DRR_REQUEST, tick)
    }

    /// At once: what is recorded from here on may not be what the run is made for.
    fn tell_of_gap(&mut self, missing: &Range<u64>) -> Result<(), RecorderError> {
        if !self.gap_warnings.allows(now_ns()) {
            return Ok(());
        }
        let text = format!(
            "ticks {} to {} are missing in the log: the recorder was held up for longer than its queues hold",
            missing.start,
            missing.end - 1
        );
        Ok(self.ports.events_sent.send(self.newest_tick, SEVERITY_WARNING, EVENT_MESSAGES_LOST, &text)?)
    }

    /// Says when programs that are not the part whose service it is have sent what the log does not take.
    fn report_strangers(&mut self) -> Result<(), RecorderError> {
        let strangers = self.ports.strangers();
        let new = strangers - self.strangers;
        if new > 0 && self.stranger_warnings.allows(now_ns()) {
            self.strangers = strangers;
            let text = format!("{new} messages on services of other parts came from strangers; not recorded");
            self.ports.events_sent.send(self.newest_tick, SEVERITY_WARNING, EVENT_REQUEST_REFUSED, &text)?;
        }
        // They are told the next time, with those that come until then.
        self.stranger_warnings.take_suppressed(now_ns());
        Ok(())
    }

    fn report_progress(&mut self, tick: u64) -> Result<(), RecorderError> {
        self.reported_tick = tick;
        let lost = self.run.lost().values().chain(self.gaps.lost().values());
        let lost_messages = lost.fold(0, |sum: u64, lost| sum.saturating_add(*lost));
        self.ports.progress.send(&Progress {
            tick,
            lost_messages,
            consumer: SENDER_RECORDER,
            reserved: 0,
        })?;
        self.ports.physics.wake();
        Ok(())
    }

    /// Where the launcher has said why the run ends, if it has.
    fn reason_path(&self) -> Option<PathBuf> {
        reason_file::find(&self.session_folder, self.run.path().parent().unwrap_or(Path::new(".")))
    }

    fn finish(self, output: &Path, failed: bool) -> Result<(), RecorderError> {
        // Somebody else's signal may come before the launcher's word: of a run that is over the launcher is about to give it.
        let limit = Instant::now() + ORPHANED_LIMIT;
        let launcher_lives = || host_is_alive(&self.session_folder);
        while self.run_has_ended && self.reason_path().is_none() && launcher_lives() && Instant::now() < limit
        {
            std::thread::sleep(LOOK_TIME);
        }
        let reason_path = self.reason_path();
        let reason = match reason_path.as_deref().map(reason_file::read) {
            _ if failed => EndReason::PartDied("recorder".to_owned()),
            Some(Ok(reason)) => reason,
            // Nobody has ended the run: the recorder was told to go.
            _ if launcher_lives() => EndReason::PartDied("recorder".to_owned()),
            // It was killed, and could not say why the run ends.
            _ => EndReason::PartDied("launcher".to_owned()),
        };
        // It has done its work.
        reason_path.iter().for_each(|path| drop(std::fs::remove_file(path)));
        let lost = self.gaps.lost();
        let paths = [self.run.path().to_owned(), self.timing.path().to_owned()];
        let [run_path, timing_path] = paths.clone();
        let run = finish_file(run_path, self.run.finish(reason.clone(), &BTreeMap::new()));
        let timing = finish_file(timing_path, self.timing.finish(reason.clone(), lost));
        let run = run.and_then(|run| timing.map(|_| run))?;
        if run.last_tick.is_none() && reason == EndReason::Interrupted {
            // There was nothing to record yet, and there is nothing to replay.
            paths.iter().for_each(|path| drop(std::fs::remove_file(path)));
        }
        sync_folder(output)?;
        if run.lost.is_empty() {
            return Ok(());
        }
        let each: Vec<String> = run.lost.iter().map(|(topic, count)| format!("{count} of {topic}")).collect();
        Err(RecorderError::Gap { lost: each.join(", ") })
    }
}

/// Waits until the finished log is on the disk.
fn finish_file(
    path: PathBuf,
    finished: Result<(EndMarker, BackgroundFile), LogError>,
) -> Result<EndMarker, LogError> {
    let (marker, file) = finished?;
    file.close().map_err(|source| LogError::Write { path, source })?;
    Ok(marker)
}

/// Copies what waits on a service into the timing lane. What a client sends in a wrong length is no message: it has
/// no place in the log, and whom it was meant for has said so in an event.
fn copy_all<M: Message>(
    subscriber: &Subscriber<M>,
    timing: &mut TimingLog<BackgroundFile>,
    topic: &str,
    tick: u64,
) -> Result<(), RecorderError> {
    for _ in 0..CLIENT_MESSAGES_PER_ROUND {
        let Some(message) = subscriber.receive_valid(|_| {})? else { break };
        timing.message(topic, M::DESCRIPTION, tick, message.bytes())?;
    }
    Ok(())
}
