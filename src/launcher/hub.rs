//! The session of a run: its services, volume and parts.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::process::Command;

use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{CArmGeometry, Part as HubPart, Volume as VolumeMessage};
use ipc_types::ports::{PortError, Publisher};
use ipc_types::scene::{Controller, Mode, Scene, Wait};
use ipc_types::session::{
    CONTROLLER_VARIABLE, SESSION_VARIABLE, SessionError, SessionHost, SessionPlan, passed_over,
};
use run_log::CALIBRATION_ATTACHMENT;
use run_log::cat::whole;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use voxel_grid::Ct;
use xray::from_scene::scene_c_arm;
use xray::message::c_arm_message;
use zerocopy::IntoBytes;

use super::part::{PartProcess, ProgramOutput};
use crate::failure::Failure;
use crate::machine::memory::{MemoryNeed, MemoryShortage};

/// Name of this process.
pub const LAUNCHER: &str = HubPart::Host.name();
/// Name of the physics part.
pub const PHYSICS: &str = HubPart::Physics.name();
/// Name of the DRR part.
pub const DRR: &str = HubPart::Drr.name();
/// Name of the recorder part.
pub const RECORDER: &str = HubPart::Recorder.name();

const VIEWER: &str = "viewer";

/// How to start the viewer of a run.
#[derive(Debug, Clone, Copy)]
pub struct View {
    /// Port of its page.
    pub port: u16,
    /// Whether clients without the token may watch.
    pub watch_by_anyone: bool,
}

/// The host side of a run.
#[derive(Debug)]
pub struct Hub {
    /// The session with all its services.
    pub host: SessionHost,
    volume: Option<Publisher<VolumeMessage>>,
    /// Whether the missing session folder has been reported.
    is_hidden: Cell<bool>,
}

/// Errors of setting up the hub.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The session failed.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The volume cannot be published.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The scene cannot be written into the session's folder.
    #[error("{path}: {cause}")]
    File {
        /// File.
        path: PathBuf,
        /// The system's reason.
        cause: String,
    },
    /// The limit of open files is too low.
    #[error(
        "open file limit is {most}, a session needs {LEAST_FILES}: raise it with `ulimit -n {LEAST_FILES}`"
    )]
    Files {
        /// Limit for each process.
        most: u64,
    },
    /// The machine or one of its limits leaves too little memory.
    #[error(transparent)]
    Memory(#[from] MemoryShortage),
    /// A part cannot be started.
    #[error("part `{part}`: `{program}` cannot be started ({cause})")]
    Start {
        /// Name of the part.
        part: String,
        /// Program.
        program: String,
        /// The system's reason.
        cause: std::io::Error,
    },
}

impl From<HubError> for Failure {
    fn from(error: HubError) -> Failure {
        match error {
            // Nothing has been started or written.
            HubError::Memory(_) => Failure::bad_input(error),
            _ => Failure::failed(error),
        }
    }
}

/// Returns how the parts wait for each other. In real time the next state is a period away, so a hybrid wait
/// would yield in vain, and yielding can lose the core for as long as a rendering thread needs it.
fn wait_for_each_other(scene: &Scene) -> Wait {
    match (scene.run.mode, scene.run.wait) {
        (Mode::Realtime, Wait::Hybrid) => Wait::Event,
        (_, wait) => wait,
    }
}

/// Whether the run has a recorder, for which the physics waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recording {
    /// With a recorder.
    On,
    /// Without a recorder.
    Off,
}

/// Minimum limit of open files per process: physics and launcher have about 130 open. Below that, a process
/// waits forever for shared memory that cannot be opened.
const LEAST_FILES: u64 = 256;

/// Raises the limit of open files, inherited by the parts, to what a session needs.
fn allow_files() -> Result<(), HubError> {
    let limit = getrlimit(Resource::Nofile);
    if limit.current.is_none_or(|most| most >= LEAST_FILES) {
        return Ok(());
    }
    let raised = Rlimit { current: Some(LEAST_FILES), maximum: limit.maximum };
    setrlimit(Resource::Nofile, raised).map_err(|_| HubError::Files { most: limit.current.unwrap_or(0) })
}

/// Returns the command that runs a part with this program.
fn own_program(part: &str) -> Result<Command, HubError> {
    let cannot = |cause| HubError::Start { part: part.to_owned(), program: "trabecula".to_owned(), cause };
    std::env::current_exe().map(Command::new).map_err(cannot)
}

/// Returns the settings of a scene's session; without a volume, of one that has still to be loaded.
pub fn session_plan(scene: &Scene, ct: Option<&Ct>, recording: Recording) -> SessionPlan {
    SessionPlan {
        controllers: scene.controller_names(),
        volume_bytes: ct.map_or(0, |ct| VolumeMessage::DESCRIPTION.size + ct.volume.hu.len() * 2),
        frame_bytes: scene.drr.as_ref().map_or(0, |drr| services::frame_bytes(drr.columns, drr.rows)),
        sensors: scene.has_readings(),
        tip_jacobian: scene.has_tip_jacobian(),
        recorder: recording == Recording::On,
        wait: wait_for_each_other(scene),
        policy: scene.run.policy,
    }
}

/// Refuses a session that this machine has not the memory for, before anything of it exists.
///
/// # Errors
/// [`HubError::Memory`].
pub fn refuse_scarce_memory(plan: &SessionPlan) -> Result<(), HubError> {
    MemoryNeed::of(plan).shortage().map_or(Ok(()), |shortage| Err(shortage.into()))
}

impl Hub {
    /// Creates the session of a scene, publishes its volume, and announces the session.
    ///
    /// # Errors
    /// Any [`HubError`].
    pub fn create(scene: &Scene, ct: Option<&Ct>, recording: Recording) -> Result<Hub, HubError> {
        let plan = session_plan(scene, ct, recording);
        refuse_scarce_memory(&plan)?;
        if let Some(place) = passed_over() {
            tell!("trabecula: {place}");
        }
        allow_files()?;
        let host = SessionHost::create(&plan)?;
        let path = host.session.folder().join("scene.toml");
        let file_error = |cause: String| HubError::File { path: path.clone(), cause };
        let text = toml::to_string(scene).map_err(|cause| file_error(cause.to_string()))?;
        std::fs::write(&path, text).map_err(|cause| file_error(cause.to_string()))?;
        if let Some(c_arm) = scene.drr.as_ref().and_then(|drr| scene_c_arm(drr).ok()) {
            let json = whole(CArmGeometry::DESCRIPTION, c_arm_message(&c_arm).as_bytes());
            let path = host.session.folder().join(CALIBRATION_ATTACHMENT);
            let error =
                |cause: std::io::Error| HubError::File { path: path.clone(), cause: cause.to_string() };
            std::fs::write(&path, format!("{json:#}\n")).map_err(error)?;
        }
        let publisher = match ct {
            Some(ct) => {
                let publisher = host.session.publisher::<VolumeMessage>(&services::VOLUME)?;
                publisher.send_with_tail(&VolumeMessage::of(ct), ct.volume.hu.as_bytes())?;
                Some(publisher)
            }
            None => None,
        };
        host.announce()?;
        Ok(Hub { host, volume: publisher, is_hidden: Cell::new(false) })
    }

    /// Folder of the session.
    pub fn folder(&self) -> &Path {
        self.host.session.folder()
    }

    /// Sends the volume to all programs that have joined since the last call. Reports once if the session's
    /// folder was removed, so that no other program can join.
    pub fn serve_late_joiners(&self) -> Result<(), PortError> {
        if !self.is_hidden.get() && !self.host.session.is_announced() {
            self.is_hidden.set(true);
            tell!(
                "trabecula: {}: the session's folder was removed; the run continues, but no other program \
                 can join",
                self.folder().display()
            );
        }
        self.volume.as_ref().map_or(Ok(()), Publisher::deliver_history)
    }

    /// Starts one of our own parts as `trabecula proc NAME …`.
    pub fn start(
        &self,
        part: &str,
        arguments: &[&str],
        output: Option<&Path>,
    ) -> Result<PartProcess, HubError> {
        let mut command = own_program(part)?;
        command.arg("proc").args(arguments).arg("--session").arg(self.folder());
        if let Some(output) = output {
            command.arg("--output").arg(output);
        }
        self.spawn(part, &mut command, ProgramOutput::Hidden)
    }

    /// Returns the words that start a controller's program: its `command`, or this program for an FMU. `None`
    /// for a controller that is no program of its own.
    ///
    /// # Errors
    /// [`HubError::Start`]: this program's own file is not known.
    pub fn program_of(controller: &Controller) -> Result<Option<Vec<String>>, HubError> {
        if controller.fmu.is_none() {
            return Ok(controller.command.clone());
        }
        let program = own_program(&controller.name)?.get_program().to_string_lossy().into_owned();
        Ok(Some([program.as_str(), "proc", "fmu"].map(str::to_owned).to_vec()))
    }

    /// Starts an external controller program.
    pub fn start_program(&self, name: &str, words: &[String]) -> Result<PartProcess, HubError> {
        let start_error = |cause| HubError::Start {
            part: name.to_owned(),
            program: words.first().cloned().unwrap_or_default(),
            cause,
        };
        let mut keeper = own_program(name)?;
        keeper.args(["proc", "keep", "--"]).args(words);
        keeper.env(CONTROLLER_VARIABLE, name).env(SESSION_VARIABLE, self.folder());
        PartProcess::start_kept(name, &mut keeper, ProgramOutput::Shown).map_err(start_error)
    }

    /// Starts the viewer as `trabecula view`; the viewer prints its page's address.
    pub fn start_viewer(&self, view: View) -> Result<PartProcess, HubError> {
        let mut command = own_program(VIEWER)?;
        command.args(["view", "--port", &view.port.to_string(), "--session"]).arg(self.folder());
        if view.watch_by_anyone {
            command.arg("--watch-by-anyone");
        }
        self.spawn(VIEWER, &mut command, ProgramOutput::Shown)
    }

    fn spawn(
        &self,
        part: &str,
        command: &mut Command,
        output: ProgramOutput,
    ) -> Result<PartProcess, HubError> {
        let program = command.get_program().to_string_lossy().into_owned();
        PartProcess::start(part, command.env(SESSION_VARIABLE, self.folder()), output)
            .map_err(|cause| HubError::Start { part: part.to_owned(), program, cause })
    }
}
