//! `trabecula proc`: runs one part of a session in this process.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use ipc_types::process::end_with_parent;
use ipc_types::session::{HalfMadeSweeper, host_is_alive};

use crate::failure::Failure;
use crate::keeper;

/// Which part.
#[derive(Debug, Subcommand)]
pub enum ProcCommand {
    /// The physics.
    Physics(Joined),
    /// The X-ray.
    Drr(Joined),
    /// A built-in controller of the scene.
    Controller {
        /// Its name in the scene.
        #[arg(long)]
        name: String,
        /// The session.
        #[command(flatten)]
        joined: Joined,
    },
    /// The recorder.
    Recorder {
        /// Folder for `run.mcap` and `timing.mcap`.
        #[arg(long)]
        output: PathBuf,
        /// The session.
        #[command(flatten)]
        joined: Joined,
    },
    /// A program that is not ours, with all that it starts; the launcher holds the other end of its standard input.
    #[command(hide = true)]
    Keep {
        /// Program and arguments.
        #[arg(last = true, required = true)]
        words: Vec<OsString>,
    },
}

/// The session to join.
#[derive(Debug, Args)]
pub struct Joined {
    /// Folder of the session; `trabecula run` prints it.
    #[arg(long, env = "TRABECULA_SESSION")]
    session: PathBuf,
}

/// Runs the part until it ends.
///
/// # Errors
/// Any error of the part.
pub fn run(command: &ProcCommand) -> Result<ExitCode, Failure> {
    end_with_parent();
    let failed = |error: &dyn std::error::Error| Failure::failed(error.to_string());
    match command {
        ProcCommand::Physics(joined) => {
            physics_proc::process::run(joined.to_living()?).map_err(|e| failed(&e))?;
        }
        ProcCommand::Drr(joined) => drr_proc::process::run(joined.to_living()?).map_err(|e| failed(&e))?,
        ProcCommand::Controller { name, joined } => {
            controller_proc::process::run(joined.to_living()?, name).map_err(|e| failed(&e))?;
        }
        ProcCommand::Recorder { output, joined } => {
            // Normally the host sweeps. If the host is killed, this thread sweeps instead, so that the recorder can
            // still finish.
            let _sweeper = HalfMadeSweeper::of(&joined.session);
            let recorded = recorder_proc::process::run(joined.to_living()?, output);
            recorded.map_err(|error| Failure { code: error.exit_code(), message: error.to_string() })?;
        }
        ProcCommand::Keep { words } => return keeper::run(words),
    }
    Ok(ExitCode::SUCCESS)
}

impl Joined {
    /// The session's folder, if its host is alive. The check covers a host that died before [`end_with_parent`] was
    /// set up, because then no signal comes.
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
