//! The physics process as a standalone program.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use ipc_types::process::{conclude, end_with_parent};
use ipc_types::session::HalfMadeSweeper;

/// Steps the physics of a running session.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    /// Folder of the session; `trabecula run` prints it.
    #[arg(long, env = "TRABECULA_SESSION")]
    session: PathBuf,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    end_with_parent();
    let _sweeper = HalfMadeSweeper::after_host(&arguments.session);
    conclude("physics_proc", physics_proc::process::run(&arguments.session))
}
