//! The laboratory's commands. They live in a separate program, `trabecula-lab`; this one forwards them.

use std::ffi::{OsStr, OsString};
use std::io::ErrorKind;
use std::os::unix::process::CommandExt;
use std::process::Command;

use clap::{Args, Subcommand};

use crate::failure::Failure;

/// The laboratory's program, in this program's folder.
const PROGRAM: &str = "trabecula-lab";

/// Help texts of the laboratory's commands, for both programs.
pub mod about {
    /// `bench`.
    pub const BENCH: &str = "Measure the hub's overhead on this machine";
    /// `stress`.
    pub const STRESS: &str =
        "Run a scene on limited cores under competing load, and report why ticks were late";
    /// `chart`.
    pub const CHART: &str = "Measure accuracy against computing time; write tables and figures";
    /// `reproduce`.
    pub const REPRODUCE: &str =
        "Reproduce published results from low-level rules: tunnel, skiving, deviation, bend, thrust";
}

/// A command of the laboratory.
#[derive(Debug, Subcommand)]
pub enum LaboratoryCommand {
    /// `trabecula-lab bench`.
    #[command(about = about::BENCH, disable_help_flag = true)]
    Bench(Forwarded),
    /// `trabecula-lab stress`.
    #[command(about = about::STRESS, disable_help_flag = true)]
    Stress(Forwarded),
    /// `trabecula-lab chart`.
    #[command(about = about::CHART, disable_help_flag = true)]
    Chart(Forwarded),
    /// `trabecula-lab reproduce`.
    #[command(about = about::REPRODUCE, disable_help_flag = true)]
    Reproduce(Forwarded),
}

/// Arguments passed on to the laboratory's program.
#[derive(Debug, Args)]
pub struct Forwarded {
    /// Arguments of the command; `--help` lists them.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<OsString>,
}

/// Replaces this process with the laboratory's program.
///
/// # Errors
/// The program cannot be started. On success this does not return.
pub fn run(command: &LaboratoryCommand) -> Result<(), Failure> {
    let (name, Forwarded { arguments }) = match command {
        LaboratoryCommand::Bench(words) => ("bench", words),
        LaboratoryCommand::Stress(words) => ("stress", words),
        LaboratoryCommand::Chart(words) => ("chart", words),
        LaboratoryCommand::Reproduce(words) => ("reproduce", words),
    };
    let own = std::env::current_exe()
        .map_err(|cause| Failure::failed(format!("the program's own path: {cause}")))?;
    let program = own.with_file_name(PROGRAM);
    let cause = Command::new(&program).arg(OsStr::new(name)).args(arguments).exec();
    Err(Failure::failed(match cause.kind() {
        ErrorKind::NotFound => format!(
            "`{name}` needs {}, which does not exist; `cargo build --release` in a checkout builds it, wheels leave it out",
            program.display()
        ),
        _ => format!("{}: cannot be started ({cause})", program.display()),
    }))
}
