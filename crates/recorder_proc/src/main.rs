//! The recorder process as a standalone program.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use ipc_types::process::end_with_parent;
use ipc_types::session::HalfMadeSweeper;

/// Records a running session.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    /// Folder of the session; `trabecula run` prints it.
    #[arg(long, env = "TRABECULA_SESSION")]
    session: PathBuf,
    /// Folder for `run.mcap` and `timing.mcap`.
    #[arg(long)]
    output: PathBuf,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    end_with_parent();
    let _sweeper = HalfMadeSweeper::after_host(&arguments.session);
    match recorder_proc::process::run(&arguments.session, &arguments.output) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("recorder_proc: {error}");
            ExitCode::from(error.exit_code())
        }
    }
}
