//! `trabecula proc`: runs one part of a session in this process.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use ipc_types::process::end_with_parent;
use ipc_types::session::{SegmentSweeper, host_is_alive};

use crate::failure::Failure;
use crate::fmu_controller;
use crate::keeper;

/// The part to run.
#[derive(Debug, Subcommand)]
pub enum ProcCommand {
    /// The physics process.
    Physics(SessionArgument),
    /// The X-ray (DRR) process.
    Drr(SessionArgument),
    /// One of the scene's built-in controllers.
    Controller {
        /// Its name in the scene.
        #[arg(long)]
        name: String,
        /// The session.
        #[command(flatten)]
        joined: SessionArgument,
    },
    /// One of the scene's controllers that are FMUs, named by `TRABECULA_CONTROLLER`. Its library runs in
    /// this process.
    Fmu(SessionArgument),
    /// The recorder.
    Recorder {
        /// Folder for `run.mcap` and `timing.mcap`.
        #[arg(long)]
        output: PathBuf,
        /// The session.
        #[command(flatten)]
        joined: SessionArgument,
    },
    /// A third-party program and all its descendants; standard input is a socket to the launcher.
    #[command(hide = true)]
    Keep {
        /// Program and arguments.
        #[arg(last = true, required = true)]
        words: Vec<OsString>,
    },
}

/// The session to join.
#[derive(Debug, Args)]
pub struct SessionArgument {
    /// Folder of the session; `trabecula run` prints it.
    #[arg(long, env = "TRABECULA_SESSION")]
    session: PathBuf,
}

/// Runs the part until it ends.
pub fn run(command: &ProcCommand) -> Result<ExitCode, Failure> {
    end_with_parent();
    // A part must end even if its launcher was killed while creating a segment.
    let _sweeper = command.session().map(SegmentSweeper::after_host);
    match command {
        ProcCommand::Physics(joined) => {
            physics_proc::process::run(joined.to_living()?).map_err(Failure::failed)?;
        }
        ProcCommand::Drr(joined) => drr_proc::process::run(joined.to_living()?).map_err(Failure::failed)?,
        ProcCommand::Controller { name, joined } => {
            controller_proc::process::run(joined.to_living()?, name).map_err(Failure::failed)?;
        }
        ProcCommand::Fmu(joined) => {
            joined.to_living()?;
            fmu_controller::drive_of_scene()?;
        }
        ProcCommand::Recorder { output, joined } => {
            let recorded = recorder_proc::process::run(joined.to_living()?, output);
            recorded.map_err(|error| Failure { code: error.exit_code(), message: error.to_string() })?;
        }
        ProcCommand::Keep { words } => return keeper::run(words),
    }
    Ok(ExitCode::SUCCESS)
}

impl ProcCommand {
    /// The session of a part.
    fn session(&self) -> Option<&Path> {
        match self {
            ProcCommand::Physics(joined)
            | ProcCommand::Drr(joined)
            | ProcCommand::Fmu(joined)
            | ProcCommand::Controller { joined, .. }
            | ProcCommand::Recorder { joined, .. } => Some(&joined.session),
            ProcCommand::Keep { .. } => None,
        }
    }
}

impl SessionArgument {
    /// Returns the session's folder if its host is alive. A host that died before [`end_with_parent`] was set
    /// up sends no signal, so this checks for it.
    fn to_living(&self) -> Result<&Path, Failure> {
        match host_is_alive(&self.session) {
            true => Ok(&self.session),
            false => Err(Failure::failed(format!(
                "{}: no running session here; start one with `trabecula run SCENE`",
                self.session.display()
            ))),
        }
    }
}
