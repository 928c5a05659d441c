//! `trabecula proc`: one part of a run, in this process.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use ipc_types::process::end_with_parent;

use crate::failure::Failure;

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
        #[command(flatten)]
        joined: Joined,
    },
    /// The recorder.
    Recorder {
        /// Folder for `run.mcap` and `timing.mcap`.
        #[arg(long)]
        output: PathBuf,
        #[command(flatten)]
        joined: Joined,
    },
}

/// The session to join.
#[derive(Debug, Args)]
pub struct Joined {
    /// Folder of the session; `trabecula run` prints it.
    #[arg(long, env = "TRABECULA_SESSION")]
    session: PathBuf,
}

/// Runs the part to its end.
///
/// # Errors
/// What the part says.
pub fn run(command: &ProcCommand) -> Result<(), Failure> {
    end_with_parent();
    let failed = |error: &dyn std::error::Error| Failure::failed(error.to_string());
    match command {
        ProcCommand::Physics(joined) => physics_proc::process::run(&joined.session).map_err(|e| failed(&e)),
        ProcCommand::Drr(joined) => drr_proc::process::run(&joined.session).map_err(|e| failed(&e)),
        ProcCommand::Controller { name, joined } => {
            controller_proc::process::run(&joined.session, name).map_err(|e| failed(&e))
        }
        ProcCommand::Recorder { output, joined } => {
            recorder_proc::process::run(&joined.session, output).map_err(|e| failed(&e))
        }
    }
}
