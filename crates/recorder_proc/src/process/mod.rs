//! The recorder process: receives every message of every service and writes the two logs.
//!
//! It polls, so no other part has to wake it and it costs the physics nothing. Its queues hold
//! [`RECORDER_QUEUE_TICKS`]. One thread drains them and assembles the log, another writes the files
//! ([`background`](crate::background)). The physics waits for its `Progress` in lockstep, and in real time
//! with `recording.on_full = "wait"`. Otherwise a recorder that falls behind by more than its queues leaves a
//! gap: it reports the gap at once in an event, counts it in the log's end marker, and returns it as the exit
//! code ([`RecorderError::Gap`]).

use std::path::{Path, PathBuf};
use std::time::Duration;

use hub::rate_limit::WarningLimit;
use ipc_types::messages::Part;
use ipc_types::messages::services::{self, RECORDER_QUEUE_TICKS};
use ipc_types::ports::PortError;
use ipc_types::process::{EXIT_FAILED, EXIT_GAP, EndRequest, Role, await_volume, prioritise, session_scene};
use ipc_types::scene::{Mode, Scene, SceneError};
use ipc_types::session::{Session, SessionError};
use run_log::gaps::Gaps;
use run_log::{CALIBRATION_ATTACHMENT, LogError, LogHeader, RunLog, RunMode, TimingLog};
use thiserror::Error;

use crate::background::BackgroundOptions;
use crate::build_info;
use crate::log_file::index_beside;
use crate::ring_files::{self, LANES, LogFiles, create_file};

mod flight;
mod ports;
mod recorder;
#[cfg(test)]
mod tests;

use flight::{Flight, Lanes};
use ports::Ports;
use recorder::{Recorder, RecordingExtent};

/// Why the recorder ended early.
#[derive(Debug, Error)]
pub enum RecorderError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be received.
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
    /// A trigger of the scene is malformed.
    #[error("`recording.triggers`: {0}")]
    Trigger(String),
    /// Signal handlers cannot be installed.
    #[error("cannot install signal handlers: {0}")]
    Signals(std::io::Error),
    /// The log folder cannot be synced to disk.
    #[error("{}: cannot be synced to disk: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The log is finished, but lacks messages that belong in `run.mcap`.
    #[error(
        "the log has a gap ({lost}): the recorder stalled for longer than its queues of \
         {RECORDER_QUEUE_TICKS} ticks can bridge; \
         with `recording.on_full = \"wait\"` the physics waits for it"
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

/// Time limit for writing the logs' headers: less than the hub gives this part to connect (60 s), so that the
/// error names the disk.
const HEADER_LIMIT: Duration = Duration::from_secs(30);
/// Name of the session-folder file with the folder of the recording.
pub const OUTPUT_FILE: &str = "output";

/// Records a session into `run.mcap` and `timing.mcap` of a folder until it is asked to end (SIGTERM), then
/// drains its queues and finishes both logs.
///
/// # Errors
/// Any [`RecorderError`].
pub fn run(session_folder: &Path, output: &Path) -> Result<(), RecorderError> {
    let end = EndRequest::install().map_err(RecorderError::Signals)?;
    let scene = session_scene(session_folder)?;
    if scene.run.mode == Mode::Realtime {
        // Set before the writer threads start, so that they inherit it.
        prioritise(Role::Recorder, scene.run.policy);
    }
    let session = Session::join(session_folder)?;
    session.claim(Part::Recorder)?;
    let header = header(&session, &scene, &end)?;
    let mut recorder = start(&session, &scene, &header, output)?;
    let recorded = recorder.record(&end);
    let how_far = if recorded.is_ok() { RecordingExtent::UpToTheEnd } else { RecordingExtent::UpToAnError };
    // Keep everything received, whatever went wrong.
    let finished = recorder.finish(how_far);
    recorded.and(finished)
}

/// Creates the logs and a recorder that has received nothing.
fn start(
    session: &Session,
    scene: &Scene,
    header: &LogHeader,
    output: &Path,
) -> Result<Recorder, RecorderError> {
    let ports = Ports::open(session, scene)?;
    let LogFiles { folder, run: run_file, timing: timing_file } = match scene.recording.ring_s > 0.0 {
        true => ring_files::create(output, 1)?,
        false => LogFiles {
            folder: output.to_owned(),
            run: create_file(&output.join(LANES[0]), BackgroundOptions::RUN)?,
            timing: create_file(&output.join(LANES[1]), BackgroundOptions::TIMING)?,
        },
    };
    let [run, timing] = LANES.map(|lane| folder.join(lane));
    let (run_written, timing_written) = (run_file.written(), timing_file.written());
    let recorder = Recorder {
        lanes: Lanes {
            run: RunLog::create_named(run_file, &run, index_beside(&run), header)?,
            timing: TimingLog::create_named(timing_file, &timing, index_beside(&timing), header)?,
        },
        flight: Flight::of(scene, header, output, &folder)?,
        output: output.to_owned(),
        recording: scene.recording.clone(),
        newest_tick: 0,
        reported_tick: 0,
        gaps: Gaps::default(),
        run_has_ended: false,
        session_folder: session.folder().to_owned(),
        foreign_messages: 0,
        foreign_warnings: WarningLimit::default(),
        gap_warnings: WarningLimit::default(),
        ports,
    };
    // From the first tick on, the files identify themselves, even if this process is killed.
    for (written, path) in [(run_written, run), (timing_written, timing)] {
        written.wait(HEADER_LIMIT).map_err(|source| LogError::Write { path, source })?;
    }
    sync_folder(output)?;
    Ok(recorder)
}

fn sync_folder(folder: &Path) -> Result<(), RecorderError> {
    output_file::sync_folder(folder).map_err(|source| RecorderError::Folder { path: folder.into(), source })
}

/// The header of both logs.
fn header(session: &Session, scene: &Scene, end: &EndRequest) -> Result<LogHeader, RecorderError> {
    let volume = match &scene.volume {
        Some(_) => Some(await_volume(&session.subscriber(&services::VOLUME)?, end)?),
        None => None,
    };
    let volume = volume.as_ref().map(|volume| volume.message());
    let path = session.folder().join("scene.toml");
    let scene_toml =
        std::fs::read_to_string(&path).map_err(|cause| RecorderError::SceneText { path, cause })?;
    Ok(LogHeader {
        scene_toml,
        // The launcher writes it if the scene has an X-ray.
        calibration_json: std::fs::read_to_string(session.folder().join(CALIBRATION_ATTACHMENT)).ok(),
        scene_name: scene.name.clone(),
        volume_sha256: volume.map(|volume| volume.sha256),
        volume_dimensions: volume.map_or([0; 3], |volume| volume.dimensions),
        dt_ns: scene.dt_ns(),
        mode: if scene.run.mode == Mode::Lockstep { RunMode::Lockstep } else { RunMode::RealTime },
        controllers: scene.controller_names(),
        build: build_info::current(),
        first_tick: ipc_types::messages::Tick::START,
    })
}
